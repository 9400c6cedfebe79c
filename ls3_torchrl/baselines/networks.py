"""Actors and critics of the comparisons, made of TorchRL's parts (section 1.1.2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ConvNet, ProbabilisticActor, TanhModule, TanhNormal, ValueOperator

from ls3_torchrl._checks import action_bounds, require_at_least


class PixelFeatures(nn.Module):
    """Features of images, learnt with the network that reads them: three convolutions, flattened.

    Args:
        in_channels: C, 3 x stacked frames.

    Example:
        >>> PixelFeatures(3)(torch.zeros(2, 3, 64, 64, dtype=torch.uint8)).shape
        torch.Size([2, 1024])
    """

    #: Of images of 64 x 64.
    size = 1024

    def __init__(self, in_channels: int = 3) -> None:
        super().__init__()
        self.convolutions = ConvNet(
            in_features=require_at_least(in_channels, 1, "in_channels"),
            num_cells=[32, 64, 64],
            kernel_sizes=[8, 4, 3],
            strides=[4, 2, 1],
            activation_class=nn.ReLU,
        )

    def forward(self, pixels: Tensor) -> Tensor:
        """Features ``[*B, 1024]`` of uint8 images ``[*B, C, 64, 64]``."""
        return self.convolutions(pixels.to(self.convolutions[0].weight.dtype) / 255.0)


class ObservedAction(nn.Module):
    """What a critic sees: the observation, or its features, beside the action in units of half its range.

    Args:
        action_spec: of one action ``[A]``, or batched.
        features: reads the observation first.

    Example:
        >>> seen = ObservedAction(Bounded(low=0.0, high=4.0, shape=(1,)))
        >>> seen(torch.zeros(2, 3), torch.tensor([[0.0], [3.0]]))[:, 3:].flatten().tolist()
        [-1.0, 0.5]
    """

    middle: Tensor
    reach: Tensor

    def __init__(self, action_spec: Bounded, features: nn.Module | None = None) -> None:
        super().__init__()
        low, high = action_bounds(action_spec)
        self.features = nn.Identity() if features is None else features
        self.register_buffer("middle", (high + low) / 2, persistent=False)
        self.register_buffer("reach", (high - low) / 2, persistent=False)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """``[*B, F + A]`` of observations ``[*B, …]`` and actions ``[*B, A]``."""
        features = self.features(observation)
        return torch.cat([features, ((action - self.middle) / self.reach).to(features.dtype)], -1)


class _TwoInputs(nn.Sequential):
    """A sequence whose first part takes two inputs."""

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        seen, network = self
        return network(seen(observation, action))


def _actor_network(
    in_features: int, out_features: int, features: nn.Module | None, hidden: Sequence[int]
) -> nn.Sequential:
    mlp = MLP(in_features, out_features, num_cells=list(hidden), activation_class=nn.ReLU)
    return nn.Sequential(nn.Identity() if features is None else features, mlp)


def gaussian_actor(
    action_spec: Bounded,
    in_features: int,
    *,
    observation_key: NestedKey = "loc",
    action_key: NestedKey = "action",
    features: nn.Module | None = None,
    hidden: Sequence[int] = (256, 256),
    initial_std: float = 1.0,
) -> ProbabilisticActor:
    """π(a | s), a Gaussian squashed into the actions' box; deterministic sampling takes its middle.

    Args:
        action_spec: of one action ``[A]``, or batched.
        in_features: size of the observation, or of ``features``.
        observation_key: what is read: latents, or images with ``features``.
        action_key: action ``[*B, A]``. Beside it the actor writes ``…_loc`` and ``…_scale``, and ``…_log_prob``
            ``[*B]``.
        features: reads the observation first, such as :class:`PixelFeatures`.
        hidden: sizes of the hidden layers.
        initial_std: standard deviation before squashing of an untrained actor, about.

    Example:
        >>> from tensordict import TensorDict
        >>> actor = gaussian_actor(Bounded(low=-3.0, high=3.0, shape=(2,)), 8)
        >>> td = actor(TensorDict({"loc": torch.zeros(4, 8)}, [4]))
        >>> td["action"].shape, td["action_log_prob"].shape
        (torch.Size([4, 2]), torch.Size([4]))
    """
    low, high = action_bounds(action_spec)
    network = nn.Sequential(
        _actor_network(in_features, 2 * len(low), features, hidden),
        NormalParamExtractor(scale_mapping=f"biased_softplus_{initial_std}"),
    )
    loc_key, scale_key, log_prob_key = (_beside(action_key, name) for name in ("loc", "scale", "log_prob"))
    return ProbabilisticActor(
        TensorDictModule(network, [observation_key], [loc_key, scale_key]),
        in_keys={"loc": loc_key, "scale": scale_key},
        out_keys=[action_key],
        spec=Bounded(low=low, high=high, shape=low.shape),
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high},
        return_log_prob=True,
        log_prob_key=log_prob_key,
    )


def _beside(key: NestedKey, name: str) -> NestedKey:
    """The key of something that belongs to what is under ``key``."""
    return f"{key}_{name}" if isinstance(key, str) else (*key[:-1], f"{key[-1]}_{name}")


def deterministic_actor(
    action_spec: Bounded,
    in_features: int,
    *,
    observation_key: NestedKey = "loc",
    action_key: NestedKey = "action",
    features: nn.Module | None = None,
    hidden: Sequence[int] = (256, 256),
) -> TensorDictSequential:
    """μ(s) in the actions' box. Arguments as for :func:`gaussian_actor`.

    Example:
        >>> from tensordict import TensorDict
        >>> actor = deterministic_actor(Bounded(low=-3.0, high=3.0, shape=(2,)), 8)
        >>> actor(TensorDict({"loc": torch.zeros(4, 8)}, [4]))["action"].shape
        torch.Size([4, 2])
    """
    low, high = action_bounds(action_spec)
    network = _actor_network(in_features, len(low), features, hidden)
    return TensorDictSequential(
        TensorDictModule(network, [observation_key], [action_key]),
        TanhModule(in_keys=[action_key], spec=Bounded(low=low, high=high, shape=low.shape)),
    )


def action_value(
    action_spec: Bounded,
    in_features: int,
    *,
    observation_key: NestedKey = "loc",
    action_key: NestedKey = "action",
    value_key: NestedKey = "state_action_value",
    features: nn.Module | None = None,
    hidden: Sequence[int] = (256, 256),
) -> ValueOperator:
    """Q(s, a), the value of an action in a state.

    Args:
        action_spec: of one action ``[A]``, or batched.
        in_features: size of the observation, or of ``features``.
        observation_key: what is read: latents, or images with ``features``.
        action_key: action ``[*B, A]``.
        value_key: where the value ``[*B, 1]`` is written.
        features: reads the observation first.
        hidden: sizes of the hidden layers.

    Example:
        >>> from tensordict import TensorDict
        >>> critic = action_value(Bounded(low=-3.0, high=3.0, shape=(2,)), 8)
        >>> td = TensorDict({"loc": torch.zeros(4, 8), "action": torch.zeros(4, 2)}, [4])
        >>> critic(td)["state_action_value"].shape
        torch.Size([4, 1])
    """
    width = in_features + action_spec.shape[-1]
    mlp = MLP(width, 1, num_cells=list(hidden), activation_class=nn.ReLU)
    network = _TwoInputs(ObservedAction(action_spec, features), mlp)
    return ValueOperator(network, in_keys=[observation_key, action_key], out_keys=[value_key])
