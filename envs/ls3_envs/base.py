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

from ls3_envs.plane import Plane

#: How far outside the box an action may lie before it counts as a mistake: rounding, no more.
_ACTION_TOLERANCE = 1e-4


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

    Args:
        num_envs: how many environments N are stepped in one call; at least 1.
        state_dim: size of the low-dimensional state.
        action_low: smallest action per axis, in the domain's own units.
        action_high: largest action per axis.
        horizon: steps in an episode, at least 1.
        image_size: side of the square image in pixels.
        device: where states and images live.
        seed: seed of the environments' random streams; drawn from torch's global generator when ``None``.

    Raises:
        ValueError: for fewer than one environment or step; by ``step`` for an action of another shape, outside the box
            or not finite.
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
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}.")
        if horizon < 1:
            raise ValueError(f"horizon must be at least 1 step, got {horizon}.")
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
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
        self.set_seed(int(torch.randint(2**31 - 1, ())) if seed is None else seed)

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

    def _set_seed(self, seed: int | None) -> None:
        entropy = 0 if seed is None else int(seed)
        self._generators = [
            np.random.default_rng(np.random.SeedSequence([entropy, index])) for index in range(self.num_envs)
        ]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = torch.arange(self.num_envs) if mask is None else mask.reshape(self.num_envs).nonzero().flatten().cpu()
        for index in rows.tolist():
            self._state[index] = self._initial_state(index, self._generators[index]).to(self._state)
        self._started = True
        self._clock[rows] = 0
        self._frozen[rows] = self._violates(self._state)[rows]
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

    def _check_action(self, action: Tensor) -> None:
        space = self.action_spec.space
        if action.shape != space.low.shape:
            raise ValueError(
                f"An action must have shape {list(space.low.shape)}, one row for each environment; "
                f"got {list(action.shape)}."
            )
        excess = torch.maximum(space.low - action, action - space.high).amax()
        if not excess <= _ACTION_TOLERANCE:  # also catches NaN
            raise ValueError(
                f"An action lies outside the action spec or is not finite: received values from "
                f"{action.amin().item():.4g} to {action.amax().item():.4g}, allowed are "
                f"{space.low[0].tolist()} to {space.high[0].tolist()}. "
                "Pass it through env.action_spec.project(action) first."
            )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self._started:
            raise RuntimeError("The environment was stepped before its first reset. Call env.reset() first.")
        action = tensordict.get("action")
        self._check_action(action)
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
