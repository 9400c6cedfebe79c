"""AWAC: an actor that imitates what its critic finds better than itself (Nair et al., 2020; section 1.1.4)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.data import Bounded
from torchrl.objectives import SACLoss

from ls3_torchrl._checks import action_bounds


class AWACLoss(SACLoss):
    """SAC's critics without entropy, and an actor that imitates the data's actions, each by its advantage.

    The actor minimises −E[w(s, a) log π(a | s)] with w ∝ exp(A(s, a) / λ), A(s, a) = min_i Q_i(s, a) − V(s) and V(s) =
    min_i Q_i(s, a'), a' ~ π. The weights are normalised over the batch to mean 1, which keeps them finite whatever
    the scale of the rewards (equation (8) of Nair et al. leaves the normaliser out).

    Args:
        actor_network: π, with a ``spec`` that bounds its action, whatever the action's key.
        qvalue_network: Q.
        temperature: λ > 0: small ones imitate the best actions alone, large ones all.
        margin: fraction of the actions' box at its edges in which an action counts as one just inside. A squashed
            Gaussian has no density on the edge, where clipped demonstrations lie.
        num_qvalue_nets: how many Q.
        loss_function: of the critics.

    Returns:
        ``loss_actor``, ``loss_qvalue`` and, as SACLoss does, ``loss_alpha`` (constant), ``alpha`` (zero) and
        ``entropy``.

    Raises:
        ValueError: for a temperature that is not positive, a margin outside (0, 0.5), or an actor whose action has no
            bounds.

    Source: Nair et al., "AWAC: Accelerating Online Reinforcement Learning with Offline Datasets", section 4.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.objectives import SoftUpdate
        >>> from ls3_torchrl.baselines import action_value, gaussian_actor
        >>> spec = Bounded(low=-3.0, high=3.0, shape=(2,))
        >>> loss = AWACLoss(gaussian_actor(spec, 8), action_value(spec, 8))
        >>> loss.make_value_estimator(gamma=0.99)
        >>> updater = SoftUpdate(loss, tau=0.005)
        >>> over = {k: torch.zeros(4, 1, dtype=torch.bool) for k in ("done", "terminated")}
        >>> reached = {"loc": torch.zeros(4, 8), "reward": -torch.ones(4, 1), **over}
        >>> batch = TensorDict({"loc": torch.zeros(4, 8), "action": torch.zeros(4, 2), "next": reached}, [4])
        >>> losses = loss(batch)
        >>> (losses["loss_actor"] + losses["loss_qvalue"]).backward()
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        *,
        temperature: float = 1.0,
        margin: float = 0.01,
        num_qvalue_nets: int = 2,
        loss_function: str = "l2",
    ) -> None:
        if not temperature > 0.0:
            raise ValueError(f"temperature must be positive, got {temperature}.")
        if not 0.0 < margin < 0.5:
            raise ValueError(f"margin must lie in (0, 0.5), got {margin}.")
        # An entropy weight of nothing: SACLoss holds its logarithm.
        super().__init__(
            actor_network,
            qvalue_network,
            num_qvalue_nets=num_qvalue_nets,
            loss_function=loss_function,
            alpha_init=1e-30,
            fixed_alpha=True,
        )
        self.temperature, self.margin = temperature, margin
        boxes = [spec for spec in actor_network.spec.values(True, True) if isinstance(spec, Bounded)]
        if len(boxes) != 1:
            raise ValueError(
                f"AWACLoss needs an actor whose spec bounds one output, the action; {len(boxes)} of "
                f"{actor_network.out_keys} are bounded. Build the actor with the action's Bounded spec."
            )
        low, high = action_bounds(boxes[0])
        self.register_buffer("lowest", low + margin * (high - low))
        self.register_buffer("highest", high - margin * (high - low))

    def advantage(self, tensordict: TensorDictBase) -> Tensor:
        """A(s, a) = min_i Q_i(s, a) − min_i Q_i(s, a'), a' ~ π, of rows ``[*B]``."""
        with torch.no_grad():
            with self.actor_network_params.to_module(self.actor_network):
                own = self.actor_network.get_dist(tensordict).rsample()
            seen = tensordict.select(*self.qvalue_network.in_keys)
            sampled = seen.copy().set(self.tensor_keys.action, own)
            best = [self._least_value(rows) for rows in (seen, sampled)]
        return best[0] - best[1]

    def _least_value(self, rows: TensorDictBase) -> Tensor:
        values = self._vmap_qnetworkN0(rows, self.qvalue_network_params)
        return values.get(self.tensor_keys.state_action_value).min(0).values.squeeze(-1)

    def weights(self, advantage: Tensor) -> Tensor:
        """W ∝ exp(A / λ) with mean 1 over all rows."""
        return torch.softmax(advantage.flatten() / self.temperature, 0).reshape(advantage.shape) * advantage.numel()

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """−E[w log π(a | s)] on rows ``[*B]``."""
        weights = self.weights(self.advantage(tensordict))
        action = tensordict.get(self.tensor_keys.action).clamp(self.lowest, self.highest)
        with self.actor_network_params.to_module(self.actor_network):
            log_prob = self.actor_network.get_dist(tensordict).log_prob(action)
        return -(weights * log_prob).mean(), {"log_prob": log_prob.detach()}
