"""What the losses have in common: which keys they read, calls by keyword, and targets for several members."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from ls3_torchrl._checks import require_keys
from ls3_torchrl.modules.call import Weights


class LatentLoss(LossModule):
    """Base class of a loss: a subclass declares its keys in ``_AcceptedKeys`` and computes ``losses``.

    ``in_keys`` are the accepted keys, as ``set_keys`` left them. A loss is called with a tensordict, or with tensors as
    keyword arguments, named by their keys, with an underscore between the parts of a nested key. It then returns the
    values of ``out_keys``, which ``select_out_keys`` can shorten, as a tuple; a single one as a tensor.

    Raises:
        KeyError: when a key is missing.

    Example:
        >>> class DistanceLoss(LatentLoss):
        ...     @dataclass
        ...     class _AcceptedKeys:
        ...         latent: NestedKey = "latent"
        ...         next_latent: NestedKey = ("next", "latent")
        ...
        ...     def __init__(self) -> None:
        ...         super().__init__()
        ...         self.out_keys = ["loss_distance"]
        ...
        ...     def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        ...         z, z_next = (tensordict.get(key) for key in self.in_keys)
        ...         return {"loss_distance": (z_next - z).square().mean()}
        >>> loss = DistanceLoss()
        >>> loss(latent=torch.zeros(4, 8), next_latent=torch.ones(4, 8))
        tensor(1.)
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change."""

    tensor_keys: Any
    default_keys: Callable[..., Any] = _AcceptedKeys
    #: Accepted keys that a batch may lack.
    _optional: frozenset[str] = frozenset()
    #: Accepted keys that a module writes, which no batch needs to hold.
    _written: frozenset[str] = frozenset()

    def _weights(self, name: str) -> Weights:
        """The weights ``{name}_params`` of a network that was made functional, found once."""
        found: dict[str, Weights] = self.__dict__.setdefault("_found_weights", {})
        if name not in found:
            network = getattr(self, name.removeprefix("target_"))
            found[name] = Weights(network, getattr(self, f"{name}_params"))
        return found[name]

    def _apply(self, *args: Any, **kwargs: Any) -> Self:
        self.__dict__.pop("_found_weights", None)  # moved or cast, they may be other tensors
        return super()._apply(*args, **kwargs)

    def load_state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """As for any module."""
        self.__dict__.pop("_found_weights", None)
        return super().load_state_dict(*args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_found_weights"}

    #: Whether ``forward`` is that of this class.
    _has_plain_forward = True

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.default_keys = cls._AcceptedKeys
        mixins = [base for base in cls.__mro__[1 : cls.__mro__.index(LatentLoss)] if not issubclass(base, LatentLoss)]
        own = any("forward" in vars(base) for base in (cls, *mixins))  # before TorchRL has wrapped that of the class
        cls._has_plain_forward = cls._has_plain_forward and not own

    def _start_from_keys(self, **defaults: NestedKey) -> None:
        """Take other default keys than the class has, such as those of the modules that the loss is made for."""
        self.default_keys = partial(self._AcceptedKeys, **defaults)
        self.set_keys(**defaults)

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys that a batch must have, as ``set_keys`` left them."""
        return self._keys_except(self._optional | self._written)

    @property
    def _keyword_keys(self) -> list[NestedKey]:
        """Those, and the keys that a batch may have."""
        return [*self.in_keys, *(key for key in self._keys_except(self._written) if key not in self.in_keys)]

    def _keys_except(self, names: frozenset[str]) -> list[NestedKey]:
        return [key for name, key in vars(self.tensor_keys).items() if name not in names and key is not None]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """There is no value estimator."""

    @dispatch(source="_keyword_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The scalars of ``out_keys``, as a tensordict without batch dimension."""
        require_keys(tensordict, self.in_keys, type(self).__name__)
        return TensorDict(self.losses(tensordict), batch_size=torch.Size([]))

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """What the loss returns, by name."""
        raise NotImplementedError

    @property
    def is_plain(self) -> bool:
        """Whether a call does nothing but compute ``losses``: no hooks, no other ``forward``."""
        checks = [hook for hook in self._forward_pre_hooks.values() if not hook.__module__.startswith("torchrl.")]
        hooks = checks, self._forward_hooks, self._backward_pre_hooks, self._backward_hooks
        return self._has_plain_forward and not (any(hooks) or "forward" in vars(self))


def with_members(target: Tensor, predicted: Tensor, who: str, *, trailing: int = 1) -> Tensor:
    """A target beside what a module predicts for it: with a dimension for the members where the module has several.

    Args:
        target: ``[*B, …]``, or what already has the shape of ``predicted``.
        predicted: ``[*B, M, …]`` of M members, or ``[*B, …]`` of a single network.
        who: the loss, named in the error.
        trailing: how many dimensions there are after the members.

    Returns:
        ``[*B, M or 1, …]`` or ``[*B, …]``.

    Raises:
        ValueError: for another shape.
    """
    expected, given = list(predicted.shape), list(target.shape)
    if predicted.ndim == target.ndim + 1:
        target = target.unsqueeze(-1 - trailing)
        expected[-1 - trailing] = 1
    if list(target.shape) != expected:
        raise ValueError(
            f"{who} compares targets of shape {given} with predictions of shape {list(predicted.shape)}. "
            "A module must predict [*B, ...] as its targets are, or [*B, M, ...] for M members."
        )
    return target


def require_shape_of(target: Tensor, predicted: Tensor, key: NestedKey, who: str) -> None:
    """Raise ``ValueError`` for a target that would be broadcast: each row would learn from those of others."""
    if target.shape != predicted.shape:
        raise ValueError(
            f"{who} compares {key!r} of shape {list(target.shape)} with predictions of shape {list(predicted.shape)}. "
            "Give one target for each prediction: [B, 1], not [B]."
        )


def check_members(latent: Tensor, module: TensorDictModuleBase, who: str) -> None:
    """Raise ``ValueError`` unless ``latent`` is a bootstrap batch ``[B, M, D]`` for the M members of ``module``."""
    members = module.num_members
    if latent.ndim < 3 or latent.shape[-2] != members:
        raise ValueError(
            f"{who}(bootstrap=True) needs one batch per member: latents of shape [B, {members}, D], got "
            f"{list(latent.shape)}. Sample with members={members}, or pass bootstrap=False."
        )


def require_ensemble(module: TensorDictModuleBase, who: str) -> None:
    """Raise ``TypeError`` unless ``module`` says how many members it has."""
    if not hasattr(module, "num_members"):
        raise TypeError(
            f"{who}(bootstrap=True) needs an ensemble, a module with an attribute num_members and an argument "
            f"per_member; {type(module).__name__} is none. Pass bootstrap=False, or an ensemble."
        )
