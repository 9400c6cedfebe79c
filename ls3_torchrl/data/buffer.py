"""The replay buffer: a store of observations for the VAE, a store of transitions for everything else, views by tag."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer

from ls3_torchrl._checks import DataWarning, require_at_least
from ls3_torchrl.data.conform import conform
from ls3_torchrl.data.encoding import encode_frames
from ls3_torchrl.data.episode_store import EpisodeStore
from ls3_torchrl.data.episodes import Episodes, done_steps, split_episodes
from ls3_torchrl.data.keys import EpisodeKeys
from ls3_torchrl.data.labels import length_without_idle_end
from ls3_torchrl.data.rows import episode_rows, require_free, tag_of
from ls3_torchrl.data.sampler import TagSampler
from ls3_torchrl.data.selection import RowSelection
from ls3_torchrl.data.stores import RowStore
from ls3_torchrl.data.tags import Tag
from ls3_torchrl.options.buffer import BufferOptions


class TaggedReplayBuffer:
    """Episodes in two stores: every observation once, and every transition with its latents and labels.

    Latents are kept as posteriors (``loc``, ``scale``) and drawn afresh whenever a row is sampled. Before an
    encoder is known only observations can be sampled; :meth:`encode` fills the latents of all rows and
    keeps the encoder for the rows to come.

    It can be the ``replay_buffer`` of a :class:`~torchrl.collectors.Collector` in the same process, with
    ``trajs_per_batch``, or where a batch is whole episodes; see :meth:`extend`.

    Args:
        capacity: transitions that there is room for. Where it is full, the oldest online ones are overwritten; offline
            ones that came before all online ones are kept.
        latent_dim: D.
        gamma: γ of the ``reward_to_go`` labels, and of what is learnt from them.
        success_tail: steps kept of the successes that an episode ends with; ``None`` keeps all. Once the task is done
            nothing happens, and such steps can be most of the data.
        keys: where episodes keep their entries, and where sampled rows have them; the defaults of
            :class:`~ls3_torchrl.data.EpisodeKeys` when ``None``.
        extra_keys: further entries of the episodes that are kept with their transitions.
        frame_capacity: observations kept; ``None`` keeps at least those of all transitions kept, and makes more room
            when many short episodes need it.
        scratch_dir: memory-map both stores below this folder instead of holding them in memory. They are of no use to
            another buffer: the next one on the same folder starts afresh and removes them (one that is still in use
            keeps its content). To go on with the same content, :meth:`dumps` and :meth:`loads`.
        device: where sampled batches live.

    Raises:
        ValueError: for a capacity below 1, γ outside [0, 1], or a key that the buffer needs for itself; in :meth:`add`,
            for episodes that cannot be understood, or that there is no room for: of several, none is stored then.
        TypeError: in :meth:`add`, for images of another dtype than uint8, or entries that are no tensors.
        KeyError: in :meth:`add`, for a missing key.
        RuntimeError: in :meth:`sample`, without encoder or without rows of the selection; in :meth:`encode` and
            :meth:`sample_frame_transitions`, when frames were overwritten.

    Warns:
        DataWarning: in :meth:`add`, of what was converted, and once when offline data that came after online ones are
            overwritten.

    Example:
        >>> from ls3_torchrl.modules import PixelEncoder
        >>> step = {"reward": -torch.ones(9, 1), "pixels": torch.zeros(9, 3, 64, 64, dtype=torch.uint8)}
        >>> step |= {k: torch.zeros(9, 1, dtype=torch.bool) for k in ("constraint", "success")}
        >>> episode = TensorDict({"pixels": step["pixels"], "action": torch.zeros(9, 2), "next": step}, [9])
        >>> buffer = TaggedReplayBuffer(capacity=100, latent_dim=8)
        >>> buffer.add(episode, "success")
        >>> buffer.sample_frames(4)["pixels"].shape
        torch.Size([4, 3, 64, 64])
        >>> buffer.encode(PixelEncoder(latent_dim=8))
        >>> buffer.sample(4, tags=["success"])["next", "latent"].shape
        torch.Size([4, 8])
        >>> buffer.sample(4, RowSelection(tags=["success"]), members=5)["latent"].shape
        torch.Size([4, 5, 8])
    """

    def __init__(
        self,
        capacity: int,
        *,
        latent_dim: int = 32,
        gamma: float = 0.99,
        success_tail: int | None = None,
        keys: EpisodeKeys | None = None,
        extra_keys: Iterable[NestedKey] = (),
        frame_capacity: int | None = None,
        scratch_dir: str | Path | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        # Plain numbers, whatever NumPy gave: a description on disk holds nothing else.
        self.latent_dim = int(require_at_least(latent_dim, 1, "latent_dim"))
        BufferOptions(capacity=capacity, gamma=float(gamma), success_tail=success_tail)
        self.gamma = float(gamma)
        self.success_tail = None if success_tail is None else int(success_tail)
        self.device = torch.device(device)
        self.keys = keys or EpisodeKeys()
        self.extra_keys = tuple(unravel_key(key) for key in extra_keys)
        require_free((*self.keys.required, *self.extra_keys))
        self._store = EpisodeStore(
            int(capacity), frame_capacity=frame_capacity, scratch_dir=scratch_dir, device=self.device
        )
        self._views: dict[RowSelection, TensorDictReplayBuffer] = {}
        self._encoder: TensorDictModuleBase | None = None
        self._encoded = False
        self._encodings = 0
        self._warned = False  # of offline data that are overwritten

    def __len__(self) -> int:
        return len(self.transitions)

    @property
    def frames(self) -> RowStore:
        """All observations, a TorchRL replay buffer."""
        return self._store.frames

    @property
    def transitions(self) -> RowStore:
        """All transitions with their labels and posteriors, a TorchRL replay buffer."""
        return self._store.transitions

    @property
    def capacity(self) -> int:
        """Transitions that there is room for."""
        return self._store.capacity

    @property
    def frame_capacity(self) -> int:
        """Observations that there is room for now."""
        return self._store.frame_capacity

    @property
    def write_count(self) -> int:
        """Transitions written so far, overwritten ones included."""
        return self.transitions.write_count

    @property
    def version(self) -> tuple[int, int]:
        """Another one whenever rows were written or encoded anew."""
        return self.write_count, self._encodings

    def add(self, episodes: Episodes, tag: Tag | str) -> None:
        """Label and store whole episodes.

        Args:
            episodes: with the entries of ``keys``, each from its first step on, in any way that
                :func:`~ls3_torchrl.data.split_episodes` takes: ``[T]``, ``[N, T]``, or a list or lazy stack of
                episodes of different lengths.
            tag: where they come from.
        """
        tag = Tag.parse(tag)
        self._add([(episode, tag) for episode in split_episodes(episodes)])

    def extend(self, episodes: Episodes) -> Tensor:
        """Label and store whole episodes, as a collector hands them over.

        Their origin is read from the entry ``tag``, a name or number that is the same for all steps of an episode;
        without it they are online ones.

        Args:
            episodes: as in :meth:`add`. Where they tell which steps are done, their last ones must be.

        Returns:
            Indices of the rows in :attr:`transitions`, int64 ``[n]``.

        Raises:
            ValueError: for an episode that has not ended, or of several tags.
        """
        tagged = [(episode, tag_of(episode)) for episode in split_episodes(episodes)]
        for episode, _ in tagged:
            done = done_steps(episode)
            if done is not None and not done[-1]:
                raise ValueError(
                    f"An episode of {len(episode)} steps has not ended: its last step is not done. Hand over whole "
                    "episodes: collect with Collector(..., trajs_per_batch=1), or let frames_per_batch be whole "
                    "episodes. Episodes that were cut off on purpose go in through add(episodes, tag)."
                )
        return self._add(tagged)

    def _add(self, tagged: list[tuple[TensorDictBase, Tag]]) -> Tensor:
        """Check all, then encode all, then write all: where one is refused, none is stored."""
        keys = self.keys
        episodes = conform([episode for episode, _ in tagged], keys, self.extra_keys, who="TaggedReplayBuffer.add")
        if self.success_tail is not None:
            tail = self.success_tail
            episodes = [e[: length_without_idle_end(e.get(keys.success), tail)] for e in episodes]
        self._require_room(episodes, [tag for _, tag in tagged])
        if episodes:
            self._require_as_stored(episodes[0])
        written = [
            self._rows_of(episode, tag) for episode, (_, tag) in zip(episodes, tagged, strict=True)
        ]  # before anything is written: the encoder may fail
        indices = []
        for (frames, rows), (_, tag) in zip(written, tagged, strict=True):
            keep = tag != Tag.ONLINE and self._store.keeps_all
            self._warn_of_eviction(len(rows))
            indices.append(self._store.write(frames, rows))
            if keep:
                self._store.keep()
        for view in self._views.values():
            view.sampler.refresh()
        return torch.cat(indices) if indices else torch.zeros(0, dtype=torch.long)

    def _require_room(self, episodes: list[TensorDictBase], tags: list[Tag]) -> None:
        """Refuse episodes that are too long, and offline data that cannot all be kept."""
        online = tags.index(Tag.ONLINE) if Tag.ONLINE in tags else len(tags)
        offline = [len(episode) for episode in episodes[:online]] if self._store.keeps_all else []
        there, steps = len(self), sum(offline)
        if there + steps > self.capacity:
            raise ValueError(
                f"The offline data have {there + steps} transitions, of which none is overwritten, and the buffer has "
                f"room for {self.capacity}. Raise capacity to at least that, and to more for online episodes."
            )
        self._store.require_room_for(offline, [len(episode) for episode in episodes[len(offline) :]])

    def _warn_of_eviction(self, steps: int) -> None:
        """Say it, once, when offline data that came after online episodes are overwritten."""
        store = self.transitions
        if self._warned or store.write_count + steps <= self.capacity:
            return
        rows = store.later(torch.tensor(store.cursor), torch.arange(steps))
        tags = store.storage[rows[rows < len(store)].to(self.device)]["tag"]
        lost = {tag: int((tags == int(tag)).sum()) for tag in Tag if tag != Tag.ONLINE}
        if any(lost.values()):
            self._warned = True
            told = ", ".join(f"{count} of {tag.name.lower()}" for tag, count in lost.items() if count)
            warnings.warn(
                f"A buffer of {self.capacity} transitions is full and overwrites its oldest, offline data that were "
                f"added after online episodes among them: {told}. Add offline data first, or give it more capacity.",
                DataWarning,
                stacklevel=4,
            )

    def _rows_of(self, episode: TensorDictBase, tag: Tag) -> tuple[TensorDict, TensorDict]:
        """Observations ``[T + 1]`` and transitions ``[T]`` of an episode."""
        keys = self.keys
        frames = torch.cat([episode.get(keys.observation), episode.get(keys.next_observation)[-1:]])
        rows = episode_rows(
            episode,
            self._posteriors_of_new(frames),
            tag,
            keys=keys,
            extra_keys=self.extra_keys,
            gamma=self.gamma,
        )
        return TensorDict({}, [len(frames)]).set(keys.observation, frames), rows

    def _require_as_stored(self, episode: TensorDictBase) -> None:
        """Refuse entries of another shape or dtype than those that are stored."""
        if not len(self):
            return
        stored = [
            (self.frames, self.keys.observation),
            *((self.transitions, k) for k in (self.keys.action, *self.extra_keys)),
        ]
        for store, key in stored:
            there, new = store.storage[0].get(key), episode.get(key)
            if there.shape != new.shape[1:] or there.dtype != new.dtype:
                raise ValueError(
                    f"TaggedReplayBuffer.add: {key!r} has {new.dtype} {list(new.shape[1:])} for each step, where the "
                    f"buffer holds {there.dtype} {list(there.shape)}. Make another buffer for other episodes."
                )

    def _posteriors_of_new(self, frames: Tensor) -> TensorDict:
        if self._encoder is not None:
            return self._encode(self._encoder, frames)
        if self._encoded:
            raise RuntimeError(
                "The buffer was loaded with latents, but without the encoder that new episodes need. Call "
                "buffer.encode(encoder) before loading (on the empty buffer it only keeps the encoder), or now, "
                "which encodes all frames again."
            )
        blank = torch.zeros(len(frames), self.latent_dim)
        return TensorDict({"loc": blank, "scale": blank}, [len(frames)])

    def encode(self, encoder: TensorDictModuleBase, *, progress: Callable[[int, int], None] | None = None) -> None:
        """Fill the latents of all rows, and encode the rows to come with the same encoder.

        Where it fails, the buffer stays as it was.

        Args:
            encoder: the trained f_enc: any module from one observation to ``loc`` and ``scale``, or to a ``latent``
                that it is certain of. One that reads a single key may call it anything.
            progress: called with (frames done, frames in all).
        """
        if len(self):
            rows = self.transitions.storage[:]
            slot, after = self._store.slots(rows["frame"])
            posteriors = self._encode(encoder, self.frames.storage[:].get(self.keys.observation), progress)
            for key in ("loc", "scale"):  # in place: the rows are a view of the storage
                rows.get(key).copy_(posteriors[key][slot])
                rows.get(("next", key)).copy_(posteriors[key][after])
        self._encoder, self._encoded = encoder, True
        self._encodings += 1

    def _encode(
        self, encoder: TensorDictModuleBase, frames: Tensor, progress: Callable[[int, int], None] | None = None
    ) -> TensorDict:
        posteriors = encode_frames(
            encoder, frames, key=self.keys.observation, latent_dim=self.latent_dim, progress=progress
        )
        return posteriors.to(self.device)

    def view(self, selection: RowSelection | None = None, **filters: Any) -> TensorDictReplayBuffer:
        """A TorchRL buffer on the same transitions that samples from the rows of a selection.

        Args:
            selection: which rows; all when neither it nor filters are given.
            filters: its fields, in its place.
        """
        selection = RowSelection.of(selection, filters)
        view = self._views.get(selection)
        if view is None:
            view = self._views[selection] = TensorDictReplayBuffer(
                storage=self.transitions.storage,
                sampler=TagSampler(selection, later=self.transitions.later),
                writer=ImmutableDatasetWriter(),
            )
        return view

    def count(self, selection: RowSelection | None = None, **filters: Any) -> int:
        """How many transitions a selection admits; the arguments are those of :meth:`view`."""
        view = self.view(selection, **filters)
        return int(view.sampler.rows(view.storage).numel())

    def sample(
        self,
        batch_size: int,
        selection: RowSelection | None = None,
        *,
        members: int | None = None,
        observations: bool = False,
        **filters: Any,
    ) -> TensorDictBase:
        """Transitions of a selection with freshly drawn latents, uniformly where it asks for no online fraction.

        Args:
            batch_size: B.
            selection: which rows; all when neither it nor filters are given.
            members: M for a bootstrap: B transitions drawn independently for each of M members.
            observations: add the observations before and after; then no encoder is needed, and latents are zero
                without.
            filters: fields of :class:`~ls3_torchrl.data.RowSelection` in its place, such as ``tags=["success"]``.

        Returns:
            ``[B]``, or ``[B, M]``, or either with K behind for stretches of ``steps=K``: the entries of ``keys`` and
            ``extra_keys``, the labels ``tag``, ``in_success``, ``after_violation``, ``timed_out`` and
            ``reward_to_go``, and the posteriors ``loc`` and ``scale`` with ``latent`` drawn from them, here and under
            ``next``.
        """
        selection = RowSelection.of(selection, filters)
        if not observations:
            self._require_latents()
        rows = self._stretches(batch_size * (members or 1), selection)[1]
        if observations:
            for group, slot in zip((rows, rows.get("next")), self._store.slots(rows["frame"]), strict=True):
                group.set(self.keys.observation, self.frames.storage[slot].get(self.keys.observation))
        rows = rows.to(self.device)
        for group in (rows, rows.get("next")):
            loc = group.get("loc")
            group.set("latent", torch.addcmul(loc, group.get("scale"), torch.randn_like(loc)))
        steps = [] if selection.steps is None else [selection.steps]
        return rows.reshape(batch_size, *([] if members is None else [members]), *steps)

    def _require_latents(self) -> None:
        if not self._encoded:
            raise RuntimeError("The buffer has no latents yet: call buffer.encode(encoder) after training the VAE.")

    def draw(
        self,
        batches: int,
        batch_size: int,
        selection: RowSelection | None = None,
        *,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Numbers of rows for many batches at once, int64 ``[batches, batch_size]``; of stretches the first rows.

        Args:
            batches: how many.
            batch_size: rows in each.
            selection: which rows; all when ``None``.
            generator: of the random numbers, on the CPU; PyTorch's own when ``None``.

        Raises:
            RuntimeError: without encoder, or without rows of the selection.
        """
        self._require_latents()
        view = self.view(selection)
        return view.sampler.draw(view.storage, batches, batch_size, generator=generator)

    def _stretches(self, count: int, selection: RowSelection) -> tuple[TensorDictBase, TensorDictBase]:
        """The first rows ``[count]`` of stretches of one episode each, and all of their rows ``[count * steps]``."""
        view, steps = self.view(selection), selection.steps or 1
        first = view.sample(count)
        if steps == 1:
            return first, first
        index = first.get("index").reshape(count, 1)
        row = self.transitions.later(index, torch.arange(steps, device=index.device))
        return first, view.storage[row.flatten()]

    def sample_frame_transitions(
        self, batch_size: int, selection: RowSelection | None = None, **filters: Any
    ) -> TensorDictBase:
        """Observations before and after, and actions, of transitions from the rows of a selection.

        Unlike :meth:`sample`, it needs no encoder. With ``steps`` K, the next observation is that of K steps later and
        the actions ``[B, K, A]`` lead there.

        Args:
            batch_size: B.
            selection: which rows; all when neither it nor filters are given.
            filters: its fields, in its place.

        Returns:
            ``[B]``, with the observations and the action under ``keys``.
        """
        selection = RowSelection.of(selection, filters)
        keys, steps = self.keys, selection.steps
        first, rows = self._stretches(batch_size, selection)
        action = rows.get(keys.action)
        batch = TensorDict({}, [batch_size])
        batch.set(keys.action, action if steps is None else action.unflatten(0, (batch_size, steps)))
        frame = first["frame"]
        for key, number in ((keys.observation, frame), (keys.next_observation, frame + (steps or 1))):
            batch.set(key, self.frames.storage[self._store.slots(number)[0]].get(keys.observation))
        return batch.to(self.device)

    def sample_frames(self, batch_size: int) -> TensorDictBase:
        """Observations ``[B, ...]`` under their key, uniformly from all frames."""
        if len(self.frames) == 0:
            raise RuntimeError("The buffer holds no frames yet: add episodes first.")
        return self.frames.sample(batch_size).to(self.device)

    def mean_frame(self, *, frames: int = 4096) -> Tensor:
        """The mean of ``frames`` observations drawn at random, float32; of uint8 images it lies in [0, 1]."""
        key, means, unit = self.keys.observation, [], 1.0
        for _ in range(-(-frames // 512)):
            batch = self.sample_frames(512).get(key)
            unit = 255.0 if batch.dtype == torch.uint8 else 1.0
            means.append(batch.float().mean(0))
        return torch.stack(means).mean(0) / unit

    def _settings(self) -> dict[str, Any]:
        """What the content of a buffer depends on, in the form that JSON gives back."""
        return json.loads(
            json.dumps(
                {
                    "capacity": self.capacity,
                    "latent_dim": self.latent_dim,
                    "gamma": self.gamma,
                    "success_tail": self.success_tail,
                    "keys": asdict(self.keys),
                    "extra_keys": self.extra_keys,
                }
            )
        )

    def _require_settings(self, settings: dict[str, Any]) -> None:
        for name, own in self._settings().items():
            if settings[name] != own:
                raise ValueError(
                    f"The content was saved by a buffer with {name}={settings[name]!r}, but this one has {own!r}. "
                    "Make the buffer with the settings of the saved one."
                )

    def state_dict(self) -> dict[str, Any]:
        """A copy of the whole content, which ``torch.load(weights_only=True)`` can read.

        For content larger than memory there is :meth:`dumps`. The encoder is not part of it.
        """
        return {"settings": self._settings(), "encoded": self._encoded, "store": self._store.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the content of a buffer with the same settings, which then draws the same batches.

        The latents come with it. The encoder, which only new episodes need, is the one that this buffer has: call
        :meth:`encode` before, while the buffer is empty, and nothing is encoded again.

        Raises:
            ValueError: when the settings differ.
        """
        self._require_settings(state_dict["settings"])
        self._store.load_state_dict(state_dict["store"])
        self._after_loading(state_dict["encoded"])

    def dumps(self, path: str | Path) -> None:
        """Write the whole content below the folder ``path``, over an earlier one.

        Raises:
            ValueError: for the folder that the buffer itself works in.
            FileExistsError: for a folder with other files.
        """
        self._store.dumps(path, {"settings": self._settings(), "encoded": self._encoded})

    def loads(self, path: str | Path) -> None:
        """Take over what :meth:`dumps` has written, as :meth:`load_state_dict` does. No pickles are read.

        Raises:
            FileNotFoundError: when the folder holds no whole buffer.
            ValueError: when the settings differ.
        """
        description = EpisodeStore.description(path)
        self._require_settings(description["settings"])
        self._store.loads(path)
        self._after_loading(description["encoded"])

    # The names that torchrl.checkpoint.Checkpoint looks for.
    dump, load = dumps, loads

    def _after_loading(self, encoded: bool) -> None:
        self._encoded = encoded
        self._encodings += 1
        if not encoded:
            self._encoder = None  # its latents are not those of the rows
        for view in self._views.values():
            view.sampler.refresh()
