"""Value ensemble V(z) (equations (3) and (4))."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ls3_torchrl._checks import require_keys, require_size
from ls3_torchrl.modules.ensemble import EnsembleMLP


class ValueEnsemble(TensorDictModuleBase):
    """M value functions of the latent, each with 3 hidden layers of 256 (section 1.1.1).

    Args:
        latent_dim: D.
        num_members: M.
        hidden: sizes of the hidden layers.
        latent_key: latent ``[*B, D]``, or ``[*B, M, D]`` with ``per_member=True`` in the call.
        value_key: where the members' values ``[*B, M, 1]`` are written, in units of reward.

    Raises:
        KeyError: when the latent is missing.
        ValueError: for a latent of another size.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> value = ValueEnsemble(latent_dim=8)
        >>> value(TensorDict({"latent": torch.zeros(4, 8)}, [4]))["state_value"].shape
        torch.Size([4, 5, 1])
    """

    def __init__(
        self,
        latent_dim: int,
        *,
        num_members: int = 5,
        hidden: Sequence[int] = (256, 256, 256),
        latent_key: NestedKey = "latent",
        value_key: NestedKey = "state_value",
    ) -> None:
        super().__init__()
        self.latent_dim, self.num_members = latent_dim, num_members
        self.in_keys = [latent_key]
        self.out_keys = [value_key]
        self.network = EnsembleMLP(latent_dim, 1, num_members=num_members, hidden=hidden)

    def forward(self, tensordict: TensorDictBase, *, per_member: bool = False) -> TensorDictBase:
        """Write every member's value of the latent."""
        require_keys(tensordict, self.in_keys, "ValueEnsemble")
        latent = tensordict.get(self.in_keys[0])
        return tensordict.set(self.out_keys[0], self.of_latent(latent, per_member=per_member))

    def of_latent(self, latent: Tensor, *, per_member: bool = False) -> Tensor:
        """Every member's value ``[*B, M, 1]`` of latents ``[*B, D]``, or ``[*B, M, D]`` with ``per_member``."""
        require_size(latent, self.latent_dim, self.in_keys[0], "ValueEnsemble")
        return self.network(latent, per_member=per_member)
