"""The settings of training, each defined, documented and checked here; the defaults are the paper's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal

from ls3_torchrl._values import (
    require_at_least,
    require_choice,
    require_not_negative,
    require_positive,
    require_unit_interval,
)

Autocast = bool | Literal["auto"]
#: What can learn from the posteriors' means instead of samples.
MEAN_LATENTS = ("dynamics", "constraint", "goal")


def _require_count(value: int, low: int, name: str) -> None:
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name} must be a whole number of at least {low}, got {value!r}.")
    require_at_least(int(value), low, name)


def _require_number(value: float, name: str) -> None:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r}.")
    if not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value}.")


def _require_not_negative(value: float, name: str) -> None:
    _require_number(value, name)
    require_not_negative(value, name)


def _require_above_zero(value: float, name: str) -> None:
    _require_number(value, name)
    require_positive(value, name)


def _require_fraction(value: float, name: str) -> None:
    _require_number(value, name)
    require_unit_interval(value, name)


def _require_flags(options: Any, *names: str) -> None:
    for name in names:
        if not isinstance(getattr(options, name), bool):
            raise TypeError(f"{name} must be true or false, got {getattr(options, name)!r}.")


def _require_autocast(value: Autocast) -> None:
    if not (isinstance(value, bool) or value == "auto"):
        raise ValueError(f"autocast must be true, false or 'auto', got {value!r}.")


def _warmup(value: Sequence[float] | None) -> tuple[float, float] | None:
    """Rising fractions within [0, 1] as a tuple."""
    if value is None:
        return None
    allowed = "warmup must be null or rising fractions of the steps [start, end]"
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise TypeError(f"{allowed}, got {value!r}.")
    for bound in value:
        _require_number(bound, "warmup")
    pair = tuple(float(bound) for bound in value)
    if len(pair) != 2 or not 0.0 <= pair[0] < pair[1] <= 1.0:
        raise ValueError(f"{allowed}, got {list(value)}.")
    return pair


@dataclass(frozen=True)
class VAEOptions:
    """How encoder and decoder are trained (equation (1), section 1.1.1).

    Args:
        checkpoint: file of a trained agent whose encoder and decoder are taken, frozen; nothing is trained then.
        steps: gradient steps, at least 1.
        batch_size: images in a step, at least 1.
        lr: Adam's learning rate, above 0; the peak of a one-cycle schedule.
        schedule: of the learning rate, ``"constant"`` or ``"onecycle"``: it rises for a tenth of the steps, then falls.
        beta: β, at least 0 (Table 1: 1e-6).
        warmup: fractions [start, end] of the steps between which β and ``prediction_weight`` rise from 0; ``None``
            for none. With few latents and a large β a small moving object is otherwise never drawn.
        prediction_weight: weight, at least 0, of :class:`~ls3_torchrl.objectives.LatentPredictionLoss`: dynamics that
            are trained along must predict the next latent. The trained latents are then measured in units of their own
            spread, which this term leaves open, where encoder and decoder have a method ``rescale(factor)``. 0 is the
            paper.
        prediction_horizon: steps from the image that is predicted from to the one that is predicted, at least 1.
        enlarge_to: images of a dataset enlarged by random shifts and perspectives, from which batches seem drawn
            (section 1.3.4); ``None`` for the images as they are.
        autocast: bf16 autocast; ``"auto"`` where a short measurement finds it faster.

    Raises:
        ValueError: naming the field, what was received and what is allowed.
        TypeError: likewise, for a value of another type.

    Example:
        >>> VAEOptions(steps=2000, batch_size=64, lr=1e-3, schedule="onecycle").beta
        1e-06
    """

    checkpoint: str | None = None
    steps: int = 100_000
    batch_size: int = 256
    lr: float = 1e-4
    schedule: Literal["constant", "onecycle"] = "constant"
    beta: float = 1e-6
    warmup: tuple[float, float] | None = None
    prediction_weight: float = 0.0
    prediction_horizon: int = 1
    enlarge_to: int | None = None
    autocast: Autocast = "auto"

    def __post_init__(self) -> None:
        if self.checkpoint is not None and not isinstance(self.checkpoint, str | Path):
            raise TypeError(f"checkpoint must be null or the file of a trained agent, got {self.checkpoint!r}.")
        if self.checkpoint is not None and not Path(self.checkpoint).is_file():
            raise ValueError(
                f"checkpoint must be null or the file of a trained agent; there is none at {self.checkpoint}."
            )
        for name in ("steps", "batch_size", "prediction_horizon"):
            _require_count(getattr(self, name), 1, name)
        if self.enlarge_to is not None:
            _require_count(self.enlarge_to, 1, "enlarge_to")
        _require_above_zero(self.lr, "lr")
        require_choice(self.schedule, ("constant", "onecycle"), "schedule")
        _require_not_negative(self.beta, "beta")
        _require_not_negative(self.prediction_weight, "prediction_weight")
        _require_autocast(self.autocast)
        object.__setattr__(self, "warmup", _warmup(self.warmup))


@dataclass(frozen=True)
class OfflineOptions:
    """Gradient steps on the offline data, before the first online episode; each at least 0.

    Args:
        dynamics_steps: of equation (2).
        classifier_steps: of each of safe set (equation (5)), constraint and goal.
        value_steps: of equation (3), on the returns that were seen.
    """

    dynamics_steps: int = 10_000
    classifier_steps: int = 10_000
    value_steps: int = 10_000

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            _require_count(value, 0, name)


@dataclass(frozen=True)
class OnlineOptions:
    """Gradient steps of one update on all data, after new episodes; each at least 0.

    Args:
        dynamics_steps: of equation (2).
        classifier_steps: of each of safe set (equation (5)), constraint and goal.
        value_td_steps: of equation (4).
        fraction: least fraction of online transitions in a batch, in [0, 1): offline data of hundreds of episodes
            outnumber the new ones. 0 is the paper.
    """

    dynamics_steps: int = 512
    classifier_steps: int = 512
    value_td_steps: int = 2000
    fraction: float = 0.0

    def __post_init__(self) -> None:
        for name in ("dynamics_steps", "classifier_steps", "value_td_steps"):
            _require_count(getattr(self, name), 0, name)
        _require_number(self.fraction, "fraction")
        if not 0.0 <= self.fraction < 1.0:
            raise ValueError(f"fraction must lie in [0, 1), got {self.fraction}.")


@dataclass(frozen=True)
class OptimOptions:
    """How the latent models are optimised, all with Adam (section 1.2), ensembles with a batch for each member.

    Args:
        batch_size: transitions in a step, at least 1 (Table 1: 256).
        lr: learning rate of all but the dynamics, above 0.
        dynamics_lr: learning rate of the dynamics, above 0.
        target_interval: gradient steps between copies to the lagged networks of equations (4) and (5), at least 1.
        autocast: bf16 autocast; ``"auto"`` where a short measurement finds it faster.
    """

    batch_size: int = 256
    lr: float = 1e-4
    dynamics_lr: float = 1e-3
    target_interval: int = 100
    autocast: Autocast = "auto"

    def __post_init__(self) -> None:
        for name in ("batch_size", "target_interval"):
            _require_count(getattr(self, name), 1, name)
        for name in ("lr", "dynamics_lr"):
            _require_above_zero(getattr(self, name), name)
        _require_autocast(self.autocast)


@dataclass(frozen=True)
class LossOptions:
    """What the losses of the latent models are; the discount γ is the replay buffer's.

    Args:
        gamma_safe_set: γ_S in [0, 1] (Table 1).
        zero_at_goal: the target of equation (4) is 0 where the reward is 0, as in the authors' code.
        mean_latents: which of ``"dynamics"``, ``"constraint"`` and ``"goal"`` learn from the posteriors' means instead
            of samples.
        dynamics_horizon: steps over which equation (2) carries each prediction on, at least 1 (the paper: 1).
        timed_out_weight: weight, at least 0, in equation (5) of online episodes that neither succeeded nor violated;
            1 is the paper.
    """

    gamma_safe_set: float = 0.3
    zero_at_goal: bool = True
    mean_latents: tuple[str, ...] = ()
    dynamics_horizon: int = 1
    timed_out_weight: float = 1.0

    def __post_init__(self) -> None:
        _require_fraction(self.gamma_safe_set, "gamma_safe_set")
        _require_flags(self, "zero_at_goal")
        _require_count(self.dynamics_horizon, 1, "dynamics_horizon")
        _require_not_negative(self.timed_out_weight, "timed_out_weight")
        if isinstance(self.mean_latents, str):
            raise TypeError(f"mean_latents must be a list of names, got {self.mean_latents!r}.")
        unknown = sorted(set(self.mean_latents) - set(MEAN_LATENTS))
        if unknown:
            raise ValueError(f"mean_latents must be some of {', '.join(MEAN_LATENTS)}; got {', '.join(unknown)}.")
        object.__setattr__(self, "mean_latents", tuple(self.mean_latents))


@dataclass(frozen=True)
class LS3Options:
    """All settings of :class:`~ls3_torchrl.trainers.LS3Trainer`; the defaults are the paper's.

    Args:
        offline: gradient steps on the offline data.
        online: gradient steps of one update.
        optim: how everything is optimised.
        loss: what the losses are.

    Example:
        >>> LS3Options(offline=OfflineOptions(dynamics_steps=500), optim=OptimOptions(batch_size=64)).online.fraction
        0.0
    """

    offline: OfflineOptions = field(default_factory=OfflineOptions)
    online: OnlineOptions = field(default_factory=OnlineOptions)
    optim: OptimOptions = field(default_factory=OptimOptions)
    loss: LossOptions = field(default_factory=LossOptions)
