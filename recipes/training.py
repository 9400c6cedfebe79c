"""The phases of LS³'s learning: VAE, offline models, online updates."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import HardUpdate, LossModule

from common import RunFolder, console, progress
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import ALL_TAGS, VALUE_TAGS, Tag, TaggedReplayBuffer, random_perspective, random_resized_crop
from ls3_torchrl.objectives import (
    ClassifierLoss,
    EnsembleDynamicsLoss,
    LatentPredictionLoss,
    OfflineValueLoss,
    SafeSetLoss,
    TD1ValueLoss,
    VAELoss,
)
from ls3_torchrl.planners.layers import fastest_precision

LOG_EVERY = 100


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Compute on ``count`` cores; on as many as before when ``None``."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def wants_bf16(setting: bool | str, device: torch.device) -> bool:
    """What a setting ``autocast`` of true, false or auto means on a device."""
    return fastest_precision(device.type) == "bf16" if setting == "auto" else bool(setting)


def warmed_up(share: float, warmup: Sequence[float] | None) -> float:
    """What a weight has risen to after a share of the steps: from 0 at the start of ``warmup`` to 1 at its end."""
    if warmup is None:
        return 1.0
    start, end = warmup
    return min(max((share - start) / (end - start), 0.0), 1.0)


def cooled_down(share: float, cooldown: float) -> float:
    """What a learning rate has fallen to after a share of a phase's steps: 1, then linearly to 0 at the end."""
    return 1.0 if share < 1.0 - cooldown else (1.0 - share) / cooldown


class Term(NamedTuple):
    """A second loss on the same network, with batches of its own.

    Attributes:
        weight: of its value in the sum.
        loss: the loss module.
        sample: draws a batch for it.
    """

    weight: float
    loss: LossModule
    sample: Callable[[], TensorDictBase]


class Learner:
    """One loss, its optimiser, its lagged target and where its batches come from.

    Args:
        name: the loss is ``loss_{name}``.
        loss: a TorchRL loss module.
        sample: draws a batch.
        lr: Adam's learning rate.
        target_interval: gradient steps between copies to the target network; ``None`` without one.
        beside: a second loss that is added to the first.
        bf16: compute the losses under bf16 autocast; weights, gradients and optimiser stay fp32.
        cooldown: share of a phase's steps, at its end, over which the learning rate falls linearly to nothing: the
            last few batches then sway what the agent acts by no more than the others.
    """

    def __init__(
        self,
        name: str,
        loss: LossModule,
        sample: Callable[[], TensorDictBase],
        *,
        lr: float,
        target_interval: int | None = None,
        beside: Term | None = None,
        bf16: bool = False,
        cooldown: float = 0.0,
    ) -> None:
        self.name, self.loss, self.sample, self.beside, self.bf16 = name, loss, sample, beside, bf16
        self.lr, self.cooldown = lr, cooldown
        self.parameters = [p for p in loss.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(self.parameters, lr=lr, fused=True)
        self.target_interval = target_interval
        self.target: HardUpdate | None = None
        self.steps = 0

    def evaluate(self) -> tuple[TensorDictBase, Tensor]:
        """What the losses write for a new batch, and the sum that is descended."""
        rows = self.sample()
        second = None if self.beside is None else self.beside.sample()
        with torch.autocast(self.parameters[0].device.type, torch.bfloat16, enabled=self.bf16):
            losses = self.loss(rows)
            value = losses[f"loss_{self.name}"]
            if self.beside is not None:
                beside = self.beside.loss(second)[f"loss_{self.name}"]
                losses["beside"] = beside.detach()
                value = value + self.beside.weight * beside
        return losses, value

    def train(self, steps: int, what: str, run: RunFolder) -> None:
        """Take ``steps`` gradient steps."""
        if self.target_interval is not None and self.target is None:
            # Made at the first step, not before: it copies the network to its target, and another learner may have
            # trained that network meanwhile (reward-to-go before TD-1). It copies again at calls k + 1, 2(k + 1), …,
            # so k is one less than the interval that is meant.
            self.target = HardUpdate(self.loss, value_network_update_interval=self.target_interval - 1)
        # Networks of this size lose more by waking a second core than they gain by it.
        with threads(1), progress(steps, what) as bar:
            for i in range(steps):
                for group in self.optimizer.param_groups:
                    group["lr"] = self.lr * cooled_down(i / steps, self.cooldown)
                losses, value = self.evaluate()
                self.optimizer.zero_grad()
                value.backward()
                self.optimizer.step()
                if self.target is not None:
                    self.target.step()
                self.steps += 1
                if i % LOG_EVERY == 0 or i == steps - 1:
                    scalars = {key: item.item() for key, item in losses.items()}
                    if not all(map(torch.isfinite, losses.values())):
                        raise FloatingPointError(
                            f"{what} diverged: {scalars} at step {self.steps}. Lower its learning rate."
                        )
                    bar.set_postfix_str(f"loss {value.item():.4g}", refresh=False)
                    run.log(what, self.steps, **scalars)
                bar.update()


class Training:
    """All learners of an agent on one buffer, and the phases in the paper's order.

    Args:
        agent: its networks are trained in place.
        buffer: filled with the offline data.
        config: the recipe's configuration.
        run: where metrics go.
        horizon: steps in an episode.
    """

    def __init__(
        self, agent: LS3Agent, buffer: TaggedReplayBuffer, config: DictConfig, run: RunFolder, *, horizon: int = 100
    ) -> None:
        self.agent, self.buffer, self.config, self.run, self.horizon = agent, buffer, config, run, horizon
        optim, loss = config.optim, config.loss
        batch, interval, bootstrap = optim.batch_size, optim.target_interval, optim.bootstrap
        self._left_out = None if loss.frozen_dynamics else "frozen"

        def draw(tags: tuple, members: int | None = None, **options: Any) -> Callable[[], TensorDictBase]:
            return lambda: buffer.sample(batch, tags=tags, members=members if bootstrap else None, **options)

        how: dict[str, Any] = {
            "bf16": wants_bf16(optim.autocast, next(agent.parameters()).device),
            "cooldown": optim.cooldown,
        }
        members, values = agent.dynamics.num_members, agent.value.num_members
        goal = ClassifierLoss(agent.goal, name="goal")
        goal.set_keys(label=("next", "success"))
        td1: dict[str, Any] = {
            "gamma": loss.gamma,
            "zero_at_goal": loss.zero_at_goal,
            "monte_carlo": loss.monte_carlo,
            "bootstrap": bootstrap,
        }
        self.dynamics = Learner(
            "dynamics",
            EnsembleDynamicsLoss(agent.dynamics, bootstrap=bootstrap, steps=loss.dynamics_horizon),
            draw(
                ALL_TAGS,
                members,
                without=self._left_out,
                steps=loss.dynamics_horizon if loss.dynamics_horizon > 1 else None,
            ),
            lr=optim.dynamics_lr,
            **how,
        )
        failures = None
        if loss.failure_weight > 0.0:
            failures = Term(loss.failure_weight, OfflineValueLoss(agent.value, bootstrap=bootstrap), self._failures)
        self.value = Learner(
            "value",
            OfflineValueLoss(agent.value, bootstrap=bootstrap),
            draw(VALUE_TAGS, values),
            lr=optim.lr,
            **how,
            beside=failures,
        )
        self.value_td = Learner(
            "value",
            TD1ValueLoss(agent.value, **td1),
            draw(VALUE_TAGS, values),
            lr=optim.lr,
            **how,
            target_interval=interval,
        )
        self.safe_set = Learner(
            "safe_set",
            SafeSetLoss(agent.safe_set, gamma=loss.gamma_safe_set),
            self._safe_or_not,
            lr=optim.lr,
            **how,
            target_interval=interval,
        )
        self.constraint = Learner("constraint", ClassifierLoss(agent.constraint), draw(ALL_TAGS), lr=optim.lr, **how)
        self.goal = Learner("goal", goal, draw(ALL_TAGS), lr=optim.lr, **how)
        for name in loss.mean_latents:
            keys = {"latent": "loc", "next_latent": ("next", "loc")}
            getattr(self, name).loss.set_keys(**(keys if name == "dynamics" else {"latent": ("next", "loc")}))

    def _failures(self) -> TensorDictBase:
        """States of the violating demonstrations, labelled with the value of failure."""
        optim = self.config.optim
        members = self.agent.value.num_members if optim.bootstrap else 1
        count = max(optim.batch_size // 4, 1) * members
        rows = self.buffer.sample(count, tags=[Tag.CONSTRAINT])
        if self.config.loss.failure_rows == "violating":
            found = rows["next", "constraint"].flatten().nonzero().flatten()
            if len(found):
                # Those that were found stand in for the others: the batch keeps its size.
                rows = rows[found[torch.arange(count, device=found.device) % len(found)]]
                rows.set("latent", rows["next", "latent"])
        rows = rows.reshape(-1, members) if optim.bootstrap else rows
        loss, horizon = self.config.loss, self.horizon
        value = loss.failure_value
        if value is None:
            value = -(1.0 - loss.gamma**horizon) / (1.0 - loss.gamma) if loss.gamma < 1.0 else -float(horizon)
        return rows.set("reward_to_go", torch.full_like(rows["reward_to_go"], value))

    def _safe_or_not(self) -> TensorDictBase:
        """Rows of all data; how much those of undecided online episodes count is a setting."""
        rows = self.buffer.sample(self.config.optim.batch_size, tags=ALL_TAGS)
        weight = self.config.loss.undecided_weight
        if weight != 1.0:
            undecided = rows["undecided"] & (rows["tag"] == int(Tag.ONLINE))
            rows.set("safe_set_weight", torch.where(undecided, weight, 1.0))
        return rows

    def train_vae(self) -> None:
        """Train encoder and decoder on all frames, freeze them, and encode every frame."""
        options, agent = self.config.vae, self.agent
        for half in (agent.encoder, agent.decoder):
            half.to(memory_format=torch.channels_last)
        if agent.decoder.background is not None:
            agent.decoder.set_background(self.buffer.mean_image())
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
                return self.buffer.sample_pixels(count)
            steps = options.prediction_horizon
            return self.buffer.sample_pixel_transitions(
                count, without=self._left_out, steps=steps if steps > 1 else None
            )

        with threads(options.threads), progress(options.steps, "VAE") as bar:
            for i in range(options.steps):
                warmth = warmed_up((i + 1) / options.steps, options.warmup)
                loss.beta = options.beta * warmth
                batch = draw(options.batch_size).to(device)
                target = batch["vae_target"] = self._enlarge(batch["pixels"])
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
                    self.run.log("VAE", i, **scalars)
                bar.update()
        self._warn_of_collapse(scalars["reconstruction"])
        agent.encoder.requires_grad_(False)
        agent.decoder.requires_grad_(False)
        self._encode()
        if options.unit_scale:
            spread = float(self.buffer.latents.storage[:]["loc"].std(0).square().mean().sqrt())
            agent.encoder.rescale(1.0 / spread)
            agent.decoder.rescale(1.0 / spread)
            self._encode()

    def _enlarge(self, pixels: Tensor) -> Tensor:
        """Images as if drawn from a dataset that shifts and perspectives have enlarged to ``vae.enlarge_to`` images."""
        goal = self.config.vae.enlarge_to
        if goal is None or goal <= len(self.buffer.pixels):
            return pixels
        changed = torch.rand(len(pixels)) > len(self.buffer.pixels) / goal
        if changed.any():
            pixels = pixels.clone()
            pixels[changed] = random_perspective(pixels[changed])
        return pixels

    def _warn_of_collapse(self, error: float) -> None:
        """Say so when the VAE draws little more than the mean of all images: nothing can be learnt from its latents."""
        if self.config.vae.reduction != "mean":
            return
        images = self.buffer.sample_pixels(512)["pixels"].float() / 255.0
        variance = float((images - images.mean(0)).square().mean())
        if error > 0.6 * variance:
            console.print(
                f"[bold red]The VAE hardly sees what moves[/bold red]: its squared error is {error:.1e}, that of the "
                f"mean image {variance:.1e}. Try more vae.steps, a warmer vae.lr, or a later vae.warmup."
            )

    def _encode(self) -> None:
        """Encode every frame."""
        with progress(len(self.buffer.pixels), "Encoding", "frame") as bar:
            self.buffer.encode(self.agent.encoder, progress=lambda done, _: bar.update(done - bar.n))

    def train_offline(self) -> None:
        """Train the latent models on the offline data (equations (2), (3), (4), (5) and the classifiers)."""
        steps = self.config.offline
        self.dynamics.train(steps.dynamics_steps, "Dynamics", self.run)
        self.value.train(steps.value_steps, "Value, reward-to-go", self.run)
        self.value_td.train(steps.value_td_steps, "Value, TD-1", self.run)
        self._train_classifiers(steps.classifier_steps)

    def train_online(self) -> None:
        """One update on all data, after new episodes."""
        steps = self.config.online
        self.dynamics.train(steps.dynamics_steps, "Dynamics", self.run)
        self.value_td.train(steps.value_td_steps, "Value, TD-1", self.run)
        self._train_classifiers(steps.classifier_steps)

    def _train_classifiers(self, steps: int) -> None:
        self.safe_set.train(steps, "Safe set", self.run)
        self.constraint.train(steps, "Constraint", self.run)
        self.goal.train(steps, "Goal", self.run)
