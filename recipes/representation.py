"""The first phase: encoder and decoder learn the latents that all else is learnt on (equation (1))."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from common import RunFolder, console, progress
from learning import LOG_EVERY, threads, wants_bf16
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import TaggedReplayBuffer, random_perspective, random_resized_crop
from ls3_torchrl.objectives import LatentPredictionLoss, VAELoss


def warmed_up(share: float, warmup: Sequence[float] | None) -> float:
    """What a weight has risen to after a share of the steps: from 0 at the start of ``warmup`` to 1 at its end."""
    if warmup is None:
        return 1.0
    start, end = warmup
    return min(max((share - start) / (end - start), 0.0), 1.0)


def enlarge(pixels: Tensor, buffer: TaggedReplayBuffer, goal: int | None) -> Tensor:
    """Images as if drawn from a dataset that shifts and perspectives have enlarged to ``goal`` images."""
    if goal is None or goal <= len(buffer.frames):
        return pixels
    changed = torch.rand(len(pixels)) > len(buffer.frames) / goal
    if changed.any():
        pixels = pixels.clone()
        pixels[changed] = random_perspective(pixels[changed])
    return pixels


def warn_of_collapse(error: float, buffer: TaggedReplayBuffer) -> None:
    """Say so when the VAE draws little more than the mean of all images: nothing can be learnt from its latents."""
    images = buffer.sample_frames(512)["pixels"].float() / 255.0
    variance = float((images - images.mean(0)).square().mean())
    if error > 0.6 * variance:
        console.print(
            f"[bold red]The VAE hardly sees what moves[/bold red]: its squared error is {error:.1e}, that of the "
            f"mean image {variance:.1e}. Try more vae.steps, a warmer vae.lr, or a later vae.warmup."
        )


def encode(agent: LS3Agent, buffer: TaggedReplayBuffer) -> None:
    """Encode every frame."""
    with progress(len(buffer.frames), "Encoding", "frame") as bar:
        buffer.encode(agent.encoder, progress=lambda done, _: bar.update(done - bar.n))


def take_vae(agent: LS3Agent, buffer: TaggedReplayBuffer, path: str | Path) -> None:
    """Take encoder and decoder of a trained agent, frozen, and encode every frame."""
    shape = agent.architecture
    trained = LS3Agent.load(
        path, in_channels=shape.in_channels, latent_dim=shape.latent_dim, background=shape.background
    )
    for half, other in ((agent.encoder, trained.encoder), (agent.decoder, trained.decoder)):
        half.load_state_dict(other.state_dict())
        half.requires_grad_(False)
    encode(agent, buffer)


def train_vae(agent: LS3Agent, buffer: TaggedReplayBuffer, config: DictConfig, run: RunFolder) -> None:
    """Train encoder and decoder on all frames, freeze them, and encode every frame; or take them from ``vae.agent``.

    Args:
        agent: its encoder and decoder are trained, and its dynamics with them where ``vae.prediction_weight`` asks.
        buffer: filled with the offline data.
        config: the recipe's configuration.
        run: where metrics go.
    """
    options = config.vae
    if options.agent is not None:
        take_vae(agent, buffer, options.agent)
        return
    for half in (agent.encoder, agent.decoder):
        half.to(memory_format=torch.channels_last)
    if agent.decoder.background is not None:
        agent.decoder.set_background(buffer.mean_frame())
    loss = VAELoss(agent.encoder, agent.decoder, beta=options.beta, reduction=options.reduction)
    loss.set_keys(pixels="vae_input", target="vae_target")
    predictability = LatentPredictionLoss(agent.encoder, agent.dynamics)
    weight = options.prediction_weight
    learnt = [*loss.parameters(), *(agent.dynamics.parameters() if weight else ())]
    optimizer = torch.optim.Adam(learnt, lr=options.lr, fused=True)
    schedule = (
        torch.optim.lr_scheduler.OneCycleLR(optimizer, options.lr, total_steps=options.steps, pct_start=0.1)
        if options.schedule == "onecycle"
        else torch.optim.lr_scheduler.ConstantLR(optimizer, factor=1.0)
    )
    device = next(agent.parameters()).device
    autocast = wants_bf16(options.autocast, device)

    def draw(count: int) -> TensorDictBase:
        if not weight:
            return buffer.sample_frames(count)
        steps, left_out = options.prediction_horizon, None if config.loss.frozen_dynamics else "after_violation"
        return buffer.sample_frame_transitions(count, without=left_out, steps=steps if steps > 1 else None)

    with threads(options.threads), progress(options.steps, "VAE") as bar:
        for i in range(options.steps):
            warmth = warmed_up((i + 1) / options.steps, options.warmup)
            loss.beta = options.beta * warmth
            batch = draw(options.batch_size).to(device)
            target = batch["vae_target"] = enlarge(batch["pixels"], buffer, options.enlarge_to)
            crop = options.crop_scale
            batch["vae_input"] = target if crop is None else random_resized_crop(target, scale=tuple(crop))
            with torch.autocast(device.type, torch.bfloat16, enabled=autocast):
                losses = loss(batch)
                value = losses["loss_vae"]
                if weight and warmth:
                    losses["prediction"] = predictability(batch)["loss_prediction"]
                    value = value + warmth * weight * losses["prediction"]
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
            schedule.step()
            if i % LOG_EVERY == 0 or i == options.steps - 1:
                scalars = {key: item.item() for key, item in losses.items()}
                if not all(map(torch.isfinite, losses.values())):
                    raise FloatingPointError(f"The VAE diverged: {scalars} at step {i}. Lower vae.lr.")
                bar.set_postfix_str(f"error {scalars['reconstruction']:.2e}", refresh=False)
                run.log("VAE", i, **scalars)
            bar.update()
    if options.reduction == "mean":
        warn_of_collapse(scalars["reconstruction"], buffer)
    agent.encoder.requires_grad_(False)
    agent.decoder.requires_grad_(False)
    encode(agent, buffer)
    if options.unit_scale:
        spread = float(buffer.transitions.storage[:]["loc"].std(0).square().mean().sqrt())
        agent.encoder.rescale(1.0 / spread)
        agent.decoder.rescale(1.0 / spread)
        encode(agent, buffer)
