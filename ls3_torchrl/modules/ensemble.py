"""M networks of one shape in stacked weights: one batched matrix product a layer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from ls3_torchrl._checks import require_at_least
from ls3_torchrl.modules.relu import relu_


class EnsembleMLP(nn.Module):
    """M independent ReLU networks evaluated together.

    Under ``torch.autocast`` the last layer stays in fp32: bf16 holds three digits, too few for a value of -60 of
    which a unit decides.

    Layer i holds weights ``[M, in, out]`` and biases ``[M, 1, out]``, each member initialised as
    ``nn.Linear`` would be.

    Args:
        in_features: size of the input.
        out_features: size of the output.
        num_members: M, at least 1.
        hidden: sizes of the hidden layers.

    Raises:
        ValueError: for fewer than one member, or a per-member input whose member dimension is not M.

    Example:
        >>> import torch
        >>> net = EnsembleMLP(4, 2, num_members=5, hidden=(16,))
        >>> net(torch.zeros(7, 4)).shape  # every member sees the same rows
        torch.Size([7, 5, 2])
        >>> net(torch.zeros(7, 5, 4), per_member=True).shape  # member m sees column m
        torch.Size([7, 5, 2])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        num_members: int,
        hidden: Sequence[int] = (256, 256, 256),
    ) -> None:
        super().__init__()
        self.num_members = require_at_least(num_members, 1, "num_members")
        sizes = [in_features, *hidden, out_features]
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in pairwise(sizes):
            bound = 1.0 / math.sqrt(fan_in)
            self.weights.append(torch.empty(num_members, fan_in, fan_out).uniform_(-bound, bound))
            self.biases.append(torch.empty(num_members, 1, fan_out).uniform_(-bound, bound))

    def forward(self, inputs: Tensor, *, per_member: bool = False) -> Tensor:
        """Outputs ``[*B, M, out]`` of inputs ``[*B, in]``, or of ``[*B, M, in]`` with ``per_member``."""
        if per_member:
            if inputs.ndim < 2 or inputs.shape[-2] != self.num_members:
                raise ValueError(
                    f"A per-member input must have shape [*B, M, in] with M = {self.num_members}, "
                    f"got {list(inputs.shape)}."
                )
            batch = inputs.shape[:-2]
            hidden = inputs.reshape(-1, *inputs.shape[-2:]).transpose(0, 1)
        else:
            batch = inputs.shape[:-1]
            hidden = inputs.reshape(1, -1, inputs.shape[-1]).expand(self.num_members, -1, -1)
        output = run_stacked(hidden, list(zip(self.weights, self.biases, strict=True)))
        return output.transpose(0, 1).reshape(*batch, self.num_members, output.shape[-1])


def run_stacked(inputs: Tensor, layers: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """Outputs ``[M, R, out]`` of M ReLU networks for rows ``[M, R, in]``; under autocast the last layer stays in fp32.

    Args:
        inputs: what each network sees.
        layers: weights ``[M, in, out]`` and biases ``[M, 1, out]``.
    """
    *hidden_layers, (weight, bias) = layers
    hidden = inputs
    for hidden_weight, hidden_bias in hidden_layers:
        hidden = relu_(torch.baddbmm(hidden_bias, hidden, hidden_weight))
    if not torch.is_autocast_enabled(hidden.device.type):
        return torch.baddbmm(bias, hidden, weight)
    with torch.autocast(hidden.device.type, enabled=False):
        return torch.baddbmm(bias, hidden.to(weight.dtype), weight)
