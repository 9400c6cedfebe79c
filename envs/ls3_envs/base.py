"""What every visual domain with a constraint shares: specs, seeding, freezing and the horizon."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from ls3_envs._checks import whole_number
from ls3_envs._devices import usable_device
from ls3_envs.plane import Plane
from ls3_envs.seeding import checked_seed, process_id, unused_seed

#: How far outside the box an action may lie before it counts as a mistake: rounding, no more.
ACTION_TOLERANCE = 1e-4


class VisualConstraintEnv(EnvBase):
    """N copies of a domain stepped together; each shows an image and may violate a constraint.

    Every step returns the key set that the agents rely on: ``pixels`` (uint8 ``[N, 3, 64, 64]``), ``state``
    (the domain's low-dimensional state, for pictures and scripted demonstrators, never for the agent),
    ``reward`` (−1 outside the goal set, 0 in it), ``constraint`` and ``success`` (bool ``[N, 1]``).

    Episodes always run to the horizon and end by truncation; ``terminated`` is never set. A violation freezes
    its environment for the rest of the episode, as in the supplement, section 1.1.2.

    Rows are independent: environment ``i`` under seed ``s`` goes the same way whatever ``num_envs`` is.

    A domain defines five methods: ``_initial_state``, ``_advance``, ``_render``, ``_violates`` and ``_succeeds``; one
    whose states are points of a plane also :meth:`plane` and :meth:`advance_noiseless`, which pictures use.

    An action is ``[N, A]``, one row for each environment, of floating-point or whole numbers, and computed with in
    float32. One of another shape, outside the box or not finite is refused, and whatever a step raises, the
    environments are as they were before it. Steps after the end of an episode go on, each of them ``truncated``, until
    a reset.

    Copies, pickled ones too, share nothing with the original and go on as it does.

    Args:
        num_envs: how many environments N are stepped in one call; at least 1.
        state_dim: size of the low-dimensional state.
        action_low: smallest action per axis, in the domain's own units.
        action_high: largest action per axis.
        horizon: steps in an episode, at least 1.
        image_size: side of the square image in pixels.
        device: where states and images live.
        seed: seed of the environments' random streams, a whole number from 0. When ``None`` it is drawn from torch's
            global generator; in a worker process, which may have inherited that one, from the operating system. Taken
            to another process, environments without a seed draw a new one at their next reset.

    Raises:
        ValueError: for fewer than one environment or step, a negative seed, or a device that is not there; by ``step``
            for an action of another shape, outside the box or not finite.
        TypeError: for numbers of environments, steps and seeds that are not whole; by ``step`` for an action that does
            not consist of numbers.
        RuntimeError: by ``step`` before the first ``reset``.
    """

    def __init__(
        self,
        *,
        num_envs: int,
        state_dim: int,
        action_low: Sequence[float],
        action_high: Sequence[float],
        horizon: int,
        image_size: int = 64,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        num_envs = whole_number(num_envs, "num_envs")
        horizon = whole_number(horizon, "horizon", unit=" step")
        image_size = whole_number(image_size, "image_size", unit=" pixel")
        if seed is not None:
            seed = checked_seed(seed)
        super().__init__(device=usable_device(device), batch_size=torch.Size([num_envs]))
        self.num_envs = num_envs
        self.horizon = horizon
        self.image_size = image_size

        def flag() -> Binary:
            return Binary(shape=(num_envs, 1), dtype=torch.bool, device=self.device)

        self.observation_spec = Composite(
            pixels=Bounded(
                low=0,
                high=255,
                shape=(num_envs, 3, image_size, image_size),
                dtype=torch.uint8,
                device=self.device,
            ),
            state=Unbounded(shape=(num_envs, state_dim), device=self.device),
            constraint=flag(),
            success=flag(),
            shape=self.batch_size,
            device=self.device,
        )
        low = torch.tensor(action_low, dtype=torch.float32, device=self.device)
        high = torch.tensor(action_high, dtype=torch.float32, device=self.device)
        self.action_spec = Bounded(
            low=low.expand(num_envs, -1),
            high=high.expand(num_envs, -1),
            shape=(num_envs, low.shape[0]),
            dtype=torch.float32,
            device=self.device,
        )
        self.reward_spec = Bounded(low=-1.0, high=0.0, shape=(num_envs, 1), device=self.device)
        self.full_done_spec = Composite(
            done=flag(), terminated=flag(), truncated=flag(), shape=self.batch_size, device=self.device
        )
        self._state = torch.zeros(num_envs, state_dim, device=self.device)
        self._frozen = torch.zeros(num_envs, 1, dtype=torch.bool, device=self.device)
        self._clock = torch.zeros(num_envs, dtype=torch.long, device=self.device)
        self._started = False
        self._generators: list[np.random.Generator] = []
        self._streams: list[dict] = []
        self._unseeded: list[bytes | None] = []
        self._set_seed(seed)

    @abstractmethod
    def _initial_state(self, index: int, generator: np.random.Generator) -> Tensor:
        """First state ``[state_dim]`` of the environment ``index``; may also sample what the episode needs."""

    @abstractmethod
    def _advance(self, state: Tensor, action: Tensor) -> Tensor:
        """States one step on, ``[N, state_dim]``; the base keeps frozen environments where they are."""

    @abstractmethod
    def _render(self, state: Tensor) -> Tensor:
        """Images of states ``[N, state_dim]`` as uint8 ``[N, 3, image_size, image_size]``."""

    @abstractmethod
    def _violates(self, state: Tensor) -> Tensor:
        """Bool ``[N, 1]``: the state breaks the constraint."""

    @abstractmethod
    def _succeeds(self, state: Tensor) -> Tensor:
        """Bool ``[N, 1]``: the state lies in the goal set."""

    def render_states(self, state: Tensor) -> Tensor:
        """Images uint8 ``[n, 3, image_size, image_size]`` of any states ``[n, state_dim]``, for pictures."""
        return self._render(state.to(self.device))

    def render_rgb(self) -> Tensor:
        """All as they are now, in colour, uint8 ``[N, 3, image_size, image_size]``, whatever the agent sees.

        A domain whose observation is not a colour picture overrides it.
        """
        return self._render(self._state)

    def plane(self, points: int = 60) -> Plane | None:
        """The plane that maps and paths are drawn on, with its walls and goals; ``None`` where there is none.

        A domain that has one also defines :meth:`advance_noiseless`.

        Args:
            points: grid points along the longer side.
        """
        return None

    def advance_noiseless(self, state: Tensor, action: Tensor) -> Tensor:
        """Where any states get to by one step without noise, for pictures of plans.

        What the environments do now plays no part and does not change; violations freeze nothing here.

        Args:
            state: ``[*B, state_dim]``.
            action: in the domain's units, ``[*B, A]``, on the states' device.

        Returns:
            States ``[*B, state_dim]``.

        Raises:
            NotImplementedError: where the domain does not define it.
        """
        raise NotImplementedError(
            f"{type(self).__name__} does not say how its states move without noise. "
            "A domain that has a plane() defines advance_noiseless(state, action), too."
        )

    def render_frames(self, size: int) -> Tensor:
        """All as they are now, in colour, at another size for videos: uint8 ``[N, 3, size, size]``.

        A domain that can draw itself at any size overrides it; here the frames of :meth:`render_rgb` are enlarged.

        Args:
            size: side of the frames in pixels.
        """
        frames = self.render_rgb().float()
        return torch.nn.functional.interpolate(frames, (size, size), mode="nearest").to(torch.uint8)

    def _set_seed(self, seed: int | None) -> None:
        entropy = unused_seed() if seed is None else checked_seed(seed)
        self._generators = [_stream(entropy, index) for index in range(self.num_envs)]
        self._streams = [dict(generator.bit_generator.state) for generator in self._generators]
        #: Of each environment without a seed, the process in which its stream was begun.
        self._unseeded = [process_id() if seed is None else None] * self.num_envs

    def set_seeds(self, seeds: Sequence[int | None]) -> None:
        """Give each environment a seed of its own: it then goes the way that it goes alone under that seed.

        Args:
            seeds: one whole number from 0 for each environment; one with ``None`` goes on with its stream.

        Raises:
            ValueError: for another number of seeds, or a negative one.
            TypeError: for a seed that is no whole number.
        """
        if len(seeds) != self.num_envs:
            raise ValueError(f"seeds must be {self.num_envs}, one for each environment; got {len(seeds)}.")
        checked = [None if seed is None else checked_seed(seed, f"seeds[{i}]") for i, seed in enumerate(seeds)]
        for index, seed in enumerate(checked):
            if seed is not None:
                self._generators[index], self._unseeded[index] = _stream(seed, 0), None
                self._streams[index] = dict(self._generators[index].bit_generator.state)

    def _leave_other_processes_streams(self) -> None:
        """New streams where one without a seed was begun in another process, whose copies may all go on with it."""
        if any(begun not in (None, process_id()) for begun in self._unseeded):
            entropy = unused_seed()
            for index, begun in enumerate(self._unseeded):
                if begun not in (None, process_id()):
                    self._generators[index], self._unseeded[index] = _stream(entropy, index), process_id()

    def random_state(self) -> list[dict]:
        """The random streams of all environments, as they stood before each one's last reset; numbers and names only.

        After :meth:`set_random_state` of it, ``reset`` begins the same episodes again.
        """
        return list(self._streams)

    def set_random_state(self, state: list[dict]) -> None:
        """Continue with the streams that :meth:`random_state` gave.

        Raises:
            ValueError: for another number of environments.
        """
        if len(state) != self.num_envs:
            raise ValueError(
                f"random_state must have one stream for each of {self.num_envs} environments, got {len(state)}."
            )
        for generator, stream in zip(self._generators, state, strict=True):
            generator.bit_generator.state = stream
        self._streams, self._unseeded = list(state), [None] * self.num_envs

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = torch.arange(self.num_envs) if mask is None else mask.reshape(self.num_envs).nonzero().flatten().cpu()
        self._leave_other_processes_streams()
        state, clock, frozen = self._state.clone(), self._clock.clone(), self._frozen.clone()
        for index in rows.tolist():
            self._streams[index] = dict(self._generators[index].bit_generator.state)
            state[index] = self._initial_state(index, self._generators[index]).to(state)
        clock[rows] = 0
        frozen[rows] = self._violates(state)[rows]
        self._state, self._clock, self._frozen, self._started = state, clock, frozen, True
        return self._observe()

    def _observe(self) -> TensorDict:
        state = self._state.clone()
        return TensorDict(
            {
                "pixels": self._render(state),
                "state": state.float(),
                "constraint": self._violates(state),
                "success": self._succeeds(state),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _checked_action(self, action: Tensor | None) -> Tensor:
        """The action in float32, on the environments' device."""
        space = self.action_spec.space
        if not isinstance(action, Tensor):
            raise KeyError(
                "The tensordict has no tensor 'action'. Set it before env.step, or pass a policy to rollout."
            )
        if action.dtype == torch.bool or action.is_complex():
            raise TypeError(f"An action must consist of floating-point or whole numbers, got dtype {action.dtype}.")
        if action.shape != space.low.shape:
            raise ValueError(
                f"An action must have shape {list(space.low.shape)}, one row for each environment; "
                f"got {list(action.shape)}."
            )
        action = action.detach().to(space.low)
        excess = torch.maximum(space.low - action, action - space.high).amax()
        if not excess <= ACTION_TOLERANCE:  # also catches NaN
            raise ValueError(
                f"An action lies outside the action spec or is not finite: received values from "
                f"{action.amin().item():.4g} to {action.amax().item():.4g}, allowed are "
                f"{space.low[0].tolist()} to {space.high[0].tolist()}. "
                "Pass it through env.action_spec.project(action) first."
            )
        return action

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self._started:
            raise RuntimeError("The environment was stepped before its first reset. Call env.reset() first.")
        action = self._checked_action(tensordict.get("action", None))
        before = self._state, self._clock, self._frozen
        try:
            return self._stepped(action)
        except BaseException:
            self._state, self._clock, self._frozen = before
            raise

    def _stepped(self, action: Tensor) -> TensorDict:
        moved = self._advance(self._state, action)
        self._state = torch.where(self._frozen, self._state, moved)
        self._clock = self._clock + 1
        out = self._observe()
        self._frozen = self._frozen | out["constraint"]
        truncated = (self._clock >= self.horizon).unsqueeze(-1)
        out.update(
            {
                "reward": out["success"].float() - 1.0,
                "truncated": truncated,
                "terminated": torch.zeros_like(truncated),
                "done": truncated.clone(),
            }
        )
        return out


def _stream(seed: int, index: int) -> np.random.Generator:
    """The random stream of the environment ``index`` under a seed."""
    return np.random.default_rng(np.random.SeedSequence([seed, index]))
