"""The gradient of a VAE's step, of two half batches at once where that gives the same."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import Parameter
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd

from ls3_torchrl.halves import Halves
from ls3_torchrl.modules import EnsembleDynamics, PixelDecoder, PixelEncoder
from ls3_torchrl.modules.call import encode, is_hooked
from ls3_torchrl.modules.vae import as_unit_pixels
from ls3_torchrl.objectives import LatentPredictionLoss, VAELoss

#: Where a batch holds the images to encode and reconstruct.
TARGET = "vae_target"
_Computed = tuple[dict[str, Tensor], tuple[Tensor | None, ...]]


class VAEGradient:
    """Computes equation (1) and its companion for a batch, with the gradient of their sum.

    Every image is encoded once. Where all modules are this library's, each half of the batch is computed by itself, and
    the gradients are added: the mean over the batch is that over both halves, and two cores take a half each. Noise is
    drawn for the whole batch, and the results are the same to the bit on one core and on two.

    Args:
        loss: equation (1).
        prediction: its companion, if any.
        parameters: get the gradients.
        bf16: compute under bf16 autocast.
    """

    def __init__(
        self,
        loss: VAELoss,
        prediction: LatentPredictionLoss | None,
        parameters: Iterable[Parameter],
        *,
        bf16: bool,
    ) -> None:
        self.loss, self.prediction, self.parameters, self.bf16 = loss, prediction, list(parameters), bf16
        #: The parameters' values, shared with them, in an order that suits an optimiser; they get the gradients.
        self.leaves = [in_memory_order(parameter) for parameter in self.parameters]
        self._sums = [torch.zeros_like(leaf) for leaf in self.leaves]

    def follow(self) -> None:
        """Share the values with the parameters again, where these have got memory of another order."""
        for leaf, parameter in zip(self.leaves, self.parameters, strict=True):
            leaf.data = in_memory_order(parameter)

    def __call__(
        self, batch: TensorDictBase, noise: Tensor, weight: float, both: Halves
    ) -> tuple[TensorDictBase, Tensor]:
        """Write the gradients of a batch; what the losses write, and the sum that is minimised.

        Args:
            batch: the images to reconstruct ``[B, ...]`` under :data:`TARGET`; for the prediction term also actions,
                and the images before and after them.
            noise: standard normal ``[B, D]``.
            weight: of the prediction term.
            both: computes the halves.
        """
        size = len(noise)
        if size < 2 or not self._can_be_halved():
            values, gradients = self._part(batch, noise, weight, 1.0)
            self._write(gradients)
        else:
            middle = size // 2
            ends = ((0, middle), (middle, size))
            parts = [(batch[start:end], noise[start:end], weight, (end - start) / size) for start, end in ends]
            first, second = both(lambda: self._part(*parts[0]), lambda: self._part(*parts[1]))
            self._write(first[1], second[1])
            values = {name: value + second[0][name] for name, value in first[0].items()}
        value = values.pop("sum")
        return TensorDict(values), value

    def _can_be_halved(self) -> bool:
        """Whether halves give what the whole batch gives, and may be computed at the same time."""
        modules: list[nn.Module] = [self.loss.encoder, self.loss.decoder]
        known: list[type] = [PixelEncoder, PixelDecoder]
        if self.prediction is not None:
            modules.append(self.prediction.dynamics)
            known.append(EnsembleDynamics)
        ours = all(type(module) is kind for module, kind in zip(modules, known, strict=True))
        parts = [part for module in modules for part in module.modules()]
        mixed = any(isinstance(part, _BatchNorm | _DropoutNd) or is_hooked(part) for part in parts)
        return ours and not mixed and self.parameters[0].device.type == "cpu"

    def _part(self, batch: TensorDictBase, noise: Tensor, weight: float, share: float) -> _Computed:
        """The losses of a part of a batch times its share in it, and the gradients of their sum."""
        target = self._in_order(batch.get(TARGET))
        with torch.autocast(noise.device.type, torch.bfloat16, enabled=self.bf16, cache_enabled=False):
            loc, scale, *pair = self._posteriors(batch, target, predicts=bool(weight))
            dtype = self.loss.decoder_dtype
            found = self.loss.of_posterior(loc, scale, as_unit_pixels(target, dtype), noise=noise.to(dtype))
            total = found["loss_vae"]
            if pair:
                assert self.prediction is not None
                actions = batch.get(self.prediction.tensor_keys.action)
                found |= self.prediction.of_latents(pair[0], actions, pair[1])
                found["prediction"] = found.pop("loss_prediction")
                total = total + weight * found["prediction"]
        gradients = torch.autograd.grad(share * total, self.parameters, allow_unused=True)
        return {name: share * value.detach() for name, value in (found | {"sum": total}).items()}, gradients

    def _in_order(self, images: Tensor) -> Tensor:
        """Images in the order of memory that the convolutions compute in: channels last."""
        ours = type(self.loss.encoder) is PixelEncoder and type(self.loss.decoder) is PixelDecoder
        return images.contiguous(memory_format=torch.channels_last) if ours and images.ndim == 4 else images

    def _posteriors(self, batch: TensorDictBase, target: Tensor, *, predicts: bool) -> list[Tensor]:
        """Means and deviations of the images to reconstruct; and the means before and after the actions."""
        if self.prediction is None or not predicts:
            return list(self._encode(target))
        keys = self.prediction.tensor_keys
        others = [self._in_order(batch.get(key)) for key in (keys.pixels, keys.next_pixels)]
        loc, scale = self._encode(torch.cat([target, *others]))
        loc, before, after = loc.chunk(3)
        return [loc, scale[: len(target)], before, after]

    def _encode(self, images: Tensor) -> tuple[Tensor, Tensor]:
        encoder = self.loss.encoder
        if type(encoder) is PixelEncoder and not is_hooked(encoder):
            return encoder.of_pixels(images)
        return encode(encoder, TensorDict({}, [len(images)]).set(encoder.in_keys[0], images))

    def _write(self, *parts: Iterable[Tensor | None]) -> None:
        """Sum the gradients of all parts."""
        for leaf, total, *found in zip(self.leaves, self._sums, *parts, strict=True):
            gradients = [in_memory_order(one) for one in found if one is not None]
            leaf.grad = None
            if len(gradients) == 1:
                leaf.grad = total.copy_(gradients[0])
            elif gradients:
                leaf.grad = torch.add(*gradients, out=total)


def in_memory_order(tensor: Tensor) -> Tensor:
    """A tensor itself, or, of weights kept channels last, a view in the order of their memory.

    PyTorch's fused Adam copies what lies in another order to and fro.
    """
    return tensor.detach() if tensor.ndim != 4 else tensor.detach().permute(0, 2, 3, 1)


def in_channel_order(tensor: Tensor) -> Tensor:
    """The reverse of :func:`in_memory_order`."""
    return tensor if tensor.ndim != 4 else tensor.permute(0, 3, 1, 2)


def reordered(state: dict[str, Any], order: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """An optimiser's state with its tensors in another order: files hold them in that of the weights' shapes."""
    averages = {index: {name: order(value) for name, value in of.items()} for index, of in state["state"].items()}
    return {**state, "state": averages}
