"""How long everything takes on this machine, beside a plain fp32 eager path in the same run."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median
from typing import Any

import hydra
import torch
from hydra import compose
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.objectives import HardUpdate

import ls3_envs
from common import RunFolder, choose_device, console, hardware
from learning import threads
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, TaggedReplayBuffer
from ls3_torchrl.modules.ensemble import EnsembleMLP
from ls3_torchrl.objectives import EnsembleDynamicsLoss, OfflineValueLoss, SafeSetLoss, VAELoss
from ls3_torchrl.planners import ImaginationNoise, LS3Planner
from plain import PlainVAE, plain_members
from settings import agent_options
from timing import Bench, matmul_peak, show


def permissive(agent: LS3Agent) -> LS3Agent:
    """Make every plan of an untrained agent feasible: the most work that a plan of four rounds can be."""
    with torch.no_grad():
        for head, bias in ((agent.constraint, -20.0), (agent.goal, -20.0), (agent.safe_set, 20.0)):
            layers = [layer for layer in head.network.modules() if isinstance(layer, nn.Linear)]
            layers[-1].bias.fill_(bias)
    return agent


def plan_flops(agent: LS3Agent, options: dict[str, Any]) -> float:
    """Floating-point operations of the matrix products in one plan of which every candidate is feasible."""

    def network(sizes: Sequence[int]) -> int:
        return sum(a * b for a, b in pairwise(sizes))

    def head(module: nn.Module) -> int:
        return sum(layer.weight.numel() for layer in module.modules() if isinstance(layer, nn.Linear))

    def member(net: EnsembleMLP) -> int:
        return network([net.weights[0].shape[1], *(weight.shape[2] for weight in net.weights)])

    steps = member(agent.dynamics.network) + head(agent.constraint) + head(agent.goal)
    end = head(agent.safe_set) + agent.value.num_members * member(agent.value.network)
    paths = options["num_candidates"] * options["num_particles"] * options["optim_steps"]
    return 2.0 * paths * (options["horizon"] * steps + end)


def plans(
    bench: Bench, preset: DictConfig, spec: Bounded, batches: Sequence[int], device: torch.device, *, plain: bool
) -> None:
    """Plans of a preset: the plain path, the fused one in each precision, and batches of environments."""
    torch.manual_seed(0)
    agent = permissive(LS3Agent(spec.shape[-1], **agent_options(preset, spec))).to(device)
    options = {str(key): value for key, value in preset.planner.items()}
    name = preset.preset
    flops = plan_flops(agent, options)

    def planner(**changes: Any) -> LS3Planner:
        return agent.planner(spec, **(options | changes))

    def plan(policy: LS3Planner, batch: int) -> Callable[[], object]:
        latent = torch.randn(batch, preset.agent.latent_dim, device=device)
        return lambda: policy.plan(latent)

    base = f"plan, {name}, plain"
    if plain:
        bench.time(base, plan(planner(engine="rollout"), 1))
    for precision in ("fp32", "bf16"):
        seconds = bench.time(f"plan, {name}, {precision}", plan(planner(precision=precision), 1), against=base)
        bench.rows[-1]["gflops"] = flops / seconds / 1e9
    for batch in batches:
        if batch > 1:
            figure = f"plan, {name}, auto, each of {batch}"
            bench.time(figure, plan(planner(), batch), per=batch, against=base)


@torch.no_grad()
def agreement(agent: LS3Agent, options: dict[str, Any], spec: Bounded, frames: Tensor) -> dict[str, float]:
    """What bf16 changes in the plans of a trained agent, from some images.

    Args:
        agent: trained; only then do its heads say anything.
        options: of a planner.
        spec: bounds of one action.
        frames: images ``[n, C, 64, 64]`` to plan from.

    Returns:
        ``value_error``: median over images of how far, relatively, the value of the plan chosen in bf16 lies from
        that of the plan chosen in fp32, both judged in fp32 under the same noise. ``feasibility``: share of random
        candidates whose feasibility the precisions disagree on.
    """
    exact, rough = (agent.planner(spec, **(options | {"precision": precision})) for precision in ("fp32", "bf16"))
    errors, disagreeing = [], []
    space = exact.action_spec.space
    for frame in frames:
        latent = exact.encode(TensorDict({"pixels": frame[None].to(space.low.device)}, [1]))
        noise = exact.sample_noise(1)
        plans = torch.cat([planner.plan(latent, noise=noise).actions for planner in (exact, rough)])[None]
        drawn = ImaginationNoise(noise.members[0], noise.dynamics[0][:, :, :, :1])
        threshold = torch.full((1, 1), exact.safe_set_threshold, device=latent.device)
        one, other = exact.score_plans(exact.imagine(latent, plans, drawn), threshold).score[0]
        errors.append(float((one - other).abs() / one.abs().clamp(min=1.0)))
        uniform = torch.rand(1, exact.optimizer.num_candidates, exact.horizon, *space.low.shape, device=latent.device)
        candidates = space.low + (space.high - space.low) * uniform
        verdicts = [p.score_plans(p.imagine(latent, candidates, drawn), threshold).feasible for p in (exact, rough)]
        disagreeing.append(float((verdicts[0] != verdicts[1]).float().mean()))
    return {"value_error": median(errors), "feasibility": fmean(disagreeing)}


def updates(bench: Bench, preset: DictConfig, spec: Bounded, device: torch.device, *, plain: bool) -> None:
    """Gradient steps of a preset's losses; dynamics and values also as a loop over members."""
    action_dim = spec.shape[-1]
    agent = LS3Agent(action_dim, **agent_options(preset, spec)).to(device)
    batch, d, name = preset.optim.batch_size, preset.agent.latent_dim, preset.preset
    members = agent.value.num_members

    def tensors(*shape: int) -> TensorDict:
        data = {"latent": torch.randn(*shape, d), "action": torch.randn(*shape, action_dim)}
        data |= {"reward_to_go": -torch.rand(*shape, 1), "in_success": torch.ones(*shape, 1).bool()}
        return TensorDict(data | {"next": {"latent": torch.randn(*shape, d)}}, list(shape), device=device)

    def step(loss: nn.Module, key: str, rows: TensorDict, precision: str) -> Callable[[], object]:
        optimizer = torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], lr=1e-4, fused=True)

        def take() -> None:
            with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
                value = loss(rows)[key]
            optimizer.zero_grad()
            value.backward()
            optimizer.step()

        return take

    def loop(sizes: Sequence[int], inputs: Tensor, error: Callable[[Tensor, int], Tensor]) -> Callable[[], object]:
        networks = [network.to(device) for network in plain_members(sizes, members)]
        optimizers = [torch.optim.Adam(network.parameters(), lr=1e-4) for network in networks]

        def take() -> None:
            for m, (network, optimizer) in enumerate(zip(networks, optimizers, strict=True)):
                value = error(network(inputs[:, m]), m)
                optimizer.zero_grad()
                value.backward()
                optimizer.step()

        return take

    rows = tensors(batch, members)
    z, action, reached, returns = rows["latent"], rows["action"], rows["next", "latent"], rows["reward_to_go"]

    def likelihood(out: Tensor, m: int) -> Tensor:
        delta, log_scale = out.chunk(2, -1)
        normal = torch.distributions.Normal(z[:, m] + delta, log_scale.clamp(-8, 4).exp())
        return -normal.log_prob(reached[:, m]).mean()

    dynamics = f"dynamics step, {name}, loop over members"
    values = f"value step, {name}, loop over members"
    if plain:
        sizes = [d + action_dim, *preset.agent.dynamics_hidden, 2 * d]
        bench.time(dynamics, loop(sizes, torch.cat([z, action], -1), likelihood))
        sizes = [d, *preset.agent.value_hidden, 1]
        bench.time(values, loop(sizes, z, lambda out, m: (out - returns[:, m]).square().mean()))
    for precision in ("fp32", "bf16"):
        loss: nn.Module = EnsembleDynamicsLoss(agent.dynamics, bootstrap=True)
        take = step(loss, "loss_dynamics", rows, precision)
        bench.time(f"dynamics step, {name}, {precision}", take, against=dynamics)
        take = step(OfflineValueLoss(agent.value, bootstrap=True), "loss_value", rows, precision)
        bench.time(f"value step, {name}, {precision}", take, against=values)
        loss = SafeSetLoss(agent.safe_set, gamma=0.3)
        target = HardUpdate(loss, value_network_update_interval=99)
        take = step(loss, "loss_safe_set", tensors(batch), precision)
        bench.time(f"safe set step, {name}, {precision}", lambda: (take(), target.step()))  # noqa: B023


def vae(bench: Bench, preset: DictConfig, spec: Bounded, frames: Tensor, device: torch.device, *, plain: bool) -> None:
    """VAE steps at batch 256 and at the preset's, and encoding."""
    agent = LS3Agent(spec.shape[-1], in_channels=frames.shape[1], **agent_options(preset, spec)).to(device)
    slow = PlainVAE(agent).to(device)
    for half in (agent.encoder, agent.decoder):
        half.to(memory_format=torch.channels_last)
    loss = VAELoss(agent.encoder, agent.decoder)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-4, fused=True)
    plain_optimizer = torch.optim.Adam(slow.parameters(), lr=1e-4)

    for batch in sorted({256, preset.vae.batch_size}):
        pixels = frames[torch.randint(len(frames), (batch,))].to(device)

        def fast_step(pixels: Tensor = pixels, *, autocast: bool = False) -> None:
            with torch.autocast(device.type, torch.bfloat16, enabled=autocast):
                value = loss(TensorDict({"pixels": pixels}, [len(pixels)]))["loss_vae"]
            optimizer.zero_grad()
            value.backward()
            optimizer.step()

        def plain_step(pixels: Tensor = pixels) -> None:
            value = slow.loss(pixels)
            plain_optimizer.zero_grad()
            value.backward()
            plain_optimizer.step()

        base = f"VAE step of {batch}, plain"
        if plain:
            bench.time(base, plain_step)
        bench.time(f"VAE step of {batch}, fp32", fast_step, against=base)
        bench.time(f"VAE step of {batch}, bf16", lambda: fast_step(autocast=True), against=base)
    pixels = frames[:512].to(device)
    with torch.no_grad():
        encode = TensorDict({"pixels": pixels}, [len(pixels)])
        bench.time("encoding a frame", lambda: agent.encoder(encode), per=len(pixels))


def environment_steps(bench: Bench, domain: str, worlds: int, device: torch.device) -> None:
    """Steps of a domain with pixels, and how many of them a second of one core makes."""
    env = ls3_envs.make(domain, num_envs=worlds, seed=0, device=device)
    td = env.rand_action(env.reset())
    busy, steps = time.process_time(), 0

    def step() -> None:
        nonlocal steps
        steps += worlds
        env.base_env._clock.zero_()  # no episode ends here
        env.step(td)

    bench.time(f"step with pixels, {domain}, each of {worlds}", step, per=worlds)
    bench.rows[-1]["per_cpu_second"] = steps / (time.process_time() - busy)


def smoke_run(task: str) -> None:
    """The whole recipe, from demonstrations to pictures, as a user starts it."""
    with tempfile.TemporaryDirectory() as folder:
        recipe = Path(__file__).with_name("ls3.py")
        arguments = [f"task={task}", "preset=smoke", f"output={folder}/run"]
        subprocess.run([sys.executable, str(recipe), *arguments], check=True, capture_output=True)


def run(config: DictConfig) -> dict:
    """Run the benchmark.

    Args:
        config: the resolved configuration of ``conf/benchmark.yaml``.

    Returns:
        What is written to ``benchmark.json``.

    Raises:
        ValueError: without a preset: encoder and buffer are timed at the first one's sizes.
    """
    if not config.presets:
        raise ValueError("presets must name at least one preset, such as presets=[cpu]; got none.")
    device = choose_device(config.device)
    if config.threads:
        torch.set_num_threads(config.threads)
    presets = [compose("ls3", [f"task={config.task}", f"preset={name}"]) for name in config.presets]
    folder = RunFolder(config.output, config)
    bench = Bench(config.seconds)
    peaks = {str(t).removeprefix("torch."): matmul_peak(bench, t, device) for t in (torch.float32, torch.bfloat16)}

    env = ls3_envs.make(config.task, num_envs=1, seed=0)
    spec = env.action_spec
    flat = Bounded(low=spec.space.low[0], high=spec.space.high[0], shape=spec.shape[1:], device=device)
    for preset in presets:
        plans(bench, preset, flat, config.batches, device, plain=config.plain)
        with threads(1):  # as the recipes do
            updates(bench, preset, flat, device, plain=config.plain)
    episodes = ls3_envs.collect_offline(config.task, "success", episodes=8, seed=0)
    vae(bench, presets[0], flat, episodes["pixels"].flatten(0, 1), device, plain=config.plain)
    for name in config.domains:
        for worlds in config.batches:
            environment_steps(bench, name, worlds, device)
    buffer = TaggedReplayBuffer(2000, latent_dim=presets[0].agent.latent_dim)
    buffer.add(episodes, Tag.SUCCESS)
    buffer.encode(LS3Agent(flat.shape[-1], **agent_options(presets[0], flat)).encoder)
    bench.time("sampling 256 transitions for each of 5 members", lambda: buffer.sample(256, members=5))

    if config.smoke:
        bench.time("whole smoke run", lambda: smoke_run(config.task), once=True)

    for row in bench.rows:
        if "gflops" in row:
            peak = peaks["bfloat16" if row["what"].endswith("bf16") else "float32"] / 1e9
            row["share_of_peak"] = row["gflops"] / peak
    agreeing = {}
    if config.agent is not None:
        trained = LS3Agent.load(config.agent, device=device)
        frames = episodes["pixels"].flatten(0, 1)
        frames = frames[torch.linspace(0, len(frames) - 1, config.states).long()]
        for preset in presets:
            options = {str(key): value for key, value in preset.planner.items()}
            found = agreeing[preset.preset] = agreement(trained, options, flat, frames)
            console.print(
                f"bf16 for fp32, planner of {preset.preset}: value off by {found['value_error']:.2%} in the median, "
                f"other feasibility for {found['feasibility']:.2%} of candidates"
            )
    out = {
        "agreement": agreeing,
        "hardware": hardware(device),
        "peak_gflops": {name: peak / 1e9 for name, peak in peaks.items()},
        "rows": bench.rows,
    }
    folder.write_json("benchmark.json", out)
    folder.close()
    show(bench.rows, Path(config.output))
    return out


@hydra.main(version_base="1.3", config_path="conf", config_name="benchmark")
def main(config: DictConfig) -> None:
    """Entry point."""
    OmegaConf.resolve(config)
    run(config)


if __name__ == "__main__":
    main()
