"""Batches for gradient steps, many of which are drawn at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ls3_torchrl._checks import require_keys
from ls3_torchrl.data.buffer import TaggedReplayBuffer
from ls3_torchrl.data.keys import as_tuple
from ls3_torchrl.data.selection import RowSelection

#: Rows that are drawn at once: enough that a batch costs little, and few enough to stay in a core's cache.
_ROWS = 32_768
_LATENTS = {("latent",): (("loc",), ("scale",)), ("next", "latent"): (("next", "loc"), ("next", "scale"))}


class BatchStream:
    """Batches of a buffer's transitions without end, many of which are drawn at once, with what a module reads alone.

    A batch is what :meth:`TaggedReplayBuffer.sample <ls3_torchrl.data.TaggedReplayBuffer.sample>` draws: rows of a
    selection with replacement, and latents drawn from their posteriors. Indices and noise come from a random stream of
    its own: learners get the same batches whether they are trained one after another or side by side. Where the buffer
    has changed, what was drawn before is left aside.

    Args:
        buffer: drawn from.
        batch_size: B.
        selection: which rows; all when ``None``.
        reads: its ``in_keys``, as they are when it draws, are what a batch holds.
        extra_keys: entries of the buffer's rows that a batch holds as well.
        members: M for a bootstrap: B transitions drawn independently for each of M members.
        change: what is made of batches ``[K, *batch]`` when they are drawn, all at once; it keeps their shape.

    Returns:
        A call returns rows ``[B]``, or ``[B, M]``, or either with K behind for stretches of ``steps=K``.

    Raises:
        RuntimeError: by the call, without encoder or without rows of the selection.
        KeyError: by the call, for a key that the rows do not have.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> step = {"reward": -torch.ones(9, 1), "pixels": torch.randn(9, 4)}
        >>> step |= {k: torch.zeros(9, 1, dtype=torch.bool) for k in ("constraint", "success")}
        >>> episode = TensorDict({"pixels": torch.randn(9, 4), "action": torch.zeros(9, 2), "next": step}, [9])
        >>> buffer = TaggedReplayBuffer(capacity=100, latent_dim=4)
        >>> buffer.add(episode, "success")
        >>> buffer.encode(TensorDictModule(torch.nn.Identity(), ["pixels"], ["latent"]))
        >>> model = TensorDictModule(torch.nn.Linear(4, 1), in_keys=["latent"], out_keys=["anything"])
        >>> batches = BatchStream(buffer, 8, reads=model, members=5)
        >>> batches.seed(0)
        >>> sorted(batches().keys()), batches().shape
        (['latent'], torch.Size([8, 5]))
    """

    def __init__(
        self,
        buffer: TaggedReplayBuffer,
        batch_size: int,
        selection: RowSelection | None = None,
        *,
        reads: TensorDictModuleBase,
        extra_keys: Iterable[NestedKey] = (),
        members: int | None = None,
        change: Callable[[TensorDictBase], TensorDictBase] | None = None,
    ) -> None:
        self.buffer, self.batch_size, self.members = buffer, batch_size, members
        self.selection = RowSelection.of(selection, {})
        self.reads, self.extra_keys, self.change = reads, tuple(extra_keys), change
        self._start: Tensor | None = None  # state of the random stream before what is drawn now
        self._taken = 0  # of the batches that are drawn
        self._forget()

    def _forget(self) -> None:
        self._generator: torch.Generator | None = None
        self._batches: tuple[TensorDictBase, ...] = ()
        #: The batches that were drawn at once, ``[K, *batch]``; ``None`` before the first.
        self.drawn: TensorDictBase | None = None
        self._seen: tuple[Any, ...] | None = None  # of the buffer, when they were drawn

    def seed(self, seed: int) -> None:
        """Begin a random stream."""
        self._forget()
        self._start, self._taken = torch.Generator().manual_seed(seed).get_state(), 0

    def __call__(self) -> TensorDictBase:
        """The next batch; without :meth:`seed`, of a stream that PyTorch's own begins."""
        if self._start is None:
            self.seed(int(torch.randint(2**63 - 1, ())))
        keys = self._keys()
        now = (self.buffer.version, keys)
        if self._generator is not None and (self._taken == len(self._batches) or self._seen != now):
            self._start, self._taken, self._batches = self._generator.get_state(), 0, ()
        while not self._batches:
            self.drawn = self._draw(keys)
            self._batches, self._seen = self.drawn.unbind(0), now
            if self._taken == len(self._batches):  # a state that was taken when all of them were used
                assert self._generator is not None
                self._start, self._taken, self._batches = self._generator.get_state(), 0, ()
        self._taken += 1
        return self._batches[self._taken - 1]

    @property
    def taken(self) -> int:
        """How many of the batches that are drawn were handed over."""
        return self._taken

    def _keys(self) -> tuple[tuple[str, ...], ...]:
        return tuple(as_tuple(key) for key in (*self.reads.in_keys, *self.extra_keys))

    def _draw(self, keys: tuple[tuple[str, ...], ...]) -> TensorDictBase:
        """As many batches as fit into so many rows."""
        assert self._start is not None
        self._generator = torch.Generator()
        self._generator.set_state(self._start)
        shape = [self.batch_size, *([] if self.members is None else [self.members])]
        first = torch.Size(shape).numel()  # rows that a batch's stretches begin with
        steps = self.selection.steps
        count = max(1, _ROWS // (first * (steps or 1)))
        index = self.buffer.draw(count, first, self.selection, generator=self._generator)
        index = index.unflatten(1, shape)
        if self.members is not None:
            index = index.transpose(1, 2)
        if steps is not None:
            index = self.buffer.transitions.later(index.unsqueeze(-1), torch.arange(steps, device=index.device))
        rows = self.buffer.transitions.storage[:]
        require_keys(rows, [key for key in keys if key not in _LATENTS], "A batch")
        batch = TensorDict({}, [count, *shape, *([] if steps is None else [steps])], device=self.buffer.device)
        for key in keys:
            entry = self._entry(rows, key, index.flatten()).unflatten(0, index.shape)
            # In memory a member's rows lie together, as its network reads them.
            batch.set(key, entry if self.members is None else entry.transpose(1, 2))
        return batch if self.change is None else self.change(batch)

    def _entry(self, rows: TensorDictBase, key: tuple[str, ...], index: Tensor) -> Tensor:
        """An entry of rows, a latent drawn afresh."""
        if key not in _LATENTS:
            return rows.get(key)[index].to(self.buffer.device)
        loc, scale = (rows.get(part)[index].to(self.buffer.device) for part in _LATENTS[key])
        noise = torch.randn(loc.shape, generator=self._generator).to(loc.device)
        return torch.addcmul(loc, scale, noise)

    def state_dict(self) -> dict[str, Any]:
        """Where the random stream began to draw ahead, and how many of these batches were taken."""
        return {"start": self._start, "taken": self._taken}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on where :meth:`state_dict` was taken, as soon as the buffer has the same content."""
        self._forget()
        self._start, self._taken = state_dict["start"], state_dict["taken"]

    def __getstate__(self) -> dict[str, Any]:
        """All but what is drawn ahead, and the generator, which cannot be copied; both are made again."""
        return vars(self) | {"_generator": None, "_batches": (), "drawn": None, "_seen": None}
