"""VAETrainer: encoder and decoder learn the latents that all else is learnt on (equation (1))."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.record.loggers import Logger

from ls3_torchrl.agent import LS3Agent
from ls3_torchrl.data import TaggedReplayBuffer, random_perspective
from ls3_torchrl.exceptions import DivergenceError
from ls3_torchrl.halves import Halves
from ls3_torchrl.objectives import LatentPredictionLoss, VAELoss
from ls3_torchrl.options.training import VAEOptions
from ls3_torchrl.trainers.checks import require_actions_of
from ls3_torchrl.trainers.progress import progress_bar
from ls3_torchrl.trainers.steps import LOG_INTERVAL, is_finite, log_scalars, wants_bf16
from ls3_torchrl.trainers.vae_gradient import TARGET, VAEGradient, in_channel_order, in_memory_order, reordered

_log = logging.getLogger(__name__)
PHASE = "VAE"
#: Squared error, as a fraction of the images' variance, above which a VAE knows little more than the mean image.
_COLLAPSED = 0.6


def warmed_up(fraction: float, warmup: Sequence[float] | None) -> float:
    """What a weight has risen to after a fraction of the steps: from 0 at the start of ``warmup`` to 1 at its end."""
    if warmup is None:
        return 1.0
    start, end = warmup
    return min(max((fraction - start) / (end - start), 0.0), 1.0)


def load_vae(path: str | Path, **expected: Any) -> LS3Agent:
    """An agent whose encoder and decoder can be trained on, from its file.

    Args:
        path: written by :meth:`~ls3_torchrl.LS3Agent.save`.
        expected: fields of the architecture that the file must agree with.

    Raises:
        ValueError: for a compact file, which has no decoder, and as :meth:`~ls3_torchrl.LS3Agent.load` does.

    Example:
        >>> from tempfile import mkdtemp
        >>> path = LS3Agent(2, latent_dim=8).save(f"{mkdtemp()}/agent.pt")
        >>> load_vae(path, latent_dim=8).decoder is None
        False
    """
    agent = LS3Agent.load(path, **expected)
    if agent.decoder is None:
        raise ValueError(
            f"{path} is a compact file, whose agent has no decoder, so that its VAE cannot be taken. Give the "
            "agent.pt of the run that trained it."
        )
    return agent


class VAETrainer:
    """Trains an agent's encoder and decoder on all frames of a buffer, freezes them, and encodes every frame.

    Args:
        agent: its encoder and decoder are trained in place, and its dynamics with them where
            ``options.prediction_weight`` asks for it.
        buffer: filled with the offline data.
        options: how.
        logger: one of TorchRL's; gets every metric as ``VAE/name``.
        progress: show progress bars.
        after_step: called after every gradient step and every batch of frames that is encoded; see
            :class:`~ls3_torchrl.trainers.Learner`.

    Raises:
        ValueError: for an agent whose encoder is not a VAE's or that has no decoder; an encoder that is trained already
            needs none of this, but ``buffer.encode(agent.encoder)``.
        DivergenceError: by :meth:`train`, when the loss or a gradient is not finite.

    Example:
        >>> from tensordict import TensorDict
        >>> step = {"reward": -torch.ones(9, 1), "pixels": torch.zeros(9, 3, 64, 64, dtype=torch.uint8)}
        >>> step |= {k: torch.zeros(9, 1, dtype=torch.bool) for k in ("constraint", "success")}
        >>> episode = TensorDict({"pixels": step["pixels"], "action": torch.zeros(9, 2), "next": step}, [9])
        >>> buffer = TaggedReplayBuffer(capacity=100, latent_dim=8)
        >>> buffer.add(episode, "success")
        >>> agent = LS3Agent(action_dim=2, latent_dim=8)
        >>> VAETrainer(agent, buffer, VAEOptions(steps=2, batch_size=4), progress=False).train()
        >>> buffer.sample(4)["latent"].shape
        torch.Size([4, 8])
    """

    def __init__(
        self,
        agent: LS3Agent,
        buffer: TaggedReplayBuffer,
        options: VAEOptions | None = None,
        *,
        logger: Logger | None = None,
        progress: bool = True,
        after_step: Callable[[], object] | None = None,
    ) -> None:
        self.agent, self.buffer = agent, buffer
        self.options = options = VAEOptions() if options is None else options
        self.logger, self.progress, self.after_step = logger, progress, after_step
        if agent.encoder is None or agent.decoder is None:
            raise ValueError(
                "VAETrainer needs an agent with an encoder and a decoder. An encoder that is trained already needs no "
                "VAETrainer: call buffer.encode(agent.encoder)."
            )
        self.steps = 0
        self._error = 0.0  # of reconstruction, as it was last logged
        self._checked = self._rescaled = False
        #: Whether all of it is done: encoder and decoder are trained and frozen, and every frame is encoded.
        self.finished = False
        for half in (agent.encoder, agent.decoder):
            half.to(memory_format=torch.channels_last)
        self.loss = VAELoss(agent.encoder, agent.decoder, beta=options.beta)
        self._learnt = list(self.loss.parameters())
        self.prediction: LatentPredictionLoss | None = None
        if options.prediction_weight:
            self.prediction = LatentPredictionLoss(agent.encoder, agent.dynamics)
            keys = buffer.keys
            self.prediction.set_keys(pixels=keys.observation, action=keys.action, next_pixels=keys.next_observation)
            self._learnt += agent.dynamics.parameters()
        self.device = next(agent.parameters()).device
        self._bf16 = wants_bf16(options.autocast, self.device)
        self._learnt = [parameter for parameter in self._learnt if parameter.requires_grad]
        self._gradient = VAEGradient(self.loss, self.prediction, self._learnt, bf16=self._bf16)
        self.optimizer = torch.optim.Adam(self._gradient.leaves, lr=options.lr, fused=True)
        self.schedule: torch.optim.lr_scheduler.LRScheduler = (
            torch.optim.lr_scheduler.OneCycleLR(self.optimizer, options.lr, total_steps=options.steps, pct_start=0.1)
            if options.schedule == "onecycle"
            else torch.optim.lr_scheduler.ConstantLR(self.optimizer, factor=1.0)
        )

    def train(self) -> None:
        """Train what is left of the steps, or take the checkpoint's encoder and decoder; freeze both, encode.

        Raises:
            ValueError: for actions in the buffer that are not those of the agent: all else would be in vain.
        """
        require_actions_of(self.agent, self.buffer)
        if self.options.checkpoint is not None:
            self._take_checkpoint(self.options.checkpoint)
        else:
            self._minimise()
            if not self._checked:
                self._warn_of_collapse(self._error)
            self._checked = True
        self.encode()
        if self.prediction is not None and self.options.checkpoint is None and not self._rescaled:
            self._rescale()
        self.finished = True

    def _rescale(self) -> None:
        """Measure the latents in units of their own spread; the prediction term leaves their scale open."""
        halves = self.agent.encoder, self.agent.decoder
        if not all(hasattr(half, "rescale") for half in halves):
            self._rescaled = True
            return
        spread = float(self.buffer.transitions.storage[:]["loc"].std(0).square().mean().sqrt())
        if not spread > 0.0:
            raise ValueError(
                "All latents are alike, and have no spread to be divided by. Look at the images: do they show anything "
                "that moves?"
            )
        for half in halves:
            half.rescale(1.0 / spread)
        self._rescaled = True
        self.encode()

    def encode(self) -> None:
        """Freeze encoder and decoder, and encode every frame of the buffer."""
        for half in (self.agent.encoder, self.agent.decoder):
            half.requires_grad_(False)
        with progress_bar(len(self.buffer.frames), "Encoding", unit="frame", enabled=self.progress) as bar:

            def advance(done: int, _: int) -> None:
                bar.update(done - bar.n)
                if self.after_step is not None:
                    self.after_step()

            try:
                self.buffer.encode(self.agent.encoder, progress=advance)
            except FloatingPointError as error:
                raise DivergenceError(PHASE, self.steps, {}, None, "Lower VAEOptions.lr.") from error

    def _take_checkpoint(self, path: str) -> None:
        """Take encoder and decoder of a trained agent, and dynamics that were trained along with these alone."""
        shape = self.agent.architecture
        trained = load_vae(
            path, in_channels=shape.in_channels, latent_dim=shape.latent_dim, background=shape.background
        )
        for half, other in ((self.agent.encoder, trained.encoder), (self.agent.decoder, trained.decoder)):
            half.load_state_dict(other.state_dict())
        if trained.stage == "vae" and trained.architecture == shape:
            self.agent.dynamics.load_state_dict(trained.dynamics.state_dict())

    def _minimise(self) -> None:
        options = self.options
        self._gradient.follow()
        if self.steps == 0 and getattr(self.agent.decoder, "background", None) is not None:
            self.agent.decoder.set_background(self.buffer.mean_frame())
        with (
            Halves() as both,
            progress_bar(options.steps, PHASE, done=self.steps, enabled=self.progress) as bar,
        ):
            while self.steps < options.steps:
                losses = self._step(both)
                if self.steps % LOG_INTERVAL == 0 or self.steps == options.steps - 1:
                    scalars = {key: item.item() for key, item in losses.items()}
                    log_scalars(self.logger, PHASE, self.steps, scalars)
                    self._error = scalars["reconstruction"]
                    bar.set_postfix_str(f"error {self._error:.2e}", refresh=False)
                self.steps += 1
                bar.update()
                if self.after_step is not None:
                    self.after_step()

    def _step(self, both: Halves) -> TensorDictBase:
        options = self.options
        warmth = warmed_up((self.steps + 1) / options.steps, options.warmup)
        self.loss.beta = options.beta * warmth
        weight = warmth * options.prediction_weight
        batch = self._sample(predicts=weight > 0.0)
        noise = torch.randn(options.batch_size, self.buffer.latent_dim, device=self.device)
        losses, value = self._gradient(batch, noise, weight, both)
        if not is_finite(self._gradient.leaves, value):
            scalars = {key: item.item() for key, item in losses.items()}
            raise DivergenceError(PHASE, self.steps, scalars, batch, "Lower VAEOptions.lr.")
        self.optimizer.step()
        self.schedule.step()
        return losses

    def _sample(self, *, predicts: bool) -> TensorDictBase:
        """Images of equation (1), from all frames; for the prediction term also what actions lead from and to."""
        options = self.options
        images = self.buffer.sample_frames(options.batch_size).get(self.buffer.keys.observation)
        batch = TensorDict({TARGET: self._enlarge(images)}, [options.batch_size])
        if predicts:
            steps = options.prediction_horizon
            batch.update(
                self.buffer.sample_frame_transitions(
                    options.batch_size, without="after_violation", steps=steps if steps > 1 else None
                )
            )
        return batch.to(self.device)

    def _enlarge(self, pixels: Tensor) -> Tensor:
        """Images as if drawn from a dataset that shifts and perspectives have enlarged (section 1.3.4)."""
        goal, there = self.options.enlarge_to, len(self.buffer.frames)
        if goal is None or goal <= there:
            return pixels
        changed = torch.rand(len(pixels)) > there / goal
        if changed.any():
            pixels = pixels.clone()
            pixels[changed] = random_perspective(pixels[changed])
        return pixels

    def _warn_of_collapse(self, error: float) -> None:
        """Say so when the VAE draws little more than the mean of all images: nothing can be learnt from its latents."""
        images = self.buffer.sample_frames(512)[self.buffer.keys.observation].float() / 255.0
        variance = float((images - images.mean(0)).square().mean())
        if error > _COLLAPSED * variance:
            _log.warning(
                "The VAE reconstructs little more than the mean image: its squared error is %.1e, that of the mean "
                "image %.1e. Try more steps, a higher learning rate, or a later warmup.",
                error,
                variance,
            )

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimiser, schedule and step."""
        return {
            "loss": self.loss.state_dict(),
            "dynamics": self.agent.dynamics.state_dict(),
            "optimizer": reordered(self.optimizer.state_dict(), in_channel_order),
            "schedule": self.schedule.state_dict(),
            "steps": self.steps,
            "error": self._error,
            "checked": self._checked,
            "rescaled": self._rescaled,
            "finished": self.finished,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        self.loss.load_state_dict(state_dict["loss"])
        for parameter in self._learnt:
            parameter.requires_grad_(True)  # it may have been frozen meanwhile
        self.agent.dynamics.load_state_dict(state_dict["dynamics"])
        # Contiguous, which the fused Adam takes them to be.
        ordered = reordered(state_dict["optimizer"], lambda value: in_memory_order(value).contiguous())
        self.optimizer.load_state_dict(ordered)
        self.schedule.load_state_dict(state_dict["schedule"])
        self.steps, self._error = state_dict["steps"], state_dict["error"]
        self._checked, self._rescaled = state_dict["checked"], state_dict["rescaled"]
        self.finished = state_dict["finished"]
