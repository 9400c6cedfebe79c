"""The last plan, carried from step to step: where the next one starts from."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import TensorDictPrimer


class WarmStart:
    """Reads and writes the Gaussian that the next plan's candidates are drawn from, in float32.

    Args:
        low: lower bounds of an action, ``[A]``.
        high: upper bounds.
        horizon: H.
        plan_key: group that holds ``mean`` and ``std``, each ``[*B, H, A]``.
        is_init_key: bool ``[*B, 1]``, the first step of an episode; optional.

    Example:
        >>> from tensordict import TensorDict
        >>> warm = WarmStart(torch.tensor([-1.0]), torch.tensor([1.0]), 3, "plan", "is_init")
        >>> td = TensorDict({}, [2])
        >>> warm.read(td, 2)
        (None, None)
        >>> warm.write(td, torch.tensor([[[0.1], [0.2], [0.3]]] * 2), torch.full((2, 3, 1), 0.05))
        >>> td["next", "plan", "mean"][0].flatten().tolist()  # one step on, with an open end
        [0.20000000298023224, 0.30000001192092896, 0.0]
    """

    def __init__(self, low: Tensor, high: Tensor, horizon: int, plan_key: NestedKey, is_init_key: NestedKey) -> None:
        low, high = low.float(), high.float()
        self.middle, self.wide = (low + high) / 2, (high - low) / 4
        self.horizon, self.is_init_key = horizon, unravel_key(is_init_key)
        self.keys = {name: unravel_key((plan_key, name)) for name in ("mean", "std")}

    @property
    def in_keys(self) -> list[NestedKey]:
        """What :meth:`read` reads, if it is there."""
        return [*self.keys.values(), self.is_init_key]

    @property
    def out_keys(self) -> list[NestedKey]:
        """What :meth:`write` writes."""
        return [unravel_key(("next", key)) for key in self.keys.values()]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that carries the warm start and resets it with the episode."""
        spec = Composite()
        for key in self.keys.values():
            spec[key] = Unbounded(shape=(self.horizon, self.middle.shape[-1]), device=self.middle.device)
        # Zeros: a warm start without any spread is none (a shifted plan always has some at its open end).
        return TensorDictPrimer(spec, default_value=0.0, expand_specs=True)

    def read(self, tensordict: TensorDictBase, rows: int) -> tuple[Tensor | None, Tensor | None]:
        """Mean and standard deviation ``[rows, H, A]``; those of the whole box for rows that begin an episode.

        Also for rows in which they are no Gaussian, not finite or of negative width: a plan must not inherit it.

        Raises:
            ValueError: for another horizon, or another number of actions.
        """
        mean, std = (tensordict.get(key, None) for key in self.keys.values())
        if mean is None or std is None:
            return None, None
        expected = (self.horizon, self.middle.shape[-1])
        if mean.shape[-2:] != expected or std.shape != mean.shape or mean.shape[:-2].numel() != rows:
            raise ValueError(
                f"The last plan under {list(self.keys.values())} has shapes {list(mean.shape)} and {list(std.shape)}, "
                f"but this planner's are [*B, {expected[0]}, {expected[1]}] for {rows} rows. Leave out a plan of "
                "another planner."
            )
        mean = mean.reshape(rows, *mean.shape[-2:]).float()
        std = std.reshape(rows, *std.shape[-2:]).float()
        is_init = tensordict.get(self.is_init_key, None)
        fresh = (std == 0).all(-1, keepdim=True).all(-2, keepdim=True)
        broken = ~(mean.isfinite() & std.isfinite() & (std >= 0))
        fresh = fresh | broken.any(-1, keepdim=True).any(-2, keepdim=True)
        if is_init is not None:
            fresh = fresh | is_init.reshape(rows, 1, 1)
        return torch.where(fresh, self.middle, mean), torch.where(fresh, self.wide, std)

    def write(self, out: TensorDictBase, mean: Tensor, std: Tensor) -> None:
        """Keep a plan's last Gaussian ``[rows, H, A]`` for the step after: one action shorter, its end wide open."""
        rows = mean.shape[0]
        shifted = {
            "mean": torch.cat([mean[:, 1:], self.middle.expand(rows, 1, -1)], 1),
            "std": torch.cat([std[:, 1:], self.wide.expand(rows, 1, -1)], 1),
        }
        for key, value in zip(self.out_keys, shifted.values(), strict=True):
            out.set(key, value.reshape(*out.batch_size, *value.shape[1:]))
