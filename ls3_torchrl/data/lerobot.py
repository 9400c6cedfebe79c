"""Episodes from LeRobot, Hugging Face's format of robots' data; the package ``lerobot`` is not needed."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase

from ls3_torchrl._checks import DataWarning, require_choice
from ls3_torchrl.data.keys import EpisodeKeys
from ls3_torchrl.data.lerobot_files import LeRobotFiles
from ls3_torchrl.data.pixels import Fit, pixels_from_images, require_image_settings
from ls3_torchrl.data.recordings import (
    Recording,
    Source,
    Sources,
    TagSource,
    chosen,
    episodes_by_tag,
    make_episode,
)
from ls3_torchrl.data.tags import Tag

#: What becomes of an episode's last action, after which nothing was seen.
Last: TypeAlias = Literal["drop", "repeat"]
#: Columns that tell of steps begin so; all others tell of states.
_OF_STEPS = ("action", "next.")
_DEFAULTS = {
    "action": "action",
    "reward": "next.reward",
    "success": "next.success",
    "constraint": "next.constraint",
}


def load_lerobot(
    folder: str | Path,
    *,
    camera: str | None = None,
    action: Source | None = None,
    reward: Source | None = None,
    constraint: Source | None = None,
    success: Source | None = None,
    tag: TagSource | None = None,
    extra: Mapping[NestedKey, Source] | None = None,
    last: Last = "drop",
    episodes: Iterable[int] | None = None,
    size: int | tuple[int, int] = 64,
    fit: Fit = "squash",
    keys: EpisodeKeys | None = None,
) -> dict[Tag, TensorDictBase]:
    """Episodes of a LeRobot dataset by tag, as ``buffer.add`` and :func:`~ls3_torchrl.data.save_episodes` take them.

    LeRobot keeps N frames of an episode, each an observation and the action that was taken there: what the last action
    led to was not recorded. By default it is dropped, so that an episode has N − 1 steps, all of which were seen. The
    labels that belong to it (``next.success`` of the last frame) are dropped with it; where only they tell of a success
    or a violation, that is warned of, and ``last="repeat"`` keeps all N steps with the last image shown twice.

    Each source is the name of a column, a function of the columns, or for labels ``False`` (or ``True``) for all steps.
    Functions get a dictionary of arrays: columns that begin with ``action`` or ``next.`` tell of the T steps, all
    others of the T + 1 states. What a source says of states, a step gets of the one that it leads to.

    Args:
        folder: of the dataset, with ``meta/info.json``, of version 3.0, 2.1 or 2.0.
        camera: column of the images, such as ``"observation.images.top"``, or its last part; may be left out where
            there is but one. With ``keys`` that name no image, any column of numbers, such as ``"observation.state"``.
        action: source of the actions ``[T, A]``; the column ``action`` when ``None``.
        reward: source of the rewards; the column ``next.reward``, as it is, when ``None``. LS³ takes −1 outside of the
            goal and 0 in it.
        constraint: source of whether a step leads to a violation, bools or 0 and 1; the column ``next.constraint`` when
            ``None``.
        success: source of whether it leads into the goal set; the column ``next.success`` when ``None``.
        tag: the tag of all episodes, or a function of the columns. When ``None`` an episode with a violation is
            ``constraint``, another with a success ``success``, and all others ``rand``.
        extra: sources of further entries by their keys, such as ``{"state": "observation.state"}``; of states,
            ``("next", key)`` is set as well.
        last: what becomes of the last action, ``"drop"`` or ``"repeat"``.
        episodes: numbers of those to read; all when ``None``.
        size: height and width of images, one number where they are alike.
        fit: how images get that size: see :func:`~ls3_torchrl.data.pixels_from_images`.
        keys: under which keys the entries go; the defaults of :class:`~ls3_torchrl.data.EpisodeKeys` when ``None``.

    Returns:
        Lazy stacks of episodes ``[N, T_i]`` by tag.

    Raises:
        ModuleNotFoundError: when pyarrow is not installed, or PyAV and Pillow where they are needed.
        FileNotFoundError: when there is no dataset, or a file of it is missing.
        KeyError: for a column that is not there, or a source that must be given.
        ValueError: for another version, damaged files, an episode of one frame (with ``last="drop"``), labels other
            than 0 and 1, and all that :func:`~ls3_torchrl.data.check_episodes` refuses; messages name the episode.

    Warns:
        DataWarning: when successes or violations are dropped with the last actions, and for recorded rewards that are
            not −1 outside of the goal and 0 in it.

    Source:
        LeRobot's dataset format v3.0, https://huggingface.co/docs/lerobot.

    Example:
        >>> import json, tempfile, pyarrow as pa, pyarrow.parquet as pq
        >>> frames = {"episode_index": [0, 0, 0], "frame_index": [0, 1, 2], "action": [[0.1], [0.2], [0.3]]}
        >>> frames |= {"observation.state": [[0.0], [0.1], [0.3]], "next.reward": [-1.0, 0.0, 0.0]}
        >>> number = {"dtype": "float32", "shape": [1]}
        >>> features = {"action": number, "observation.state": number, "next.reward": number}
        >>> path = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        >>> info = {"codebase_version": "v3.0", "fps": 10, "features": features, "data_path": path}
        >>> one = {"episode_index": [0], "length": [3], "data/chunk_index": [0], "data/file_index": [0]}
        >>> with tempfile.TemporaryDirectory() as name:
        ...     root = Path(name)
        ...     for part, table in (("data", frames), ("meta/episodes", one)):
        ...         (root / part / "chunk-000").mkdir(parents=True)
        ...         pq.write_table(pa.table(table), root / part / "chunk-000/file-000.parquet")
        ...     _ = (root / "meta/info.json").write_text(json.dumps(info))
        ...     loaded = load_lerobot(
        ...         root, camera="observation.state", keys=EpisodeKeys(observation="state"), constraint=False,
        ...         success=lambda columns: columns["observation.state"][:, 0] > 0.2,
        ...     )
        >>> loaded[Tag.SUCCESS].batch_size, loaded[Tag.SUCCESS]["next", "state"].flatten().tolist()
        (torch.Size([1, 2]), [0.10000000149011612, 0.30000001192092896])
    """
    require_image_settings(size, fit)
    require_choice(last, ("drop", "repeat"), "last")
    keys = keys or EpisodeKeys()
    sources = Sources(action, reward, constraint, success, tag, extra or {})
    files = LeRobotFiles(Path(folder))
    column = _camera(files, camera)
    lost: dict[str, list[int]] = {"success": [], "constraint": []}

    def read() -> Iterator[tuple[Tag, TensorDictBase]]:
        for number in chosen(episodes, files.episodes, str(folder)):
            columns = files.columns(number, column)
            recording = _recording(columns, last, f"Episode {number} of {folder}", files.cameras)
            for what in _lost(columns, sources, recording, files.cameras) if last == "drop" else ():
                lost[what].append(number)
            observations = _observations(files, number, column, columns, size, fit)
            if last == "repeat":
                observations = torch.cat([observations, observations[-1:]])
            yield make_episode(recording, observations, sources, keys)

    out = episodes_by_tag(read(), sources, keys, str(folder))
    _warn_of_lost(lost, str(folder))
    return out


def _camera(files: LeRobotFiles, camera: str | None) -> str:
    """The column that is meant."""
    there = files.cameras
    if camera is None:
        if len(there) != 1:
            raise KeyError(
                f"{files.folder} has {len(there)} cameras: {', '.join(there) or 'none'}. Name one with camera=, or a "
                "column of numbers for an encoder of your own."
            )
        return there[0]
    if camera in files.info["features"]:
        return camera
    ends = [name for name in there if name.rpartition(".")[2] == camera]
    if len(ends) != 1:
        names = ", ".join(files.info["features"])
        raise KeyError(f"{files.folder} has no camera {camera!r}. Its columns are: {names}.")
    return ends[0]


def _recording(columns: Mapping[str, np.ndarray], last: Last, name: str, cameras: list[str]) -> Recording:
    """Columns ``[N, ...]`` as those of T steps and T + 1 states."""
    frames = len(columns["frame_index"])
    if last == "drop" and frames < 2:
        raise ValueError(
            f"{name} has one frame, after which nothing was seen. Leave it out with episodes=, or give last='repeat'."
        )
    told: dict[str, Any] = {}
    for column, values in columns.items():
        if column in cameras:
            continue
        if last == "repeat":
            told[column] = values if column.startswith(_OF_STEPS) else np.concatenate([values, values[-1:]])
        else:
            told[column] = values[:-1] if column.startswith(_OF_STEPS) else values
    if "action" in told and told["action"].ndim == 1:
        told["action"] = told["action"][:, None]
    defaults = {what: (column,) for what, column in _DEFAULTS.items() if column in told}
    steps = frames if last == "repeat" else frames - 1
    return Recording(told, name, steps, {(column,): values for column, values in told.items()}, defaults)


def _lost(columns: Mapping[str, np.ndarray], sources: Sources, kept: Recording, cameras: list[str]) -> Iterator[str]:
    """The labels that only the dropped step has."""
    whole = _recording(columns, "repeat", kept.name, cameras)
    for what in ("success", "constraint"):
        all_steps, without_last = (np.asarray(sources.of_steps(each, what) != 0) for each in (whole, kept))
        if all_steps.any() and not without_last.any():
            yield what


def _warn_of_lost(lost: Mapping[str, list[int]], who: str) -> None:
    said = [f"the only {what} of episodes {numbers[:5]}" for what, numbers in lost.items() if numbers]
    more = max(map(len, lost.values()))
    if said:
        warnings.warn(
            f"{who}: {' and '.join(said)} ({more} in all) belongs to the last action, whose outcome was not recorded, "
            "and was dropped with it. Give last='repeat' to keep it, with the last image shown twice.",
            DataWarning,
            stacklevel=3,
        )


def _observations(
    files: LeRobotFiles,
    number: int,
    column: str,
    columns: Mapping[str, np.ndarray],
    size: int | tuple[int, int],
    fit: Fit,
) -> torch.Tensor:
    """The N observations of an episode, images in their size; only one is held in its own."""
    if column not in files.cameras:
        values = torch.tensor(columns[column])
        return values[:, None] if values.ndim == 1 else values
    return torch.stack(
        [pixels_from_images(image, size=size, fit=fit) for image in files.images(number, column, columns)]
    )
