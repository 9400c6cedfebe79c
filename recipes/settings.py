"""Settings of the training that would only fail, or be passed over, after time was spent: refused before."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig
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


def check_settings(config: DictConfig) -> None:
    """Refuse settings of the training that would only fail, or be passed over, after time was spent.

    Raises:
        ValueError: naming the setting, what was received and what is allowed.
    """
    vae = config.vae
    scale = config.agent.action_scale
    if isinstance(scale, str) and scale != "box":
        raise ValueError(f"agent.action_scale must be box, or one or more positive numbers; got {scale!r}.")
    allowed = {
        "vae.schedule": (vae.schedule, ("constant", "onecycle")),
        "vae.reduction": (vae.reduction, ("mean", "sum")),
        "vae.autocast": (vae.autocast, (True, False, "auto")),
        "optim.autocast": (config.optim.autocast, (True, False, "auto")),
        "online.select": (config.online.select, ("last", "best")),
        "loss.failure_rows": (config.loss.failure_rows, ("all", "violating")),
    }
    for name, (value, choices) in allowed.items():
        if value not in choices:
            raise ValueError(f"{name} must be one of {', '.join(map(str, choices))}; got {value!r}.")
    if vae.crop_scale is not None and not (
        len(vae.crop_scale) == 2 and 0 < vae.crop_scale[0] <= vae.crop_scale[1] <= 1
    ):
        raise ValueError(f"vae.crop_scale must be null or [low, high] within (0, 1], got {vae.crop_scale}.")
    positive = {
        "vae.steps": vae.steps,
        "vae.batch_size": vae.batch_size,
        "vae.lr": vae.lr,
        "vae.prediction_horizon": vae.prediction_horizon,
        "loss.dynamics_horizon": config.loss.dynamics_horizon,
        "optim.batch_size": config.optim.batch_size,
        "optim.lr": config.optim.lr,
        "optim.dynamics_lr": config.optim.dynamics_lr,
        "optim.target_interval": config.optim.target_interval,
        "online.episodes_per_update": config.online.episodes_per_update,
        "evaluation.episodes": config.evaluation.episodes,
    }
    if vae.warmup is not None and not (len(vae.warmup) == 2 and 0.0 <= vae.warmup[0] < vae.warmup[1] <= 1.0):
        raise ValueError(f"vae.warmup must be null or rising shares of the steps [start, end], got {vae.warmup}.")
    if not 0.0 <= config.optim.cooldown <= 1.0:
        raise ValueError(f"optim.cooldown must be a share in [0, 1], got {config.optim.cooldown}.")
    loss = config.loss
    for name in ("failure_weight", "undecided_weight"):
        if loss[name] < 0.0:
            raise ValueError(f"loss.{name} must not be negative, got {loss[name]}.")
    if loss.success_tail is not None and loss.success_tail < 1:
        raise ValueError(f"loss.success_tail must be null or at least 1, got {loss.success_tail}.")
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
    if vae.prediction_weight < 0.0:
        raise ValueError(f"vae.prediction_weight must not be negative, got {vae.prediction_weight}.")
    for name, value in positive.items():
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value}.")
    rows = config.task.buffer_capacity
    if rows < 1:
        raise ValueError(f"task.buffer_capacity must be at least 1, got {rows}.")
