"""How long gradient steps take: of the latent models and of the VAE."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.objectives import HardUpdate

from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.benchmark.reference import ReferenceVAE, reference_members
from ls3_recipes.benchmark.timing import Bench
from ls3_recipes.options import as_dict
from ls3_torchrl import LS3Agent
from ls3_torchrl.halves import Halves
from ls3_torchrl.objectives import EnsembleDynamicsLoss, OfflineValueLoss, SafeSetLoss, VAELoss
from ls3_torchrl.trainers.vae_gradient import TARGET, VAEGradient


def gradient_step(loss: nn.Module, key: str, rows: TensorDict, precision: str) -> Callable[[], None]:
    """A step of Adam on a loss."""
    optimizer = torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], lr=1e-4, fused=True)

    def take() -> None:
        with torch.autocast(rows.device.type, torch.bfloat16, enabled=precision == "bf16"):
            value = loss(rows)[key]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()

    return take


def vae_step(loss: VAELoss, rows: TensorDict, precision: str) -> Callable[[], None]:
    """A step on equation (1) as the trainer takes it: half batches on the cores, and Adam."""
    gradient = VAEGradient(loss, None, loss.parameters(), bf16=precision == "bf16")
    optimizer = torch.optim.Adam(gradient.leaves, lr=1e-4, fused=True)
    latent_dim = loss.encoder.latent_dim
    images = TensorDict({TARGET: rows["pixels"]}, rows.batch_size)

    def take() -> None:
        with Halves() as both:
            gradient(images, torch.randn(len(rows), latent_dim, device=rows.device), 0.0, both)
            optimizer.step()

    return take


def loop_over_members(
    inputs: Tensor, sizes: Sequence[int], error: Callable[[Tensor, int], Tensor]
) -> Callable[[], None]:
    """The same for separate networks, one after another, on inputs ``[B, M, D]``."""
    networks = [network.to(inputs.device) for network in reference_members(sizes, inputs.shape[1])]
    optimizers = [torch.optim.Adam(network.parameters(), lr=1e-4) for network in networks]

    def take() -> None:
        for m, (network, optimizer) in enumerate(zip(networks, optimizers, strict=True)):
            value = error(network(inputs[:, m]), m)
            optimizer.zero_grad()
            value.backward()
            optimizer.step()

    return take


def random_rows(shape: Sequence[int], latent_dim: int, action_dim: int, device: torch.device) -> TensorDict:
    """Transitions of noise."""
    data = {"latent": torch.randn(*shape, latent_dim), "action": torch.randn(*shape, action_dim)}
    data |= {"reward_to_go": -torch.rand(*shape, 1), "in_success": torch.ones(*shape, 1).bool()}
    return TensorDict(data | {"next": {"latent": torch.randn(*shape, latent_dim)}}, list(shape), device=device)


def time_updates(bench: Bench, settings: LS3Settings, spec: Bounded, device: torch.device, *, reference: bool) -> None:
    """Gradient steps of a preset's losses; dynamics and values also as a loop over members."""
    agent = LS3Agent(action_spec=spec, **as_dict(settings.agent)).to(device)
    shape, name, batch = agent.architecture, settings.preset, settings.optim.batch_size
    rows = random_rows([batch, shape.num_values], shape.latent_dim, shape.action_dim, device)
    loops = {key: f"{key} step, {name}, loop over members" for key in ("dynamics", "value")}
    if reference:
        _time_loops(bench, loops, agent, rows)
    for precision in ("fp32", "bf16"):
        dynamics = EnsembleDynamicsLoss(agent.dynamics, bootstrap=True)
        step = gradient_step(dynamics, "loss_dynamics", rows, precision)
        bench.time(f"dynamics step, {name}, {precision}", step, against=loops["dynamics"])
        step = gradient_step(OfflineValueLoss(agent.value, bootstrap=True), "loss_value", rows, precision)
        bench.time(f"value step, {name}, {precision}", step, against=loops["value"])
        _time_safe_set(bench, f"safe set step, {name}, {precision}", agent, rows[:, 0].clone(), precision)


def _time_safe_set(bench: Bench, figure: str, agent: LS3Agent, rows: TensorDict, precision: str) -> None:
    loss = SafeSetLoss(agent.safe_set, gamma=0.3)
    target = HardUpdate(loss, value_network_update_interval=99)
    step = gradient_step(loss, "loss_safe_set", rows, precision)
    bench.time(figure, lambda: (step(), target.step()))


def _time_loops(bench: Bench, figures: dict[str, str], agent: LS3Agent, rows: TensorDict) -> None:
    shape = agent.architecture
    latent, reached, returns = rows["latent"], rows["next", "latent"], rows["reward_to_go"]

    def likelihood(out: Tensor, m: int) -> Tensor:
        delta, log_scale = out.chunk(2, -1)
        normal = torch.distributions.Normal(latent[:, m] + delta, log_scale.clamp(-8, 4).exp())
        return -normal.log_prob(reached[:, m]).mean()

    sizes = [shape.latent_dim + shape.action_dim, *shape.dynamics_hidden, 2 * shape.latent_dim]
    bench.time(figures["dynamics"], loop_over_members(torch.cat([latent, rows["action"]], -1), sizes, likelihood))
    sizes = [shape.latent_dim, *shape.value_hidden, 1]
    bench.time(figures["value"], loop_over_members(latent, sizes, lambda out, m: (out - returns[:, m]).square().mean()))


def time_vae(
    bench: Bench, settings: LS3Settings, spec: Bounded, frames: Tensor, device: torch.device, *, reference: bool
) -> None:
    """VAE steps at batch 256 and at the preset's, and encoding."""
    agent = LS3Agent(action_spec=spec, in_channels=frames.shape[1], **as_dict(settings.agent)).to(device)
    slow = ReferenceVAE(agent).to(device)
    slow_optimizer = torch.optim.Adam(slow.parameters(), lr=1e-4)
    assert agent.decoder is not None
    for half in (agent.encoder, agent.decoder):
        half.to(memory_format=torch.channels_last)
    loss = VAELoss(agent.encoder, agent.decoder)

    for batch in sorted({256, settings.vae.batch_size}):
        pixels = frames[torch.randint(len(frames), (batch,))].to(device)
        rows = TensorDict({"pixels": pixels}, [batch], device=device)

        def slow_step(pixels: Tensor = pixels) -> None:
            value = slow.loss(pixels)
            slow_optimizer.zero_grad()
            value.backward()
            slow_optimizer.step()

        base = f"VAE step of {batch}, reference"
        if reference:
            bench.time(base, slow_step)
        for precision in ("fp32", "bf16"):
            step = vae_step(loss, rows, precision)
            bench.time(f"VAE step of {batch}, {precision}", step, against=base)
    pixels = frames[:512].to(device)
    with torch.no_grad():
        encode = TensorDict({"pixels": pixels}, [len(pixels)])
        bench.time("encoding a frame", lambda: agent.encoder(encode), per=len(pixels))
