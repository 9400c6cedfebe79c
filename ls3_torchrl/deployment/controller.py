"""A policy behind a camera: an image in, an action out, as often as the robot asks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from time import perf_counter
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import TensorDictPrimer
from torchrl.modules.utils import get_primers_from_module

from ls3_torchrl._checks import require_at_least, require_keys
from ls3_torchrl.data.pixels import Channels, Fit, pixels_from_images, require_image_settings


class Controller:
    """Turns camera images into actions, one at a time, without an environment.

    It does what environment and collector do for a policy in training: resizes and stacks the images, marks the first
    step of an episode, and carries the last plan to the next step. Only what was there in training can be relied on:
    the same camera, the same ``fit``, the same number of steps a second.

    Making it calls the policy three times with a black image, because first calls are slow: afterwards, and with
    ``agent.planner(max_ms=...)``, it keeps time from the first image on. The random numbers of the process are left as
    they were.

    Args:
        policy: from images to actions: ``agent.planner(max_ms=80)``, a :class:`~ls3_torchrl.planners.SafeSetFilter`
            round a policy of your own, or any other function from a tensordict to one.
        frames: images stacked along the channels, the newest last, as in training. Before there are as many, the first
            one of the episode repeats.
        frame_stride: steps between them.
        size: height and width that images are resized to.
        fit: how: ``"squash"`` or ``"crop"``, see :func:`~ls3_torchrl.data.pixels_from_images`.
        channels: ``"last"`` for images ``[H, W, 3]``, ``"first"`` for ``[3, H, W]``.
        pixels_key: where the policy reads images.
        action_key: where it writes the action.
        device: where it computes.
        example: inputs that calls will bring beside the image, by name, with any values that are allowed.

    Raises:
        ValueError: for frames or steps below 1, or images of another number of channels than the policy's encoder
            needs.
        KeyError: when the policy reads more than images and ``example``, or writes no action.
        TypeError: for a policy that cannot be called.

    Example:
        >>> from torchrl.data import Bounded
        >>> from ls3_torchrl import LS3Agent
        >>> agent = LS3Agent(action_spec=Bounded(low=-1.0, high=1.0, shape=(2,)), latent_dim=8)
        >>> controller = Controller(agent.planner(num_candidates=50, num_elites=5, max_ms=80.0))
        >>> controller.reset()
        >>> image = np.zeros((480, 640, 3), dtype=np.uint8)  # from a camera
        >>> controller.act(image).shape
        (2,)
    """

    def __init__(
        self,
        policy: Callable[[TensorDictBase], TensorDictBase],
        *,
        frames: int = 1,
        frame_stride: int = 1,
        size: int | tuple[int, int] = 64,
        fit: Fit = "squash",
        channels: Channels = "last",
        pixels_key: NestedKey = "pixels",
        action_key: NestedKey = "action",
        device: torch.device | str = "cpu",
        example: Mapping[str, Any] | None = None,
    ) -> None:
        if not callable(policy):
            raise TypeError(
                f"policy must be a function from a tensordict to one, such as agent.planner(), got a "
                f"{type(policy).__name__}."
            )
        self.policy, self.device = policy, torch.device(device)
        require_at_least(frames, 1, "frames")
        self.frame_stride = require_at_least(frame_stride, 1, "frame_stride")
        self._shape = require_image_settings(size, fit, channels)
        self._fit, self._channels = fit, channels
        self._pixels_key, self._action_key = pixels_key, action_key
        self._seen: deque[Tensor] = deque(maxlen=(frames - 1) * frame_stride + 1)
        self._initial = _initial_state(policy).to(self.device)
        self._carried: TensorDictBase = self._initial
        #: Milliseconds that the last call of :meth:`act` took.
        self.milliseconds = 0.0
        self.reset()
        self._warm_up(example or {})

    def _warm_up(self, example: Mapping[str, Any]) -> None:
        black = np.zeros((*self._shape, 3), dtype=np.uint8)
        devices = [self.device] if self.device.type == "cuda" else []
        with torch.random.fork_rng(devices=devices):
            for _ in range(3):
                self.act(black if self._channels == "last" else black.transpose(2, 0, 1), **example)
        self.reset()

    def reset(self) -> None:
        """The next image is the first of an episode: frames and plan of the last one are forgotten."""
        self._seen.clear()
        self._carried = self._initial

    @torch.no_grad()
    def step(self, image: Any, **inputs: Any) -> TensorDictBase:
        """What the policy writes of the next image: the action, and why.

        Args:
            image: uint8 in 0..255, ``[H, W, 3]`` or grey ``[H, W]``, or channels first; an array or a tensor.
            inputs: what the policy reads beside it, by name, without a batch: ``action`` of a person that a
                :class:`~ls3_torchrl.planners.SafeSetFilter` without a policy is to judge, or measurements that an
                encoder of your own needs.

        Returns:
            The policy's keys, such as ``action`` and ``("plan", "fallback")``, without a batch dimension.

        Raises:
            TypeError: for an image that is not uint8.
            ValueError: for an image of another shape.
        """
        begin = perf_counter()
        is_init = not self._seen
        pixels = pixels_from_images(image, size=self._shape, fit=self._fit, channels=self._channels)
        if pixels.ndim != 3:
            raise ValueError(f"The controller takes one image at a time, got {len(pixels)}. Call it once for each.")
        self._seen.extend([pixels] * (self._seen.maxlen or 1) if is_init else [pixels])
        # Rows of one: policies are made for batches.
        entry = TensorDict({"is_init": torch.full((1, 1), is_init)}, [1], device=self.device)
        entry.update(self._carried.copy())  # what the policy adds to a group stays out of what was carried
        entry.set(self._pixels_key, torch.cat(list(self._seen)[:: self.frame_stride]).unsqueeze(0))
        for name, value in inputs.items():
            entry.set(name, torch.as_tensor(value).unsqueeze(0))
        out = self.policy(entry)
        require_keys(out, [self._action_key], "Controller")
        self._carried = out.get("next", self._initial)
        row = out[0]
        self.milliseconds = (perf_counter() - begin) * 1e3
        return row

    def act(self, image: Any, **inputs: Any) -> np.ndarray:
        """The action ``[A]`` for the next image, in the units of the action spec; arguments as of :meth:`step`."""
        return self.step(image, **inputs).get(self._action_key).cpu().numpy()


def _initial_state(policy: object) -> TensorDictBase:
    """What a policy with a memory, such as the planner's last plan, reads at the first step of an episode."""
    primers = get_primers_from_module(policy, warn=False) if isinstance(policy, nn.Module) else None
    state = TensorDict({}, [1])
    for primer in [primers] if isinstance(primers, TensorDictPrimer) else primers or []:
        for key, spec in primer.primers.items(True, True):
            state.set(key, torch.full_like(spec.zero(), primer.default_value[key]).unsqueeze(0))
    return state
