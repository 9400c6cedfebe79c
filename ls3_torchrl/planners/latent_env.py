"""The learned model as a TorchRL environment over latents."""

from __future__ import annotations

from itertools import chain

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import ModelBasedEnvBase

from ls3_torchrl._checks import action_bounds, require_at_least, require_module
from ls3_torchrl.modules.classifiers import probability_of


class LatentEnv(ModelBasedEnvBase):
    """Imagination as an environment: f_dyn moves the latent, f_C and f_G say where it arrives.

    Every row is one particle. The reward is the task's own, −1 outside the goal set and 0 in it, with
    "in the goal set" meaning that f_G's probability exceeds one half. It never ends an episode.

    ``reset`` starts from the latents of the tensordict that it is given, and draws them from the VAE's prior N(0, 1)
    where there are none: for a tensordict without entries, as many as its batch size says; for ``reset()``, one.

    Latents and actions are found under the dynamics' own keys. Any module will do as dynamics that reads a latent and
    an action and writes the next latent; as classifiers, any modules of a latent whose first output is a logit.

    Args:
        dynamics: f_dyn; ``in_keys`` are the latent ``[*B, D]`` and the action ``[*B, A]``, the first of its
            ``out_keys`` is the next latent ``[*B, D]``.
        constraint: f_C, logit ``[*B, 1]``.
        goal: f_G, logit ``[*B, 1]``.
        action_spec: bounds of one action, shape ``[A]``, of any floating dtype.
        latent_dim: D; the dynamics' ``latent_dim`` when ``None``, which a module from elsewhere may not have.
        constraint_prob_key: where f_C's probability ``[*B, 1]`` is written.
        goal_prob_key: where f_G's probability ``[*B, 1]`` is written.
        reward_key: where the reward ``[*B, 1]`` is written.
        device: where to imagine; the modules are moved there. Where the dynamics are when ``None``.

    Raises:
        ValueError: when the action spec is unbounded, not floating or not of the dynamics' size; when nobody says what
            D is; by ``reset``, for a tensordict with entries but without a latent to start from.

    Example:
        >>> from tensordict import TensorDict
        >>> from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator
        >>> spec = Bounded(low=-1.0, high=1.0, shape=(2,))
        >>> env = LatentEnv(EnsembleDynamics(8, 2), ConstraintEstimator(8), GoalEstimator(8), action_spec=spec)
        >>> start = env.reset(TensorDict({"latent": torch.zeros(6, 8)}, [6]))
        >>> env.rollout(5, auto_reset=False, tensordict=start)["next", "constraint_prob"].shape
        torch.Size([6, 5, 1])
        >>> env.rollout(5)["latent"].shape  # from one draw of the prior
        torch.Size([5, 8])
    """

    def __init__(
        self,
        dynamics: TensorDictModuleBase,
        constraint: TensorDictModuleBase,
        goal: TensorDictModuleBase,
        *,
        action_spec: TensorSpec,
        latent_dim: int | None = None,
        constraint_prob_key: NestedKey = "constraint_prob",
        goal_prob_key: NestedKey = "goal_prob",
        reward_key: NestedKey = "reward",
        device: torch.device | str | None = None,
    ) -> None:
        for name, module in (("dynamics", dynamics), ("constraint", constraint), ("goal", goal)):
            require_module(module, name)
        latent_dim = getattr(dynamics, "latent_dim", None) if latent_dim is None else latent_dim
        if latent_dim is None:
            raise ValueError(f"{type(dynamics).__name__} does not say how large its latents are: give latent_dim.")
        require_at_least(latent_dim, 1, "latent_dim")
        _check_action_spec(action_spec, getattr(dynamics, "action_dim", None))
        if device is None:
            device = next(chain(dynamics.parameters(), dynamics.buffers(), [action_spec.space.low])).device
        super().__init__(dynamics, device=torch.device(device), batch_size=None)
        self.dynamics, self.constraint, self.goal = (m.to(self.device) for m in (dynamics, constraint, goal))
        self.latent_dim = latent_dim
        self.latent_key = unravel_key(dynamics.in_keys[0])
        self.constraint_prob_key, self.goal_prob_key = unravel_key(constraint_prob_key), unravel_key(goal_prob_key)
        self._set_specs(action_spec, unravel_key(reward_key))

    def __setattr__(self, name: str, value: object) -> None:
        super().__setattr__(name, value)
        if name == "dynamics":  # by the name that TorchRL calls them, too
            super().__setattr__("world_model", value)

    def _set_specs(self, action_spec: TensorSpec, reward_key: NestedKey) -> None:
        options = {"device": self.device, "dtype": self.latent_dtype}
        latent = Unbounded(shape=(self.latent_dim,), **options)
        probability = Bounded(low=0.0, high=1.0, shape=(1,), **options)
        observed = {
            self.latent_key: latent,
            self.constraint_prob_key: probability,
            self.goal_prob_key: probability.clone(),
        }
        self.observation_spec = self._nested(observed)
        self.state_spec = self._nested({self.latent_key: latent.clone()})
        self.action_spec = self._nested({unravel_key(self.dynamics.in_keys[1]): action_spec.to(self.device)})
        self.reward_spec = self._nested({reward_key: Bounded(low=-1.0, high=0.0, shape=(1,), **options)})

    def _nested(self, specs: dict[NestedKey, TensorSpec]) -> Composite:
        composite = Composite(device=self.device)
        for key, spec in specs.items():
            composite[key] = spec
        return composite

    @property
    def latent_dtype(self) -> torch.dtype:
        """What the dynamics compute in; float32 for dynamics without parameters."""
        parameters = (p.dtype for p in self.dynamics.parameters() if p.is_floating_point())
        return next(parameters, torch.float32)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        if tensordict is None:
            tensordict = TensorDict({}, self.batch_size, device=self.device)
        latent = tensordict.get(self.latent_key, None)
        if latent is None:
            self._require_nothing_else(tensordict)
        if (
            latent is None or tensordict.get("_reset", None) is not None
        ):  # rows that need not begin anew stay as they are
            shape = (*tensordict.batch_size, self.latent_dim)
            latent = torch.randn(shape, device=self.device, dtype=self.latent_dtype)
        return self._observe(latent.to(self.latent_dtype), tensordict.batch_size)

    def _require_nothing_else(self, tensordict: TensorDictBase) -> None:
        known = {unravel_key(key) for key in (*self.reset_keys, *self.done_keys)}
        others = [key for key in tensordict.keys(True, True) if unravel_key(key) not in known]
        if others:
            raise ValueError(
                f"LatentEnv.reset found {', '.join(map(str, others))}, but no latent to start from under "
                f"{self.latent_key!r}, the dynamics' own key. Put it there, or pass nothing to start from a draw of "
                "N(0, 1)."
            )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """One imagined step of every row."""
        given = tensordict.clone(recurse=False)
        latent, action = given.get(self.latent_key), given.get(self.action_key)
        given.set(self.action_key, action.to(latent.dtype))
        moved = self.world_model(given)
        out = self._observe(moved.get(self.dynamics.out_keys[0]), tensordict.batch_size)
        goal_prob = out.get(self.goal_prob_key)
        out.set(self.reward_key, (goal_prob > 0.5).to(goal_prob) - 1.0)
        return out

    def _observe(self, latent: Tensor, batch_size: torch.Size) -> TensorDict:
        """The latent and what the classifiers say of it."""
        out = TensorDict({}, batch_size, device=self.device)
        out.set(self.latent_key, latent)
        out.set(self.constraint_prob_key, probability_of(self.constraint, latent))
        return out.set(self.goal_prob_key, probability_of(self.goal, latent))

    def _set_seed(self, seed: int | None) -> None:
        """Imagination draws from torch's global generator."""


def _check_action_spec(spec: TensorSpec, action_dim: int | None) -> None:
    action_bounds(spec)
    if len(spec.shape) != 1 or action_dim not in (None, spec.shape[-1]):
        expected = "A" if action_dim is None else action_dim
        raise ValueError(
            f"The action spec must have shape [{expected}] as the dynamics' actions, got "
            f"{list(spec.shape)}. Take one row of a batched environment's spec: env.action_spec[0]."
        )
