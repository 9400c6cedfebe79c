"""What settings are wrong in only together with the domain, the data, files and this machine; before any work."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module

import torch
from tensordict import TensorDictBase

import ls3_envs
from ls3_recipes.options import as_dict
from ls3_recipes.rollout import make_env
from ls3_recipes.run_files import require_folder
from ls3_recipes.run_settings import RunSettings
from ls3_recipes.tracker import require_tracker
from ls3_torchrl.data import Tag
from ls3_torchrl.trainers import load_vae


def require_tools(settings: RunSettings, channels: int, horizon: int) -> None:
    """Refuse settings that do not fit the domain, or need what is not here.

    Args:
        settings: of a run.
        channels: of the domain's images.
        horizon: steps of an episode.

    Raises:
        ValueError: naming the setting, and what to do.
    """
    settings.require_horizon(horizon)
    require_tracker(settings.tracker)
    if settings.scratch_dir is not None:
        require_folder(settings.scratch_dir, "scratch_dir")
    if "vae" in settings.unread:
        return
    if settings.vae.checkpoint is not None:
        _require_vae(settings, channels)
    elif settings.vae.enlarge_to is not None:
        _require_opencv()


def _require_opencv() -> None:
    try:
        import_module("cv2")
    except ImportError as error:
        raise ValueError(
            f"vae.enlarge_to needs OpenCV, which cannot be imported ({error}). Install it with "
            "pip install opencv-python-headless, or set vae.enlarge_to=null."
        ) from None


def _require_vae(settings: RunSettings, channels: int) -> None:
    """Refuse a checkpoint whose encoder and decoder are not of the run's shape."""
    sizes = as_dict(settings.agent)
    shape = {"in_channels": channels, "latent_dim": sizes["latent_dim"], "background": sizes["background"]}
    try:
        with torch.random.fork_rng(devices=[]):  # what is learnt does not depend on what was checked
            load_vae(str(settings.vae.checkpoint), **shape)
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"vae.checkpoint: {error}") from error


def require_room(settings: RunSettings, offline: Mapping[Tag, TensorDictBase], horizon: int) -> None:
    """Refuse a replay buffer that has no room for the demonstrations and what is learnt from first.

    Args:
        settings: of a run.
        offline: the data that were given; empty for those that are still to be collected.
        horizon: steps of an online episode.

    Raises:
        ValueError: naming the capacity that is needed.
    """
    buffer, online = as_dict(settings.buffer), settings.online
    steps = (
        sum(len(row) for episodes in offline.values() for row in episodes.unbind(0)) if offline else _steps(settings)
    )
    offline_steps = 0 if buffer["success_tail"] else steps  # cut, they take fewer
    transitions = offline_steps + (online.episodes_per_update * horizon if online.updates else 0)
    if transitions > buffer["capacity"]:
        raise ValueError(
            f"buffer.capacity must be at least {transitions}, the transitions of the offline data and of the episodes "
            f"of one update; got {buffer['capacity']}. Raise it, or have fewer or shorter episodes."
        )


def _steps(settings: RunSettings) -> int:
    """Transitions of the offline data that a run collects: its episodes are as long as the domain's own."""
    task, kinds = settings.task, ls3_envs.domain(settings.task.name).offline.values()
    own = make_env(replace(task, horizon=None), 1, 0, torch.device("cpu")).base_env.horizon
    return own * sum(task.offline_episodes or kind.episodes for kind in kinds)
