"""Sampling from the rows that carry given tags: uniformly, or with a least share of online ones."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from ls3_torchrl._checks import require_at_least
from ls3_torchrl.data.tags import Tag


class TagSampler(Sampler):
    """Draws rows with replacement, uniformly over the union of some tags, or with a least share of online ones.

    The indices are cached, since a scan of the tags costs more than a draw: call :meth:`refresh` after rows
    were written or relabelled (:class:`~ls3_torchrl.data.TaggedReplayBuffer` does).

    Args:
        tags: the union to draw from.
        tag_key: where the rows keep their tag, uint8 ``[1]``.
        without: where the rows say, bool ``[1]``, whether they are left out; none is when ``None``.
        steps: rows are drawn that begin a stretch of so many steps of one episode, none of which is left out.
        steps_left_key: where the rows keep how many steps their episode has from them on, int64 ``[1]``.
        online_fraction: least share of online rows in a draw, in [0, 1), once there are some. Where offline data are many,
            a uniform draw hardly shows what the agent itself has met.

    Raises:
        ValueError: without a tag, for steps below 1 or a share outside [0, 1).
        RuntimeError: when no row carries one of the tags.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(8), sampler=TagSampler([Tag.RAND]), batch_size=3
        ... )
        >>> _ = buffer.extend(TensorDict({"tag": torch.tensor([[0], [1]], dtype=torch.uint8)}, [2]))
        >>> buffer.sample()["tag"].flatten().tolist()
        [1, 1, 1]
    """

    def __init__(
        self,
        tags: Iterable[Tag | str],
        *,
        tag_key: NestedKey = "tag",
        without: NestedKey | None = None,
        steps: int = 1,
        steps_left_key: NestedKey = "steps_left",
        online_fraction: float = 0.0,
    ) -> None:
        super().__init__()
        self.tags = tuple(sorted({Tag.parse(tag) for tag in tags}))
        if not self.tags:
            raise ValueError("A TagSampler needs at least one tag; none was given.")
        if not 0.0 <= online_fraction < 1.0:
            raise ValueError(f"online_fraction must be in [0, 1), got {online_fraction}.")
        self.online_fraction = online_fraction
        self.tag_key, self.without = tag_key, without
        self.steps, self.steps_left_key = require_at_least(steps, 1, "steps"), steps_left_key
        self._rows: Tensor | None = None
        self._cached_parts: list[Tensor] | None = None

    def refresh(self) -> None:
        """Forget the cached indices."""
        self._rows = self._cached_parts = None

    def rows(self, storage: Storage) -> Tensor:
        """Indices of the rows with one of the tags, int64 ``[n]``."""
        if self._rows is None:
            if len(storage) == 0:
                self._rows = torch.zeros(0, dtype=torch.long)
            else:
                content = storage[:]
                tag = content.get(self.tag_key).flatten()
                wanted = torch.tensor(self.tags, dtype=tag.dtype, device=tag.device)
                found = torch.isin(tag, wanted)
                if self.steps > 1:
                    found &= content.get(self.steps_left_key).flatten() >= self.steps
                if self.without is not None:
                    out = content.get(self.without).flatten()
                    for step in range(self.steps):  # an episode's rows follow one another, over the storage's end too
                        found &= ~out.roll(-step)
                self._rows = found.nonzero().flatten()
        return self._rows

    def _parts(self, storage: Storage) -> list[Tensor]:
        """Offline and online rows apart, where a uniform draw would hold too few of the latter; else all in one."""
        if self._cached_parts is None:
            rows = self.rows(storage)
            online = storage[:].get(self.tag_key).flatten()[rows] == int(Tag.ONLINE)
            too_few = 0.0 < online.float().mean() < self.online_fraction
            self._cached_parts = [rows[~online], rows[online]] if too_few else [rows]
        return self._cached_parts

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict]:
        """Indices ``[batch_size]``."""
        rows = self.rows(storage)
        if rows.numel() == 0:
            names = ", ".join(repr(tag.name.lower()) for tag in self.tags)
            raise RuntimeError(
                f"The buffer ({len(storage)} rows) holds no data tagged {names}. "
                "Collect such episodes and add them with that tag before training what learns from them."
            )
        parts = self._parts(storage)
        online = round(self.online_fraction * batch_size) if len(parts) == 2 else 0
        drawn = [
            part[torch.randint(part.numel(), (count,), device=part.device)]
            for part, count in zip(parts, (batch_size - online, online), strict=False)
        ]
        return torch.cat(drawn), {}

    def add(self, index: int) -> None:
        """A row was written."""
        self.refresh()

    def extend(self, index: Tensor) -> None:
        """Rows were written."""
        self.refresh()

    def _empty(self) -> None:
        self.refresh()

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the indices follow from the storage."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Forget the cached indices."""
        self.refresh()

    def dumps(self, path: str) -> None:
        """Nothing to write."""

    def loads(self, path: str) -> None:
        """Nothing to read."""
        self.refresh()
