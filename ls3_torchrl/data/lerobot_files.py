"""The files of a LeRobot dataset: where each episode lies, its columns and its images."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ls3_torchrl.data.packages import require_package
from ls3_torchrl.files import load_json

WHO = "load_lerobot"
#: The format's versions that are read; 2.0 and 2.1 differ in statistics alone.
VERSIONS = ("v2.0", "v2.1", "v3.0")
_IMAGES = ("image", "video")
#: How a file begins that stands for a large one in a clone without Git LFS.
_POINTER = b"version https://git-lfs"


@dataclass
class LeRobotFiles:
    """A local folder of a LeRobot dataset.

    Args:
        folder: with ``meta/info.json``.

    Raises:
        FileNotFoundError: when it holds none.
        ValueError: for another version, or a description that is damaged.
    """

    folder: Path
    info: dict[str, Any] = field(init=False)
    episodes: dict[int, dict[str, Any]] = field(init=False)
    _table: tuple[Path, tuple[str, ...], Any] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        path = self.folder / "meta" / "info.json"
        if not path.is_file():
            raise FileNotFoundError(
                f"{self.folder} holds no LeRobot dataset: {path} is missing. Give the folder of a downloaded or "
                "recorded one, with meta, data and perhaps videos in it."
            )
        self.info = load_json(path, "a description of a LeRobot dataset")
        version = self.info.get("codebase_version")
        if version not in VERSIONS:
            raise ValueError(
                f"{path} is of version {version!r}; {', '.join(VERSIONS)} are read. LeRobot's own scripts convert it."
            )
        features = self.info.get("features")
        if not isinstance(features, dict) or not all(isinstance(kind, dict) for kind in features.values()):
            raise ValueError(f"{path} describes no features: it is damaged. Use another copy of it.")
        fps = self.info.get("fps")
        if not isinstance(fps, (int, float)) or not fps > 0:
            raise ValueError(f"{path} must say how many frames there are in a second, got {fps!r}: it is damaged.")
        self.episodes = dict(sorted(self._episodes()))

    @property
    def cameras(self) -> list[str]:
        """Columns of images."""
        return [name for name, feature in self.info["features"].items() if feature.get("dtype") in _IMAGES]

    def _episodes(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """What is known of each episode, by number."""
        meta, newer = self.folder / "meta", self.info["codebase_version"] == "v3.0"
        paths = sorted((meta / "episodes").glob("*/*.parquet")) if newer else [meta / "episodes.jsonl"]
        if not paths or not paths[0].is_file():
            raise FileNotFoundError(f"{meta} does not list the episodes: no file of them is there. Use another copy.")
        for path in paths:
            try:
                lines = [] if newer else path.read_text(encoding="utf-8").splitlines()
                rows = [json.loads(line) for line in lines if line.strip()]
                rows = read_table(path, lambda name: not name.startswith("stats/")).to_pylist() if newer else rows
                numbers = [int(row["episode_index"]) for row in rows]
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(
                    f"{path} does not list episodes ({error}): it is damaged. Use another copy."
                ) from error
            yield from zip(numbers, rows, strict=True)

    def columns(self, number: int, camera: str | None) -> dict[str, np.ndarray]:
        """The columns of an episode ``[N, ...]``, without images but those of ``camera`` where they lie beside them.

        Raises:
            FileNotFoundError: when its file is missing.
            ValueError: when it does not hold as many frames as promised.
        """
        compute = require_package("pyarrow.compute", WHO, "pyarrow")
        path = self._path("data_path", number, "data")
        others = tuple(name for name in self.cameras if name != camera)
        if self._table is None or self._table[:2] != (path, others):
            self._table = (path, others, read_table(path, lambda name: name not in others))
        table = self._table[2]
        missing = {"episode_index", "frame_index", "timestamp"} - {*table.column_names}
        if missing - ({"timestamp"} if camera not in self.cameras else set()):
            raise ValueError(f"{path} lacks the columns {sorted(missing)}: it is damaged. Use another copy of it.")
        rows = table.filter(compute.equal(table["episode_index"], number)).sort_by("frame_index")
        promised = self.episodes[number].get("length")
        if rows.num_rows == 0 or (promised is not None and rows.num_rows != promised):
            raise ValueError(
                f"{path} holds {rows.num_rows} frames of episode {number}, where meta promises {promised}: it is "
                "damaged. Use another copy of it."
            )
        return {name: self._array(name, rows[name]) for name in rows.column_names}

    def _array(self, name: str, column: Any) -> np.ndarray:
        """Numbers as the description says what they are; images and texts as they lie there."""
        values = column.to_pylist()
        dtype = self.info["features"].get(name, {}).get("dtype")
        if dtype in (*_IMAGES, "string", None):
            out = np.empty(len(values), dtype=object)
            out[:] = values
            return out if dtype is not None else np.array(values)
        return np.array(values, dtype=dtype)

    def images(self, number: int, camera: str, columns: Mapping[str, np.ndarray]) -> Iterator[np.ndarray]:
        """The images of an episode, ``[H, W, 3]`` uint8, one after another.

        Raises:
            FileNotFoundError, ValueError: for files that are missing or damaged, or lack a frame.
        """
        if self.info["features"][camera]["dtype"] == "image":
            return (self._image(entry, number) for entry in columns[camera])
        path = self._path("video_path", number, f"videos/{camera}", video_key=camera)
        start = float(self.episodes[number].get(f"videos/{camera}/from_timestamp") or 0.0)
        return video_frames(path, start + columns["timestamp"].astype(np.float64), 0.4 / float(self.info["fps"]))

    def _image(self, entry: Mapping[str, Any], number: int) -> np.ndarray:
        pillow = require_package("PIL.Image", WHO, "pillow")
        content = entry.get("bytes")
        if content is None:
            content = self._inside(str(entry.get("path"))).read_bytes()
        try:
            with pillow.open(io.BytesIO(content)) as image:
                return np.asarray(image.convert("RGB"))
        except (OSError, SyntaxError) as error:
            raise ValueError(
                f"{self.folder}: an image of episode {number} cannot be read ({error}). Use another copy."
            ) from error

    def _path(self, template: str, number: int, prefix: str, **names: str) -> Path:
        """A file of an episode, of the older and the newer layout."""
        known = self.episodes[number]
        places = {
            "episode_index": number,
            "episode_chunk": number // int(self.info.get("chunks_size") or 1000),
            "chunk_index": known.get(f"{prefix}/chunk_index"),
            "file_index": known.get(f"{prefix}/file_index"),
        }
        try:
            told = str(self.info[template]).format(**{k: v for k, v in places.items() if v is not None}, **names)
        except (KeyError, IndexError, ValueError, AttributeError) as error:
            raise ValueError(
                f"{self.folder}: meta does not say where episode {number} lies ({template}, {error}): it is damaged. "
                "Use another copy of it."
            ) from error
        path = self._inside(told)
        if not path.is_file():
            raise FileNotFoundError(f"{path} of episode {number} is missing. Download the dataset with all its files.")
        with path.open("rb") as file:
            if file.read(len(_POINTER)) == _POINTER:
                raise ValueError(f"{path} is a pointer of Git LFS, not the file itself. Fetch it with `git lfs pull`.")
        return path

    def _inside(self, told: str) -> Path:
        """A path of the description, which must not lead out of the folder."""
        if PurePosixPath(told).is_absolute() or ".." in PurePosixPath(told).parts:
            raise ValueError(f"{self.folder}: meta names {told!r}, which lies outside of it. Use another copy of it.")
        return self.folder / told


def read_table(path: Path, wanted: Callable[[str], bool]) -> Any:
    """Columns of a Parquet file.

    Raises:
        ValueError: naming the file, when it cannot be read.
    """
    parquet = require_package("pyarrow.parquet", WHO, "pyarrow")
    try:
        return parquet.read_table(path, columns=[name for name in parquet.read_schema(path).names if wanted(name)])
    except (OSError, ValueError) as error:  # pyarrow's own errors are among them
        raise ValueError(f"{path} cannot be read as a table ({error}). Use another copy of it.") from error


def video_frames(path: Path, times: np.ndarray, tolerance: float) -> Iterator[np.ndarray]:
    """The frames of a video that are shown at ``times`` in seconds, in order; each ``[H, W, 3]`` uint8 RGB.

    Raises:
        ValueError: when the video cannot be read, or has no frame within ``tolerance`` seconds of a time.
    """
    av = require_package("av", WHO)
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            container.seek(max(int((times[0] - tolerance) / stream.time_base), 0), stream=stream, backward=True)
            wanted = 0
            for frame in container.decode(stream):
                if frame.time is None:
                    raise ValueError(f"{path} does not say when its frames are shown. Use another copy of it.")
                while wanted < len(times) and abs(frame.time - times[wanted]) < tolerance:
                    yield frame.to_ndarray(format="rgb24")
                    wanted += 1
                if wanted == len(times):
                    return
                if frame.time > times[wanted] + tolerance:
                    break
    except (av.error.FFmpegError, IndexError) as error:
        raise ValueError(f"{path} cannot be read as a video ({error}). Use another copy of it.") from error
    raise ValueError(
        f"{path} has no frame within {tolerance:.4g} s of {times[wanted]:.4g} s, where the episode has one: it is cut "
        "off or damaged. Use another copy of it."
    )
