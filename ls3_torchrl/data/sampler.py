"""Sampling from the rows that a selection admits: uniformly, or with a least fraction of online ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from ls3_torchrl.data.selection import RowSelection
from ls3_torchrl.data.tags import Tag


class TagSampler(Sampler):
    """Draws rows with replacement, uniformly over those of a selection, or with its least fraction of online ones.

    The indices are cached, since a scan of the tags costs more than a draw: call :meth:`refresh` after rows
    were written or relabelled (:class:`~ls3_torchrl.data.TaggedReplayBuffer` does).

    Args:
        selection: which rows are drawn. With ``steps`` K, these are the first rows of the stretches.
        tag_key: where the rows keep their tag, uint8 ``[1]``.
        steps_left_key: where the rows keep how many steps their episode has from them on, int64 ``[1]``.
        later: gives of row numbers ``[n]`` and a number of steps those written so many steps later; ``None`` for rows
            that follow one another, the first after the last.

    Raises:
        RuntimeError: in :meth:`sample`, when the selection admits no row.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> sampler = TagSampler(RowSelection(tags=["rand"]))
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(8), sampler=sampler, batch_size=3)
        >>> _ = buffer.extend(TensorDict({"tag": torch.tensor([[0], [1]], dtype=torch.uint8)}, [2]))
        >>> buffer.sample()["tag"].flatten().tolist()
        [1, 1, 1]
    """

    def __init__(
        self,
        selection: RowSelection,
        *,
        tag_key: NestedKey = "tag",
        steps_left_key: NestedKey = "steps_left",
        later: Callable[[Tensor, int], Tensor] | None = None,
    ) -> None:
        super().__init__()
        self._later = later
        self.selection = RowSelection.of(selection, {})
        self.tag_key, self.steps_left_key = tag_key, steps_left_key
        self._rows: Tensor | None = None
        self._cached_parts: list[Tensor] | None = None

    def refresh(self) -> None:
        """Forget the cached indices."""
        self._rows = self._cached_parts = None

    def rows(self, storage: Storage) -> Tensor:
        """Indices of the rows that the selection admits, int64 ``[n]``."""
        if self._rows is None:
            self._rows = self._find(storage) if len(storage) else torch.zeros(0, dtype=torch.long)
        return self._rows

    def _find(self, storage: Storage) -> Tensor:
        content, selection = storage[:], self.selection
        tag = content.get(self.tag_key).flatten()
        steps = selection.steps or 1
        found = torch.isin(tag, torch.tensor(selection.tags, dtype=tag.dtype, device=tag.device))
        if steps > 1:
            found &= content.get(self.steps_left_key).flatten() >= steps
        if selection.without is not None:
            out = content.get(selection.without).flatten()
            index = torch.arange(len(out), device=out.device)
            for step in range(steps):
                after = index + step if self._later is None else self._later(index, step)
                found &= ~out[after % len(out)]
        return found.nonzero().flatten()

    def _parts(self, storage: Storage) -> list[Tensor]:
        """Offline and online rows apart, where a uniform draw would hold too few of the latter; else all in one."""
        if self._cached_parts is None:
            rows = self.rows(storage)
            online = storage[:].get(self.tag_key).flatten()[rows] == int(Tag.ONLINE)
            too_few = 0.0 < online.float().mean() < self.selection.online_fraction
            self._cached_parts = [rows[~online], rows[online]] if too_few else [rows]
        return self._cached_parts

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict]:
        """Indices ``[batch_size]``."""
        return self.draw(storage, 1, batch_size).squeeze(0), {}

    def draw(
        self, storage: Storage, batches: int, batch_size: int, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Indices of many batches at once, int64 ``[batches, batch_size]``, each drawn as :meth:`sample` draws one.

        Args:
            storage: what is drawn from.
            batches: how many.
            batch_size: indices in each.
            generator: of the random numbers, on the CPU; PyTorch's own when ``None``.
        """
        rows = self.rows(storage)
        if rows.numel() == 0:
            raise RuntimeError(self._nothing(storage))
        parts = self._parts(storage)
        online = round(self.selection.online_fraction * batch_size) if len(parts) == 2 else 0
        drawn = [
            part[torch.randint(part.numel(), (batches, count), generator=generator).to(part.device)]
            for part, count in zip(parts, (batch_size - online, online), strict=False)
        ]
        return torch.cat(drawn, 1)

    def _nothing(self, storage: Storage) -> str:
        selection = self.selection
        names = ", ".join(repr(Tag.parse(tag).name.lower()) for tag in selection.tags)
        asked = f" that start {selection.steps} steps of one episode" if (selection.steps or 1) > 1 else ""
        asked += f" outside {selection.without!r}" if selection.without is not None else ""
        return (
            f"The buffer ({len(storage)} rows) holds no data tagged {names}{asked}. "
            "Collect such episodes and add them with that tag before training what learns from them."
        )

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
