"""Settings of the training that would only fail, or be passed over, after time was spent: refused before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from torchrl.data import Bounded

#: What can learn from the posteriors' means instead of samples.
MEAN_LATENTS = ("dynamics", "constraint", "goal")


def agent_options(config: DictConfig, action_spec: Bounded) -> dict[str, Any]:
    """The settings of the networks; ``action_scale: box`` stands for half the actions' range."""
    options = {str(name): value for name, value in config.agent.items()}
    if options["action_scale"] == "box":
        space = action_spec.space
        half = ((space.high - space.low) / 2).reshape(-1, action_spec.shape[-1])[0]
        options["action_scale"] = half.tolist()
    return options


def _choose(**settings: tuple[Any, tuple]) -> None:
    for name, (value, choices) in settings.items():
        if value not in choices:
            raise ValueError(f"{name} must be one of {', '.join(map(str, choices))}; got {value!r}.")


def _positive(config: DictConfig, *names: str) -> None:
    for name in names:
        value = OmegaConf.select(config, name)
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value}.")


def _not_negative(config: DictConfig, *names: str) -> None:
    for name in names:
        value = OmegaConf.select(config, name)
        if value < 0:
            raise ValueError(f"{name} must not be negative, got {value}.")


def check_shared(config: DictConfig) -> None:
    """The settings that every algorithm has: data, VAE, number of episodes."""
    scale, vae = config.agent.action_scale, config.vae
    if isinstance(scale, str) and scale != "box":
        raise ValueError(f"agent.action_scale must be box, or one or more positive numbers; got {scale!r}.")
    _choose(
        **{
            "vae.schedule": (vae.schedule, ("constant", "onecycle")),
            "vae.reduction": (vae.reduction, ("mean", "sum")),
            "vae.autocast": (vae.autocast, (True, False, "auto")),
            "online.select": (config.online.select, ("last", "best")),
        }
    )
    if vae.crop_scale is not None and not (
        len(vae.crop_scale) == 2 and 0 < vae.crop_scale[0] <= vae.crop_scale[1] <= 1
    ):
        raise ValueError(f"vae.crop_scale must be null or [low, high] within (0, 1], got {vae.crop_scale}.")
    if vae.warmup is not None and not (len(vae.warmup) == 2 and 0.0 <= vae.warmup[0] < vae.warmup[1] <= 1.0):
        raise ValueError(f"vae.warmup must be null or rising shares of the steps [start, end], got {vae.warmup}.")
    if vae.agent is not None and not Path(vae.agent).is_file():
        raise ValueError(f"vae.agent must be null or the file of a trained agent; there is none at {vae.agent}.")
    _positive(config, "vae.steps", "vae.batch_size", "vae.lr", "vae.prediction_horizon")
    _positive(config, "online.episodes_per_update", "evaluation.episodes")
    _not_negative(config, "vae.prediction_weight")
    tail, rows = config.loss.success_tail, config.task.buffer_capacity
    if tail is not None and tail < 1:
        raise ValueError(f"loss.success_tail must be null or at least 1, got {tail}.")
    if rows < 1:
        raise ValueError(f"task.buffer_capacity must be at least 1, got {rows}.")


def check_settings(config: DictConfig) -> None:
    """Refuse settings of LS³'s training that would only fail, or be passed over, after time was spent.

    Raises:
        ValueError: naming the setting, what was received and what is allowed.
    """
    check_shared(config)
    optim, loss = config.optim, config.loss
    _choose(
        **{
            "optim.autocast": (optim.autocast, (True, False, "auto")),
            "loss.failure_rows": (loss.failure_rows, ("all", "violating")),
        }
    )
    _positive(config, "optim.batch_size", "optim.lr", "optim.dynamics_lr", "optim.target_interval")
    _positive(config, "loss.dynamics_horizon")
    _not_negative(config, "loss.failure_weight", "loss.timed_out_weight")
    if not 0.0 <= optim.cooldown <= 1.0:
        raise ValueError(f"optim.cooldown must be a share in [0, 1], got {optim.cooldown}.")
    if not 0.0 <= config.online.fraction < 1.0:
        raise ValueError(f"online.fraction must be a share in [0, 1), got {config.online.fraction}.")
    unknown = set(loss.mean_latents) - set(MEAN_LATENTS)
    if unknown:
        raise ValueError(
            f"loss.mean_latents must be some of {', '.join(MEAN_LATENTS)}; got {', '.join(sorted(unknown))}."
        )
    if loss.monte_carlo and not loss.continue_failures:
        raise ValueError(
            "loss.monte_carlo needs loss.continue_failures: otherwise a failure's return ends with the horizon and is "
            "no lower bound."
        )


def check_comparison(config: DictConfig) -> None:
    """The same for a comparison.

    Raises:
        ValueError: naming the setting, what was received and what is allowed.
    """
    check_shared(config)
    policy = config.policy
    _choose(encoder=(config.encoder, ("latents", "conv")))
    _positive(config, "policy.lr", "policy.batch_size", "policy.tau", "policy.initial_std")
    _not_negative(config, "policy.cloning_steps", "policy.critic_steps", "policy.updates_per_step")
    if policy.get("penalty", 0.0) > 0.0:
        raise ValueError(f"policy.penalty is added to the reward of a violation: 0 or below, got {policy.penalty}.")
    if "recovery" in config and not isinstance(config.recovery, bool):
        raise ValueError(f"recovery must be true or false, got {config.recovery!r}.")
    if "alpha" in policy:
        _positive(config, "policy.alpha")
    if "temperature" in policy:
        _positive(config, "policy.temperature")
    if "risk" in policy:
        for name in ("gamma", "threshold"):
            if not 0.0 <= policy.risk[name] <= 1.0:
                raise ValueError(f"policy.risk.{name} must lie in [0, 1], got {policy.risk[name]}.")
