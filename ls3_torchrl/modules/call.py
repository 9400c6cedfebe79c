"""How losses, planners and buffers call any network or encoder, whatever its keys are called."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from weakref import WeakKeyDictionary

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import InteractionType, TensorDictModuleBase, TensorDictParams, set_interaction_type
from torch import Tensor, nn
from torch.func import functional_call

#: By class, whether ``forward`` asks ``of_latent``.
_ASKS_OF_LATENT: WeakKeyDictionary[type, bool] = WeakKeyDictionary()


class Weights:
    """Weights and buffers for a module to compute with instead of its own, and the places where it looks for them.

    Args:
        network: the module.
        params: weights and buffers under the names that the module has for them.

    Example:
        >>> from tensordict.nn import TensorDictParams
        >>> network = nn.Linear(1, 1)
        >>> zeros = TensorDictParams(TensorDict.from_module(network).data.clone().zero_(), no_convert=True)
        >>> with Weights(network, zeros).in_place():
        ...     network(torch.ones(1, 1))
        tensor([[0.]])
    """

    def __init__(self, network: nn.Module, params: TensorDictParams) -> None:
        names = {key if isinstance(key, str) else ".".join(key): value for key, value in params.items(True, True)}
        self.by_name: dict[str, Tensor] = names
        self._places: list[tuple[dict[str, Any], str, Tensor]] = []
        for name, value in names.items():
            path, _, leaf = name.rpartition(".")
            owner = network.get_submodule(path)
            slots: dict[str, Any] = owner._parameters if leaf in owner._parameters else owner._buffers
            self._places.append((slots, leaf, value))

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Meanwhile the module computes with them: what ``functional_call`` does, in a fraction of its time."""
        own = [slots.get(leaf) for slots, leaf, _ in self._places]
        for slots, leaf, value in self._places:
            slots[leaf] = value
        try:
            yield
        finally:
            for (slots, leaf, _), before in zip(self._places, own, strict=True):
                slots[leaf] = before


def call_with_params(
    network: TensorDictModuleBase, params: TensorDictParams | Weights, tensordict: TensorDictBase, **options: bool
) -> TensorDictBase:
    """What a module writes with other weights than its own, such as the lagged ones of a target network.

    Args:
        network: the module.
        params: weights and buffers under the names that the module has for them.
        tensordict: what the module reads.
        options: passed on to the module.
    """
    # Not params.to_module(): it leaves the lagged copies behind as parameters that ask for gradients.
    weights = params if isinstance(params, Weights) else Weights(network, params)
    if torch.compiler.is_compiling():
        return functional_call(network, weights.by_name, (tensordict,), options)
    with weights.in_place():
        return network(tensordict, **options)


def call_on_latent(
    network: TensorDictModuleBase,
    latent: Tensor,
    *,
    params: TensorDictParams | Weights | None = None,
    **options: bool,
) -> Tensor:
    """The first output of a module of one latent, whatever its keys are called.

    A module whose ``forward`` writes what its method ``of_latent`` computes, and nothing more happens when it is
    called, is asked for that alone.

    Args:
        network: a module with one in-key; its first out-key is returned.
        latent: ``[*B, D]``.
        params: weights to use instead of the module's own.
        options: passed on to the module.
    """
    if not torch.compiler.is_compiling():
        if params is None and asks_of_latent_alone(network):
            return network.of_latent(latent, **options)
        if isinstance(params, Weights):
            with params.in_place():
                return call_on_latent(network, latent, **options)
    entry = TensorDict({network.in_keys[0]: latent}, batch_size=latent.shape[:-1])
    if params is None:
        return network(entry, **options).get(network.out_keys[0])
    return call_with_params(network, params, entry, **options).get(network.out_keys[0])


def asks_of_latent_alone(network: nn.Module) -> bool:
    """Whether calling a module writes what its ``of_latent`` computes, and nothing else happens."""
    kind = type(network)
    if kind not in _ASKS_OF_LATENT:
        # The class that defines forward defines of_latent as well; one that redefines it alone may do something else.
        asks = next(("of_latent" in vars(base) for base in kind.__mro__ if "forward" in vars(base)), False)
        _ASKS_OF_LATENT[kind] = asks and kind.__call__ is TensorDictModuleBase.__call__
    return _ASKS_OF_LATENT[kind] and not is_hooked(network)


def is_hooked(module: nn.Module) -> bool:
    """Whether calling a module does more than its class says: hooks, or a ``forward`` of its own."""
    hooks = module._forward_pre_hooks, module._forward_hooks, module._backward_pre_hooks, module._backward_hooks
    return any(hooks) or "forward" in vars(module)


def _last(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]


def posterior_keys(encoder: TensorDictModuleBase) -> tuple[NestedKey, NestedKey | None]:
    """Where an encoder writes the mean of a latent and its standard deviation.

    An encoder names them by ``loc_key`` and ``scale_key``, or writes keys that end in ``loc`` and ``scale``; one that
    writes ``latent``, or a single key of any name, is taken to be certain, without a standard deviation.

    Raises:
        ValueError: for an encoder that writes several keys, none of which is ``loc`` or ``latent``.
    """
    loc, scale = getattr(encoder, "loc_key", None), getattr(encoder, "scale_key", None)
    if loc is not None and scale is not None:
        return loc, scale
    by_name = {_last(key): key for key in encoder.out_keys}
    if "loc" in by_name:
        return by_name["loc"], by_name.get("scale")
    if "latent" in by_name:
        return by_name["latent"], None
    if len(encoder.out_keys) == 1:
        return encoder.out_keys[0], None
    raise ValueError(
        f"An encoder must write 'loc' (and 'scale'), 'latent', or a single key; this one writes {encoder.out_keys}. "
        "Rename its out_keys."
    )


def encode(encoder: TensorDictModuleBase, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation ``[*B, D]`` of the latents that an encoder gives to observations.

    Args:
        encoder: any module from observations to ``loc`` and ``scale``, or to a ``latent`` that it is certain of, whose
            standard deviation is zero; see :func:`posterior_keys`.
        tensordict: holds what the encoder reads; it is left as it is.
    """
    loc_key, scale_key = posterior_keys(encoder)
    with set_interaction_type(InteractionType.DETERMINISTIC):
        out = encoder(tensordict.select(*encoder.in_keys))
    loc = out.get(loc_key)
    return loc, torch.zeros_like(loc) if scale_key is None else out.get(scale_key)
