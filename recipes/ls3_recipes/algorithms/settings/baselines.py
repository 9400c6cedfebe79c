"""What can be set of the baselines: behaviour cloning, SACfD and AWAC."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ls3_recipes.run_settings import RunSettings
from ls3_torchrl._values import require_at_least, require_choice, require_positive, require_unit_interval


@dataclass(frozen=True, kw_only=True)
class PolicySettings:
    """The actor of a baseline.

    Args:
        hidden: hidden layers of every network.
        lr: Adam's learning rate, above 0.
        batch_size: transitions in a step.
        cloning_steps: gradient steps of the actor's mean on the successful demonstrations.
    """

    hidden: tuple[int, ...] = (256, 256)
    lr: float = 3.0e-4
    batch_size: int = 256
    cloning_steps: int = 5000

    def __post_init__(self) -> None:
        """Refuse what would only fail after time was spent."""
        for size in self.hidden:
            require_at_least(size, 1, "hidden")
        require_positive(self.lr, "lr")
        require_at_least(self.batch_size, 1, "batch_size")
        require_at_least(self.cloning_steps, 0, "cloning_steps")


@dataclass(frozen=True, kw_only=True)
class ActorCriticSettings(PolicySettings):
    """An actor whose critics learn from penalised rewards.

    Args:
        penalty: λ, added to the reward of a violation; at most 0.
        initial_std: of an untrained actor, before squashing.
        tau: of the lagged critics, in (0, 1]; a value that is wrong for ever sinks by 1 in 1 / tau steps.
        critic_steps: gradient steps offline.
        updates_per_step: gradient steps online, for each step of the environment.
    """

    penalty: float
    initial_std: float = 1.0
    tau: float = 0.005
    critic_steps: int = 5000
    updates_per_step: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what would only fail after time was spent."""
        super().__post_init__()
        if self.penalty > 0.0:
            raise ValueError(f"penalty is added to the reward of a violation: 0 or below, got {self.penalty}.")
        require_positive(self.initial_std, "initial_std")
        require_positive(self.tau, "tau")
        require_unit_interval(self.tau, "tau")
        require_at_least(self.critic_steps, 0, "critic_steps")
        if self.updates_per_step < 0:
            raise ValueError(f"updates_per_step must be at least 0, got {self.updates_per_step}.")


@dataclass(frozen=True, kw_only=True)
class BaselineSettings(RunSettings):
    """What a run of a baseline has, in addition to what every run has.

    Args:
        encoder: ``"conv"``, convolutions of each network's own, with which nothing reads ``agent`` and ``vae``; or
            ``"latents"``, the means of the VAE that LS³ trains, frozen.
        policy: of the actor and, where it has them, its critics.
    """

    encoder: Literal["latents", "conv"] = "conv"
    policy: PolicySettings

    def __post_init__(self) -> None:
        """Refuse unknown encoders."""
        super().__post_init__()
        require_choice(self.encoder, ("latents", "conv"), "encoder")

    @property
    def unread(self) -> dict[str, str]:
        """Without the VAE, neither its training nor the networks that are made with it."""
        return dict.fromkeys(("agent", "vae"), "encoder=latents") if self.encoder == "conv" else {}


@dataclass(frozen=True, kw_only=True)
class RiskSettings:
    """The safety critic of recovery RL (section 1.1.3).

    Args:
        gamma: γ_risk, in [0, 1].
        threshold: ε_risk, in [0, 1]: riskier actions are left to the recovery policy.
        offline_steps: gradient steps on the offline data.
    """

    gamma: float
    threshold: float
    offline_steps: int

    def __post_init__(self) -> None:
        """Refuse what is no probability."""
        for name in ("gamma", "threshold"):
            require_unit_interval(getattr(self, name), name)
        require_at_least(self.offline_steps, 0, "offline_steps")


@dataclass(frozen=True, kw_only=True)
class SACfDPolicySettings(ActorCriticSettings):
    """Actor and critics of soft actor-critic; the defaults are those of the implementation that the paper cites.

    Args:
        alpha: weight of the entropy, for rewards of -1 a step; above 0.
        risk: of the safety critic, which there is with recovery alone.
    """

    alpha: float = 0.2
    risk: RiskSettings

    def __post_init__(self) -> None:
        """Refuse what would only fail after time was spent."""
        super().__post_init__()
        require_positive(self.alpha, "alpha")


@dataclass(frozen=True, kw_only=True)
class SACfDSettings(BaselineSettings):
    """What a run of SACfD has.

    Args:
        recovery: recovery RL: a safety critic, and a policy that takes over where the task's own is too risky.
    """

    recovery: bool = False
    policy: SACfDPolicySettings

    @property
    def unread(self) -> dict[str, str]:
        """Without recovery, nothing of the safety critic."""
        return super().unread | ({} if self.recovery else {"policy.risk": "recovery=true"})


@dataclass(frozen=True, kw_only=True)
class AWACPolicySettings(ActorCriticSettings):
    """Actor and critic; the defaults are those of the implementation that the paper cites.

    Args:
        temperature: by which advantages are divided before they weigh what is imitated; above 0.
    """

    batch_size: int = 1024
    cloning_steps: int = 0
    initial_std: float = 0.05
    temperature: float = 2.0

    def __post_init__(self) -> None:
        """Refuse what would only fail after time was spent."""
        super().__post_init__()
        require_positive(self.temperature, "temperature")


@dataclass(frozen=True, kw_only=True)
class AWACSettings(BaselineSettings):
    """What a run of AWAC has."""

    policy: AWACPolicySettings
