"""How plans are searched for and scored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ls3_torchrl._values import (
    require_at_least,
    require_choice,
    require_not_negative,
    require_positive,
    require_probability,
)

SafeSetReduction = Literal["mean", "min"]
EngineName = Literal["auto", "fused", "rollout"]
Precision = Literal["auto", "fp32", "bf16"]


@dataclass(frozen=True, kw_only=True)
class ControlOptions:
    """The options of :class:`~ls3_torchrl.planners.LS3Planner`, as documented there.

    Raises:
        ValueError: naming the field, what was received and what is allowed.

    Example:
        >>> ControlOptions(horizon=3).num_particles
        20
    """

    horizon: int = 5
    num_particles: int = 20
    safe_set_threshold: float | None = 0.8
    constraint_threshold: float | None = 0.2
    relaxation: float = 0.8
    max_relaxations: int = 5
    safe_set_reduction: SafeSetReduction = "mean"
    noise_scale: float = 1.0
    max_ms: float | None = None
    engine: EngineName = "auto"
    precision: Precision = "auto"

    def __post_init__(self) -> None:
        for name in ("horizon", "num_particles"):
            require_at_least(getattr(self, name), 1, name)
        require_probability(self.relaxation, "relaxation")
        for name in ("safe_set_threshold", "constraint_threshold"):
            if getattr(self, name) is not None:
                require_probability(getattr(self, name), name)
        require_at_least(self.max_relaxations, 0, "max_relaxations")
        require_not_negative(self.noise_scale, "noise_scale")
        if self.max_ms is not None:
            require_positive(self.max_ms, "max_ms")
        require_choice(self.engine, ("auto", "fused", "rollout"), "engine")
        require_choice(self.precision, ("auto", "fp32", "bf16"), "precision")
        require_choice(self.safe_set_reduction, ("mean", "min"), "safe_set_reduction")


@dataclass(frozen=True, kw_only=True)
class CEMOptions:
    """The options of :class:`~ls3_torchrl.planners.CrossEntropyMethod`, as documented there.

    Raises:
        ValueError: naming the field, what was received and what is allowed.

    Example:
        >>> CEMOptions(num_candidates=200, num_elites=20).optim_steps
        4
    """

    num_candidates: int = 1000
    num_elites: int | None = None
    optim_steps: int = 4
    p_random: float = 1.0
    p_constant: float = 0.0

    def __post_init__(self) -> None:
        require_at_least(self.num_candidates, 1, "num_candidates")
        if self.num_elites is not None and not 1 <= self.num_elites <= self.num_candidates:
            raise ValueError(
                f"num_elites must lie between 1 and num_candidates = {self.num_candidates}, got {self.num_elites}."
            )
        if not 0.0 <= self.p_random <= 1.0:
            raise ValueError(f"p_random must lie in [0, 1], got {self.p_random}.")
        if not 0.0 <= self.p_constant <= 1.0 or self.p_random + self.p_constant > 1.0:
            raise ValueError(
                f"p_constant must lie in [0, 1] and leave room for p_random, got p_constant={self.p_constant} and "
                f"p_random={self.p_random}: together they must not exceed 1."
            )
        require_at_least(self.optim_steps, 1, "optim_steps")


@dataclass(frozen=True, kw_only=True)
class PlannerOptions(CEMOptions, ControlOptions):
    """All options of a planner that searches with the cross-entropy method.

    Raises:
        ValueError: naming the field, what was received and what is allowed.

    Example:
        >>> PlannerOptions(horizon=0)
        Traceback (most recent call last):
        ...
        ValueError: horizon must be at least 1, got 0.
    """

    def __post_init__(self) -> None:
        CEMOptions.__post_init__(self)
        ControlOptions.__post_init__(self)
