"""Recovery RL: a critic of risk, and a policy that takes over where the task's own is too risky (section 1.1.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type

from ls3_torchrl._checks import require_keys, require_labels, require_unit_interval
from ls3_torchrl.baselines.networks import ObservedAction
from ls3_torchrl.modules.call import call_with_params
from ls3_torchrl.modules.ensemble import EnsembleMLP
from ls3_torchrl.objectives.base import LatentLoss, require_shape_of


class SafetyCritic(TensorDictModuleBase):
    """Q_risk(s, a), the discounted probability that a constraint will be violated: the highest of M networks.

    Args:
        action_spec: of one action ``[A]``, or batched; the networks see it in units of half its range.
        in_features: size of the observation, or of ``features``.
        features: reads the observation first; the members share it.
        num_members: M.
        hidden: sizes of the hidden layers.
        observation_key: what is read: latents, or images with ``features``.
        action_key: action ``[*B, A]``.
        logit_key: where the members' logits ``[*B, M]`` are written.
        risk_key: where the risk ``[*B, 1]`` in (0, 1) is written.
        safety_key: where −risk is written, which a policy can maximise:
            ``DDPGLoss.set_keys(state_action_value="safety")`` trains one that recovers.

    Raises:
        KeyError: when observation or action is missing.

    Source: Thananjeyan et al., "Recovery RL", section IV.

    Example:
        >>> critic = SafetyCritic(Bounded(low=-3.0, high=3.0, shape=(2,)), 8)
        >>> td = critic(TensorDict({"loc": torch.zeros(4, 8), "action": torch.zeros(4, 2)}, [4]))
        >>> td["risk_logit"].shape, td["risk"].shape
        (torch.Size([4, 2]), torch.Size([4, 1]))
    """

    def __init__(
        self,
        action_spec: Bounded,
        in_features: int,
        *,
        features: nn.Module | None = None,
        num_members: int = 2,
        hidden: Sequence[int] = (256, 256),
        observation_key: NestedKey = "loc",
        action_key: NestedKey = "action",
        logit_key: NestedKey = "risk_logit",
        risk_key: NestedKey = "risk",
        safety_key: NestedKey = "safety",
    ) -> None:
        super().__init__()
        self.in_keys = [observation_key, action_key]
        self.out_keys = [logit_key, risk_key, safety_key]
        self.logit_key, self.risk_key, self.safety_key = logit_key, risk_key, safety_key
        self.seen = ObservedAction(action_spec, features)
        width = in_features + action_spec.shape[-1]
        self.network = EnsembleMLP(width, 1, num_members=num_members, hidden=hidden)

    def logits(self, observation: Tensor, action: Tensor) -> Tensor:
        """Every member's logit of the risk, ``[*B, M]``."""
        return self.network(self.seen(observation, action)).squeeze(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write logits, risk and safety."""
        require_keys(tensordict, self.in_keys, "SafetyCritic")
        logits = self.logits(*(tensordict.get(key) for key in self.in_keys))
        risk = logits.amax(-1, keepdim=True).sigmoid()
        return tensordict.set(self.logit_key, logits).set(self.risk_key, risk).set(self.safety_key, -risk)


class SafetyCriticLoss(LatentLoss):
    """Cross-entropy of Q_risk(s, a) to c + (1 − c) γ_risk Q'_risk(s', a'), a' ~ π.

    c is whether the step's next state violates, and π the policy whose risk is learnt. Q' is a lagged copy of the
    critic; couple the loss with ``SoftUpdate(loss, tau=0.005)``. The cross-entropy has the squared error's minimum, and
    gradients that do not vanish where the critic is surely wrong.

    Args:
        safety_critic: Q_risk, any module of an observation and last an action that writes logits ``[*B, M]`` (its first
            output, unless ``set_keys`` says otherwise) and the risk ``[*B, 1]``.
        policy: π, any module of an observation that writes an action for it. It is not trained.
        gamma: γ_risk in [0, 1].

    Returns:
        The scalar ``loss_safety`` and, detached, ``risk``, the mean risk of the rows.

    Raises:
        ValueError: for γ_risk outside [0, 1].
        KeyError: when a key is missing.

    Source: Thananjeyan et al., "Recovery RL", equation (1).

    Example:
        >>> from torchrl.objectives import SoftUpdate
        >>> from ls3_torchrl.baselines import gaussian_actor
        >>> spec = Bounded(low=-3.0, high=3.0, shape=(2,))
        >>> loss = SafetyCriticLoss(SafetyCritic(spec, 8), gaussian_actor(spec, 8), gamma=0.95)
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> reached = {"loc": torch.zeros(4, 8), "constraint": torch.ones(4, 1, dtype=torch.bool)}
        >>> batch = TensorDict({"loc": torch.zeros(4, 8), "action": torch.zeros(4, 2), "next": reached}, [4])
        >>> loss(batch)["loss_safety"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change; those of observation, action, logit and risk default to the critic's.

        Attributes:
            observation (NestedKey): s.
            next_observation (NestedKey): s'.
            action (NestedKey): a, the action that was carried out.
            constraint (NestedKey): c, bool ``[*B, 1]``.
            policy_action (NestedKey): where the policy writes a'.
            risk_logit (NestedKey): where the critic writes its logits.
            risk (NestedKey): where the critic writes the risk.
        """

        observation: NestedKey = "loc"
        next_observation: NestedKey = ("next", "loc")
        action: NestedKey = "action"
        constraint: NestedKey = ("next", "constraint")
        policy_action: NestedKey = "action"
        risk_logit: NestedKey = "risk_logit"
        risk: NestedKey = "risk"

    _written = frozenset({"policy_action", "risk_logit", "risk"})

    safety_critic: TensorDictModuleBase
    safety_critic_params: TensorDictParams
    target_safety_critic_params: TensorDictParams

    def __init__(
        self, safety_critic: TensorDictModuleBase, policy: TensorDictModuleBase, *, gamma: float = 0.95
    ) -> None:
        super().__init__()
        self.convert_to_functional(safety_critic, "safety_critic", create_target_params=True)
        # Out of reach of parameters(): whoever trains this loss leaves the policy alone.
        self.__dict__["policy"] = policy
        self.out_keys = ["loss_safety", "risk"]
        self.gamma = require_unit_interval(gamma, "gamma (of the safety critic)")
        observation, action = safety_critic.in_keys[0], safety_critic.in_keys[-1]
        self._start_from_keys(
            observation=observation,
            next_observation=unravel_key(("next", observation)),
            action=action,
            policy_action=action,
            risk_logit=getattr(safety_critic, "logit_key", safety_critic.out_keys[0]),
            risk=getattr(safety_critic, "risk_key", "risk"),
        )

    def _risk(self, params: TensorDictParams, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Logits and risk of actions."""
        keys, critic = (self.tensor_keys.risk_logit, self.tensor_keys.risk), self.safety_critic
        rows = TensorDict({critic.in_keys[0]: observation, critic.in_keys[-1]: action}, batch_size=action.shape[:-1])
        written = call_with_params(critic, params, rows)
        require_keys(written, keys, "SafetyCriticLoss, of its critic,")
        return written.get(keys[0]), written.get(keys[1])

    def target(self, tensordict: TensorDictBase) -> Tensor:
        """C + (1 − c) γ_risk Q'_risk(s', a'), ``[*B, 1]``."""
        keys, policy = self.tensor_keys, self.__dict__["policy"]
        constraint, after = tensordict.get(keys.constraint), tensordict.get(keys.next_observation)
        require_shape_of(constraint, tensordict.get(keys.action)[..., :1], keys.constraint, "SafetyCriticLoss")
        require_labels(constraint, keys.constraint)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            rows = TensorDict({policy.in_keys[0]: after}, batch_size=constraint.shape[:-1])
            rows = policy(rows)
            require_keys(rows, [keys.policy_action], "SafetyCriticLoss, of its policy,")
            risk = self._risk(self.target_safety_critic_params, after, rows.get(keys.policy_action))[1]
        violated = constraint.to(risk)
        return violated + (1.0 - violated) * self.gamma * risk

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The loss on transitions ``[*B]``."""
        keys = self.tensor_keys
        target = self.target(tensordict)
        observation, action = tensordict.get(keys.observation), tensordict.get(keys.action)
        logits, risk = self._risk(self.safety_critic_params, observation, action)
        loss = binary_cross_entropy_with_logits(logits, target.expand_as(logits))
        return {"loss_safety": loss, "risk": risk.detach().mean()}


class RecoveryPolicy(TensorDictModuleBase):
    """Acts as a task policy where that is safe enough, and as a recovery policy elsewhere.

    a = π_task(s) where Q_risk(s, π_task(s)) ≤ ε_risk, else π_recovery(s). Any modules can be wrapped: they keep the
    keys that they read and write.

    Args:
        task: π_task; writes ``action_key``.
        recovery: π_recovery; writes ``recovery_action_key``.
        safety_critic: Q_risk, any module of observations and last an action that writes ``risk_key``, ``[*B, 1]``.
        threshold: ε_risk in [0, 1].
        action_key: where the action ``[*B, A]`` that is carried out is written.
        recovery_action_key: where ``recovery`` writes its own; ``None`` is ``action_key``.
        risk_key: where the critic writes the risk of the task policy's action; ``None`` is the critic's own, or
            ``"risk"``.
        task_action_key: where the action is written as the task policy wanted it (which a learner of the task should
            take for the one that led on).
        recovered_key: where is written whether the recovery policy acted, bool ``[*B, 1]``.

    Returns:
        What ``task`` writes, and the keys above.

    Raises:
        ValueError: for a threshold outside [0, 1], a module that does not write its key, or a risk of another shape.

    Source: Thananjeyan et al., "Recovery RL", equation (3) and section IV-C.

    Example:
        >>> from ls3_torchrl.baselines import deterministic_actor, gaussian_actor
        >>> spec = Bounded(low=-3.0, high=3.0, shape=(2,))
        >>> safe = RecoveryPolicy(gaussian_actor(spec, 8), deterministic_actor(spec, 8), SafetyCritic(spec, 8), 0.8)
        >>> td = safe(TensorDict({"loc": torch.zeros(4, 8)}, [4]))
        >>> td["action"].shape, td["recovered"].shape
        (torch.Size([4, 2]), torch.Size([4, 1]))
    """

    def __init__(
        self,
        task: TensorDictModuleBase,
        recovery: TensorDictModuleBase,
        safety_critic: TensorDictModuleBase,
        threshold: float,
        *,
        action_key: NestedKey = "action",
        recovery_action_key: NestedKey | None = None,
        risk_key: NestedKey | None = None,
        task_action_key: NestedKey = "task_action",
        recovered_key: NestedKey = "recovered",
    ) -> None:
        super().__init__()
        self.threshold = require_unit_interval(threshold, "threshold")
        self.task, self.recovery, self.safety_critic = task, recovery, safety_critic
        self.action_key = _written_by(task, action_key, "task", "action_key")
        self.recovery_action_key = _written_by(
            recovery, recovery_action_key or action_key, "recovery", "recovery_action_key"
        )
        risk_key = risk_key or getattr(safety_critic, "risk_key", "risk")
        self.risk_key = _written_by(safety_critic, risk_key, "safety_critic", "risk_key")
        self.task_action_key, self.recovered_key = task_action_key, recovered_key
        read = [*recovery.in_keys, *safety_critic.in_keys[:-1]]
        self.in_keys = [key for key in dict.fromkeys([*task.in_keys, *read]) if key not in task.out_keys]
        self.out_keys = [*task.out_keys, task_action_key, self.risk_key, recovered_key]
        self._read = read

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of whichever policy acts."""
        tensordict = self.task(tensordict)
        wanted = tensordict.get(self.action_key)
        seen = tensordict.select(*self._read, strict=False)
        risk = self.safety_critic(seen.copy().set(self.safety_critic.in_keys[-1], wanted)).get(self.risk_key)
        if risk.shape != (*wanted.shape[:-1], 1):
            raise ValueError(
                f"The safety critic must write one risk for each action, of shape {[*wanted.shape[:-1], 1]} under "
                f"{self.risk_key!r}, got {list(risk.shape)}."
            )
        instead = self.recovery(seen.copy()).get(self.recovery_action_key)
        recovered = risk > self.threshold
        tensordict.set(self.task_action_key, wanted)
        tensordict.set(self.risk_key, risk)
        tensordict.set(self.recovered_key, recovered)
        return tensordict.set(self.action_key, torch.where(recovered, instead, wanted))


def _written_by(module: TensorDictModuleBase, key: NestedKey, role: str, argument: str) -> NestedKey:
    """Return ``key``; raise ``ValueError`` when ``module`` does not write it."""
    key = unravel_key(key)
    if key not in module.out_keys:
        raise ValueError(
            f"RecoveryPolicy expects {role} to write {key!r}, but {type(module).__name__} writes {module.out_keys}. "
            f"Pass the key as {argument}."
        )
    return key
