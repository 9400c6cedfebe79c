"""Recovery RL: a critic of risk, and a policy that takes over where the task's own is too risky (section 1.1.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import binary_cross_entropy_with_logits
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule

from ls3_torchrl._checks import require_keys
from ls3_torchrl.baselines.networks import ObservedAction
from ls3_torchrl.modules.ensemble import EnsembleMLP
from ls3_torchrl.objectives._common import as_scalars
from ls3_torchrl.objectives.value import check_discount


class SafetyCritic(TensorDictModuleBase):
    """Q_risk(s, a), the discounted probability that a constraint will be violated: the most worried of M networks.

    Args:
        action_spec: of one action ``[A]``, or batched; the networks see it in units of half its range.
        in_features: size of what is observed, or of ``features``.
        observation_key: what is read: latents, or images with ``features``.
        features: reads what is observed first; the members share it.
        num_members: M.
        hidden: sizes of the hidden layers.

    Returns:
        ``risk_logit`` ``[*B, M]``, ``risk`` ``[*B, 1]`` in (0, 1), and ``safety`` = −risk, which a policy can ascend:
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

    out_keys = ["risk_logit", "risk", "safety"]  # noqa: RUF012

    def __init__(
        self,
        action_spec: Bounded,
        in_features: int,
        *,
        observation_key: NestedKey = "loc",
        features: nn.Module | None = None,
        num_members: int = 2,
        hidden: Sequence[int] = (256, 256),
    ) -> None:
        super().__init__()
        self.in_keys = [observation_key, "action"]
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
        tensordict.set("risk_logit", logits)
        tensordict.set("risk", risk)
        return tensordict.set("safety", -risk)


class SafetyCriticLoss(LossModule):
    """Cross-entropy of Q_risk(s, a) to c + (1 − c) γ_risk Q'_risk(s', a'), a' ~ π.

    c is whether the step's next state violates, and π the policy whose risk is judged. Q' is a lagged copy of the
    critic; couple the loss with ``SoftUpdate(loss, tau=0.005)``. The cross-entropy has the squared error's minimum, and
    gradients that do not vanish where the critic is surely wrong.

    Args:
        safety_critic: Q_risk.
        policy: π; writes ``action`` for the next observations. It is not trained.
        gamma: γ_risk in [0, 1).

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
        """Keys that ``set_keys`` can change.

        Attributes:
            action (NestedKey): a, the action that was carried out.
            constraint (NestedKey): c, bool ``[*B, 1]``.
        """

        action: NestedKey = "action"
        constraint: NestedKey = ("next", "constraint")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    safety_critic: SafetyCritic
    safety_critic_params: TensorDictParams
    target_safety_critic_params: TensorDictParams

    def __init__(self, safety_critic: SafetyCritic, policy: TensorDictModuleBase, *, gamma: float = 0.95) -> None:
        super().__init__()
        self.convert_to_functional(safety_critic, "safety_critic", create_target_params=True)
        # Out of reach of parameters(): whoever trains this loss leaves the policy alone.
        self.__dict__["policy"] = policy
        self.out_keys = ["loss_safety", "risk"]
        self.gamma = check_discount(gamma, "gamma (of the safety critic)")

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys that are read, as ``set_keys`` left them."""
        observation = self.safety_critic.in_keys[0]
        after = ("next", observation) if isinstance(observation, str) else ("next", *observation)
        return [observation, after, self.tensor_keys.action, self.tensor_keys.constraint]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        pass

    def _risk(self, params: TensorDictParams, observation: Tensor, action: Tensor) -> TensorDictBase:
        weights = {key if isinstance(key, str) else ".".join(key): value for key, value in params.items(True, True)}
        names = self.safety_critic.in_keys
        rows = TensorDict({names[0]: observation, "action": action}, batch_size=action.shape[:-1])
        return functional_call(self.safety_critic, weights, (rows,))

    def target(self, tensordict: TensorDictBase) -> Tensor:
        """C + (1 − c) γ_risk Q'_risk(s', a'), ``[*B, 1]``."""
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            after = tensordict.get(self.in_keys[1])
            rows = TensorDict({self.in_keys[0]: after}, batch_size=tensordict.batch_size)
            action = self.__dict__["policy"](rows)["action"]
            risk = self._risk(self.target_safety_critic_params, after, action)["risk"]
        violated = tensordict.get(self.tensor_keys.constraint).to(risk)
        return violated + (1.0 - violated) * self.gamma * risk

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss on transitions ``[*B]``."""
        keys = self.in_keys
        require_keys(tensordict, keys, "SafetyCriticLoss")
        target = self.target(tensordict)
        judged = self._risk(self.safety_critic_params, tensordict.get(keys[0]), tensordict.get(keys[2]))
        logits = judged["risk_logit"]
        loss = binary_cross_entropy_with_logits(logits, target.expand_as(logits))
        return as_scalars(loss_safety=loss, risk=judged["risk"].detach().mean())


class RecoveryPolicy(TensorDictModuleBase):
    """Acts as a task policy where that is safe enough, and as a recovery policy elsewhere.

    a = π_task(s) where Q_risk(s, π_task(s)) ≤ ε_risk, else π_recovery(s). Any TorchRL policy can be wrapped: it keeps
    the keys that it reads and writes.

    Args:
        task: π_task; writes ``action``.
        recovery: π_recovery; writes ``action``.
        safety_critic: Q_risk.
        threshold: ε_risk in [0, 1].

    Returns:
        What ``task`` writes, with ``action`` as carried out, and ``task_action`` ``[*B, A]`` as the task policy wanted
        it (which a learner of the task should take for the one that led on), ``risk`` ``[*B, 1]`` of the latter and
        ``recovered``, bool ``[*B, 1]``.

    Raises:
        ValueError: for a threshold outside [0, 1].

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
        safety_critic: SafetyCritic,
        threshold: float,
    ) -> None:
        super().__init__()
        if not 0.0 <= threshold <= 1.0:
            raise ValueError(f"threshold must lie in [0, 1], got {threshold}.")
        self.task, self.recovery, self.safety_critic, self.threshold = task, recovery, safety_critic, threshold
        read = [*task.in_keys, *recovery.in_keys, safety_critic.in_keys[0]]
        self.in_keys = [key for key in dict.fromkeys(read) if key not in task.out_keys]
        self.out_keys = [*task.out_keys, "task_action", "risk", "recovered"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of whichever policy acts."""
        tensordict = self.task(tensordict)
        wanted = tensordict.get("action")
        seen = tensordict.select(*self.recovery.in_keys, self.safety_critic.in_keys[0], strict=False)
        risk = self.safety_critic(seen.copy().set("action", wanted))["risk"]
        instead = self.recovery(seen.copy())["action"]
        recovered = risk > self.threshold
        tensordict.set("task_action", wanted)
        tensordict.set("risk", risk)
        tensordict.set("recovered", recovered)
        return tensordict.set("action", torch.where(recovered, instead, wanted))
