"""The replay buffer: a pixel store for the VAE, a latent store for everything else, views by tag."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torchrl.data import (
    ImmutableDatasetWriter,
    LazyMemmapStorage,
    LazyTensorStorage,
    TensorDictReplayBuffer,
)
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.data.replay_buffers.storages import Storage

from ls3_torchrl._checks import require_at_least, require_finite, require_keys
from ls3_torchrl.data.labels import (
    after_violation,
    failure_tail,
    in_success,
    length_without_idle_end,
    reward_to_go,
    timed_out,
)
from ls3_torchrl.data.sampler import TagSampler
from ls3_torchrl.data.tags import ALL_TAGS, Tag
from ls3_torchrl.modules.vae import PixelEncoder


class TaggedReplayBuffer:
    """Episodes in two stores: every frame's image once, and every transition with its latents and labels.

    Latents are kept as posteriors (``loc``, ``scale``) and drawn afresh whenever a row is sampled. Before an
    encoder is known only the pixel store can be sampled; :meth:`encode` fills the latents of all rows and
    keeps the encoder for the rows to come.

    Args:
        capacity: transitions kept; the oldest are overwritten.
        latent_dim: D.
        gamma: γ of the ``reward_to_go`` labels.
        continue_failures: label episodes that never reach the goal as if they went on for ever
            (:func:`~ls3_torchrl.data.failure_tail`), instead of ending with the horizon.
        success_tail: steps kept of the successes that an episode ends with; ``None`` keeps all. Once the task is done
            nothing happens, and such steps can be most of the data.
        extra_keys: entries of the episodes, beside the standard ones, that are kept with their transitions.
        pixel_capacity: frames kept; ``None`` makes room for the same episodes, frames at both ends included.
        scratch_dir: memory-map both stores below this folder instead of holding them in memory.
        device: where sampled batches live.

    Raises:
        ValueError: for a capacity below 1, or (in :meth:`add`) data that are not finite.
        KeyError: in :meth:`add`, for a missing key.
        RuntimeError: in :meth:`sample`, without encoder or without rows of the tags; in :meth:`encode` and
            :meth:`sample_pixel_transitions`, when frames were overwritten.

    Example:
        >>> from ls3_torchrl.modules import PixelEncoder
        >>> step = {"reward": -torch.ones(9, 1), "pixels": torch.zeros(9, 3, 64, 64, dtype=torch.uint8)}
        >>> step |= {k: torch.zeros(9, 1, dtype=torch.bool) for k in ("constraint", "success")}
        >>> episode = TensorDict({"pixels": step["pixels"], "action": torch.zeros(9, 2), "next": step}, [9])
        >>> buffer = TaggedReplayBuffer(capacity=100, latent_dim=8)
        >>> buffer.add(episode, "success")
        >>> buffer.sample_pixels(4)["pixels"].shape
        torch.Size([4, 3, 64, 64])
        >>> buffer.encode(PixelEncoder(latent_dim=8))
        >>> buffer.sample(4, tags=["success"])["next", "latent"].shape
        torch.Size([4, 8])
        >>> buffer.sample(4, tags=["success"], members=5)["latent"].shape
        torch.Size([4, 5, 8])
    """

    def __init__(
        self,
        capacity: int,
        *,
        latent_dim: int = 32,
        gamma: float = 0.99,
        continue_failures: bool = False,
        success_tail: int | None = None,
        extra_keys: Iterable[NestedKey] = (),
        pixel_capacity: int | None = None,
        scratch_dir: str | Path | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.capacity = require_at_least(capacity, 1, "capacity")
        # An episode of T transitions has T + 1 frames; episodes of fewer than 16 steps need more room.
        room = capacity + capacity // 16 + 64 if pixel_capacity is None else pixel_capacity
        self.pixel_capacity = require_at_least(room, 2, "pixel_capacity")
        self.latent_dim = require_at_least(latent_dim, 1, "latent_dim")
        self.gamma = gamma
        self.continue_failures = continue_failures
        self.success_tail = None if success_tail is None else require_at_least(success_tail, 1, "success_tail")
        self.device = torch.device(device)
        self.extra_keys = tuple(extra_keys)
        folder = None if scratch_dir is None else Path(scratch_dir)

        def storage(size: int, name: str) -> Storage:
            if folder is None:
                return LazyTensorStorage(size, device=self.device)
            return LazyMemmapStorage(size, scratch_dir=str(folder / name))

        self.pixels = TensorDictReplayBuffer(storage=storage(self.pixel_capacity, "pixels"), sampler=RandomSampler())
        self.latents = TensorDictReplayBuffer(storage=storage(self.capacity, "latents"), sampler=RandomSampler())
        self._views: dict[tuple[tuple[Tag, ...], NestedKey | None, int, float], TensorDictReplayBuffer] = {}
        self._encoder: PixelEncoder | None = None
        self._frames_written = 0

    def __len__(self) -> int:
        return len(self.latents)

    def add(self, episodes: TensorDictBase, tag: Tag | str) -> None:
        """Label and store whole episodes.

        Args:
            episodes: ``[T]`` or ``[N, T]`` with ``pixels``, ``action`` and, under ``next``, ``pixels``,
                ``reward``, ``constraint`` and ``success``; each row one episode from its first step on.
            tag: where they come from.
        """
        tag = Tag.parse(tag)
        needed = ("pixels", "action", *(("next", k) for k in ("pixels", "reward", "constraint", "success")))
        require_keys(episodes, (*needed, *self.extra_keys), "TaggedReplayBuffer.add")
        if episodes.ndim not in (1, 2):
            raise ValueError(f"Episodes must have batch size [T] or [N, T], got {list(episodes.shape)}.")
        for episode in episodes.unbind(0) if episodes.ndim == 2 else [episodes]:
            self._add_one(episode, tag)
        for view in self._views.values():
            view.sampler.refresh()

    def _add_one(self, episode: TensorDictBase, tag: Tag) -> None:
        if self.success_tail is not None:
            episode = episode[: length_without_idle_end(episode["next", "success"], self.success_tail)]
        steps = episode.shape[0]
        if steps + 1 > self.pixel_capacity or steps > self.capacity:
            raise ValueError(
                f"An episode of {steps} steps does not fit a buffer of {self.capacity} transitions and "
                f"{self.pixel_capacity} frames. Raise capacity."
            )
        require_finite(episode.get("action"), "The episode's action")
        require_finite(episode.get(("next", "reward")), "The episode's reward")
        frames = torch.cat([episode["pixels"], episode["next", "pixels"][-1:]])
        first = self._frames_written
        self._frames_written += steps + 1
        self.pixels.extend(TensorDict({"pixels": frames}, [steps + 1]))
        reward, success = episode["next", "reward"], episode["next", "success"]
        tail = failure_tail(reward, success, self.gamma) if self.continue_failures else None
        rows = TensorDict(
            {
                "action": episode["action"],
                "tag": torch.full((steps, 1), int(tag), dtype=torch.uint8),
                "in_success": in_success(success),
                "after_violation": after_violation(episode["next", "constraint"]),
                "timed_out": timed_out(success, episode["next", "constraint"]),
                "reward_to_go": reward_to_go(reward, self.gamma, tail),
                "frame": first + torch.arange(steps).unsqueeze(-1),
                "steps_left": torch.arange(steps, 0, -1).unsqueeze(-1),
                "next": {
                    "reward": reward,
                    "constraint": episode["next", "constraint"],
                    "success": success,
                },
            },
            [steps],
        )
        rows.update(episode.select(*self.extra_keys))
        if self._encoder is None:
            blank = torch.zeros(steps + 1, self.latent_dim)
            posteriors = TensorDict({"loc": blank, "scale": blank}, [steps + 1])
        else:
            posteriors = self._encode_frames(frames)
        for key in ("loc", "scale"):
            rows[key] = posteriors[key][:-1]
            rows["next", key] = posteriors[key][1:]
        self.latents.extend(rows)

    def encode(self, encoder: PixelEncoder, *, progress: Callable[[int, int], None] | None = None) -> None:
        """Fill the latents of all rows, and encode the rows to come with the same, frozen encoder.

        Args:
            encoder: the trained f_enc.
            progress: called with (frames done, frames in all).
        """
        rows = self.latents.storage[:] if len(self) else None
        self._encoder = encoder
        if rows is None:
            return
        slot, after = self._slots(rows["frame"])
        posteriors = self._encode_frames(self.pixels.storage[:]["pixels"], progress)
        for key in ("loc", "scale"):  # in place: the rows are a view of the storage
            rows.get(key).copy_(posteriors[key][slot])
            rows.get(("next", key)).copy_(posteriors[key][after])

    def _slots(self, frame: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Where the pixel store keeps the frames before and after transitions, ``[B]`` each."""
        oldest, first = self._frames_written - len(self.pixels), int(frame.min())
        if first < oldest:
            raise RuntimeError(
                f"Frames older than number {oldest} were overwritten, but transitions still need frame {first}. Give "
                f"the buffer a larger pixel_capacity (now {self.pixel_capacity})."
            )
        slot = frame.flatten() % self.pixel_capacity
        return slot, (slot + 1) % self.pixel_capacity

    def _encode_frames(
        self, frames: torch.Tensor, progress: Callable[[int, int], None] | None = None, chunk: int = 512
    ) -> TensorDict:
        encoder = self._encoder
        assert encoder is not None
        weight = next(encoder.parameters())
        parts = []
        with torch.no_grad():
            for start in range(0, len(frames), chunk):
                part = TensorDict({encoder.pixels_key: frames[start : start + chunk].to(weight.device)})
                encoder[0](part)
                parts.append((part.get(encoder.loc_key), part.get(encoder.scale_key)))
                if progress is not None:
                    progress(min(start + chunk, len(frames)), len(frames))
        loc, scale = (torch.cat(values).to(self.device) for values in zip(*parts, strict=True))
        if loc.shape[-1] != self.latent_dim:
            raise ValueError(
                f"The encoder writes latents of size {loc.shape[-1]}, but the buffer was made with "
                f"latent_dim={self.latent_dim}. Give both the same size."
            )
        return TensorDict({"loc": loc, "scale": scale}, [len(frames)])

    def view(
        self,
        tags: Iterable[Tag | str] = ALL_TAGS,
        *,
        without: NestedKey | None = None,
        steps: int = 1,
        online_fraction: float = 0.0,
    ) -> TensorDictReplayBuffer:
        """A TorchRL buffer on the same latent store that samples from the union of ``tags``.

        Args:
            tags: what to draw from.
            without: label whose rows are left out, such as ``"after_violation"``.
            steps: only rows that so many steps of their episode begin with.
            online_fraction: least share of online rows in a draw; see :class:`~ls3_torchrl.data.TagSampler`.
        """
        key = (tuple(sorted({Tag.parse(tag) for tag in tags})), without, steps, online_fraction)
        if key not in self._views:
            self._views[key] = TensorDictReplayBuffer(
                storage=self.latents.storage,
                sampler=TagSampler(key[0], without=without, steps=steps, online_fraction=online_fraction),
                writer=ImmutableDatasetWriter(),
            )
        return self._views[key]

    def count(self, tags: Iterable[Tag | str] = ALL_TAGS) -> int:
        """How many transitions carry one of the tags."""
        view = self.view(tags)
        return int(view.sampler.rows(view.storage).numel())

    def sample(
        self,
        batch_size: int,
        *,
        tags: Iterable[Tag | str] = ALL_TAGS,
        members: int | None = None,
        without: NestedKey | None = None,
        steps: int | None = None,
        pixels: bool = False,
        online_fraction: float = 0.0,
    ) -> TensorDictBase:
        """Transitions with freshly drawn latents, uniformly from the union of the tags where no share is asked for.

        Args:
            batch_size: B.
            tags: what to draw from.
            members: M for a bootstrap: B transitions drawn independently for each of M members.
            without: label whose rows are left out, such as ``"after_violation"``.
            steps: K for stretches of K transitions of one episode, in their order.
            pixels: add ``pixels`` and ``("next", "pixels")``; then no encoder is needed, and latents are zero without.
            online_fraction: least share of online transitions; see :class:`~ls3_torchrl.data.TagSampler`.

        Returns:
            ``[B]``, or ``[B, M]``, or either with K behind, with ``latent`` and ``("next", "latent")`` drawn from the
            posteriors.
        """
        if self._encoder is None and not pixels:
            raise RuntimeError("The buffer has no latents yet: call buffer.encode(encoder) after training the VAE.")
        count = batch_size * (members or 1)
        rows = self._stretches(count, tags, without, steps or 1, online_fraction)[1]
        if pixels:
            for group, slot in zip((rows, rows.get("next")), self._slots(rows["frame"]), strict=True):
                group.set("pixels", self.pixels.storage[slot]["pixels"])
        rows = rows.to(self.device)
        for group in (rows, rows.get("next")):
            loc = group.get("loc")
            group.set("latent", torch.addcmul(loc, group.get("scale"), torch.randn_like(loc)))
        shape = (batch_size, *([] if members is None else [members]), *([] if steps is None else [steps]))
        return rows.reshape(shape)

    def _stretches(
        self,
        count: int,
        tags: Iterable[Tag | str],
        without: NestedKey | None,
        steps: int,
        online_fraction: float = 0.0,
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """The first rows ``[count]`` of stretches of one episode each, and all of their rows ``[count * steps]``."""
        view = self.view(tags, without=without, steps=steps, online_fraction=online_fraction)
        first = view.sample(count)
        if steps == 1:
            return first, first
        row = first.get("index").reshape(count, 1) + torch.arange(steps, device=first.get("index").device)
        return first, view.storage[row.flatten() % self.capacity]

    def sample_pixel_transitions(
        self,
        batch_size: int,
        *,
        tags: Iterable[Tag | str] = ALL_TAGS,
        without: NestedKey | None = None,
        steps: int | None = None,
    ) -> TensorDictBase:
        """``pixels``, ``action`` and ``("next", "pixels")`` of transitions, uniformly from the union of the tags.

        Unlike :meth:`sample`, it needs no encoder. With ``steps`` K, the next pixels are those of K steps later and the
        actions ``[B, K, A]`` lead there.
        """
        first, rows = self._stretches(batch_size, tags, without, steps or 1)
        action = rows["action"] if steps is None else rows["action"].unflatten(0, (batch_size, steps))
        frame = first["frame"]
        before, after = (
            self.pixels.storage[self._slots(number)[0]]["pixels"] for number in (frame, frame + (steps or 1))
        )
        batch = TensorDict({"pixels": before, "action": action, "next": {"pixels": after}}, [batch_size])
        return batch.to(self.device)

    def sample_pixels(self, batch_size: int) -> TensorDictBase:
        """Images ``pixels`` ``[B, C, 64, 64]``, uint8, uniformly from all frames."""
        if len(self.pixels) == 0:
            raise RuntimeError("The buffer holds no images yet: add episodes first.")
        return self.pixels.sample(batch_size).to(self.device)

    def mean_image(self, *, frames: int = 4096) -> torch.Tensor:
        """The mean of ``frames`` images drawn at random, float32 ``[C, 64, 64]`` in [0, 1]."""
        chunks = [self.sample_pixels(512)["pixels"].float().mean(0) for _ in range(-(-frames // 512))]
        return torch.stack(chunks).mean(0) / 255.0
