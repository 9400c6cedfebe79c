"""The learned model as a TorchRL environment over latents."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import ModelBasedEnvBase

from ls3_torchrl._checks import require_keys
from ls3_torchrl.modules.classifiers import LatentClassifier
from ls3_torchrl.modules.dynamics import EnsembleDynamics


class LatentEnv(ModelBasedEnvBase):
    """Imagination as an environment: f_dyn moves the latent, f_C and f_G judge where it arrives.

    Every row is one particle. The reward is the task's own, −1 outside the goal set and 0 in it, with
    "in the goal set" meaning that f_G's probability exceeds one half. It never ends an episode.

    Args:
        dynamics: f_dyn.
        constraint: f_C.
        goal: f_G.
        action_spec: bounds of one action, shape ``[A]``.
        device: where to imagine; the modules are moved there.

    Raises:
        ValueError: when the action spec is unbounded or its size is not the dynamics'.
        KeyError: by ``reset``, without a latent to start from.

    Example:
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator
        >>> spec = Bounded(low=-1.0, high=1.0, shape=(2,))
        >>> env = LatentEnv(EnsembleDynamics(8, 2), ConstraintEstimator(8), GoalEstimator(8), action_spec=spec)
        >>> start = env.reset(TensorDict({"latent": torch.zeros(6, 8)}, [6]))
        >>> env.rollout(5, auto_reset=False, tensordict=start)["next", "constraint_prob"].shape
        torch.Size([6, 5, 1])
    """

    def __init__(
        self,
        dynamics: EnsembleDynamics,
        constraint: LatentClassifier,
        goal: LatentClassifier,
        *,
        action_spec: TensorSpec,
        device: torch.device | str = "cpu",
    ) -> None:
        if not isinstance(action_spec, Bounded):
            raise ValueError(f"Planning needs a bounded action spec, got {type(action_spec).__name__}.")
        if tuple(action_spec.shape) != (dynamics.action_dim,):
            raise ValueError(
                f"The action spec must have shape [{dynamics.action_dim}] as the dynamics' actions, got "
                f"{list(action_spec.shape)}. Take one row of a batched environment's spec: env.action_spec[0]."
            )
        dynamics_step = [dynamics, TensorDictModule(_identity, [dynamics.out_keys[0]], ["latent"])]
        judges = [
            TensorDictModule(constraint.probability, ["latent"], ["constraint_prob"]),
            TensorDictModule(goal.probability, ["latent"], ["goal_prob"]),
        ]
        reward = TensorDictModule(_reward_of_goal, ["goal_prob"], ["reward"])
        super().__init__(
            TensorDictSequential(*dynamics_step, *judges, reward),
            device=torch.device(device),
            batch_size=None,
        )
        # TensorDictModule does not register bound methods' owners: hold the networks here.
        self.dynamics, self.constraint, self.goal = (m.to(self.device) for m in (dynamics, constraint, goal))
        self._judges = TensorDictSequential(*judges)
        latent = Unbounded(shape=(dynamics.latent_dim,), device=self.device)
        probability = Bounded(low=0.0, high=1.0, shape=(1,), device=self.device)
        self.observation_spec = Composite(
            latent=latent, constraint_prob=probability, goal_prob=probability.clone(), device=self.device
        )
        if dynamics.propagation == "tsinf":
            member = Unbounded(shape=(1,), dtype=torch.int64, device=self.device)
            self.observation_spec[dynamics.member_key] = member
        self.state_spec = Composite(latent=latent.clone(), device=self.device)
        self.action_spec = action_spec.to(self.device)
        self.reward_spec = Bounded(low=-1.0, high=0.0, shape=(1,), device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        if tensordict is None:
            raise KeyError("LatentEnv.reset needs a tensordict with the latent to start from: reset(td).")
        require_keys(tensordict, ["latent"], "LatentEnv.reset")
        out = self._judges(tensordict.select("latent"))
        if self.dynamics.propagation == "tsinf":
            key = self.dynamics.member_key
            members = tensordict.get(key, None)
            if members is None:
                rows = out.batch_size.numel()
                members = self.dynamics.sample_members(rows, device=self.device).reshape(*out.batch_size, 1)
            out.set(key, members)
        return out

    def _set_seed(self, seed: int | None) -> None:
        """Imagination draws from torch's global generator."""


def _identity(value: torch.Tensor) -> torch.Tensor:
    return value


def _reward_of_goal(goal_prob: torch.Tensor) -> torch.Tensor:
    return (goal_prob > 0.5).to(goal_prob) - 1.0
