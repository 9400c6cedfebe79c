"""The gradient of halves is that of the whole batch, and the number of cores does not show in it."""

import threading

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from ls3_torchrl.halves import Halves
from ls3_torchrl.modules import EnsembleDynamics, PixelDecoder, PixelEncoder
from ls3_torchrl.objectives import LatentPredictionLoss, VAELoss
from ls3_torchrl.trainers.vae_gradient import TARGET, VAEGradient, in_memory_order

D = 4


@pytest.fixture(autouse=True)
def put_threads_back():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def images(count):
    return torch.randint(256, (count, 3, 64, 64), dtype=torch.uint8)


def batch_of(size):
    rows = {"pixels": images(size), "action": torch.randn(size, 2), "next": {"pixels": images(size)}}
    return TensorDict({**rows, TARGET: images(size)}, [size])


def modules():
    torch.manual_seed(0)
    made = [PixelEncoder(3, D), PixelDecoder(3, D), EnsembleDynamics(D, 2, num_members=2, hidden=(8,))]
    for module in made[:2]:
        module.to(memory_format=torch.channels_last)
    return made


def gradient_of(made, *, bf16=False, reduction="mean"):
    loss = VAELoss(*made[:2], beta=0.1, reduction=reduction)
    parameters = [p for module in made for p in module.parameters()]
    prediction = LatentPredictionLoss(made[0], made[2])
    return VAEGradient(loss, prediction, parameters, bf16=bf16)


def computed(gradient, batch, noise, weight, cores):
    torch.set_num_threads(cores)
    with Halves() as both:
        losses, value = gradient(batch, noise, weight, both)
    return {**losses, "value": value}, [None if leaf.grad is None else leaf.grad.clone() for leaf in gradient.leaves]


@pytest.mark.parametrize("size", [1, 6, 7])
@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_halves_have_the_whole_batchs_losses_and_gradient(size, reduction):
    made, weight = modules(), 0.7
    batch, noise = batch_of(size), torch.randn(size, D)
    gradient = gradient_of(made, reduction=reduction)
    losses, found = computed(gradient, batch, noise, weight, 2)
    # By the losses as they are called elsewhere, which encode every image by themselves.
    target = batch[TARGET]
    loc, scale = made[0].of_pixels(target)
    whole = gradient.loss.of_posterior(loc, scale, target / 255.0, noise=noise)
    prediction = gradient.prediction(batch)["loss_prediction"]
    value = whole["loss_vae"] + weight * prediction
    expected = torch.autograd.grad(value, gradient.parameters)
    for name, there in {**whole, "prediction": prediction, "value": value}.items():
        torch.testing.assert_close(losses[name], there.detach(), rtol=1e-5, atol=1e-6)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, in_memory_order(theirs), rtol=1e-4, atol=1e-5 * float(theirs.abs().max()))


@pytest.mark.parametrize("bf16", [False, True])
@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_one_core_and_two_give_the_same_bits(bf16, weight):
    gradient, batch, noise = gradient_of(modules(), bf16=bf16), batch_of(9), torch.randn(9, D)
    (losses, one), (others, two) = (computed(gradient, batch, noise, weight, cores) for cores in (1, 2))
    assert all(torch.equal(losses[name], others[name]) for name in losses)
    for first, second in zip(one, two, strict=True):
        assert torch.equal(first, second) if first is not None else second is None
    assert ("prediction" in losses) == any(grad is not None for grad in one[-4:]) == bool(weight)


def test_modules_that_look_at_the_whole_batch_are_given_it():
    class Reader(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer, self.sizes = torch.nn.Linear(3, D), []

        def forward(self, pixels):
            self.sizes.append(len(pixels))
            mean = self.layer(pixels.float().mean((-2, -1)) / 255.0)
            return mean, torch.ones_like(mean)

    reader = Reader()
    made = modules()
    made[0] = TensorDictModule(reader, ["camera"], ["loc", "scale"])
    _, found = computed(gradient_of(made), batch_of(6), torch.randn(6, D), 1.0, 2)
    assert reader.sizes == [18]  # each image once
    assert all(grad is not None for grad in found)
    made = modules()
    made[0][0].module.convolutions.insert(1, torch.nn.Dropout2d())
    assert not gradient_of(made)._can_be_halved()


def test_halves_wait_for_each_other_and_leave_no_thread_behind():
    torch.set_num_threads(2)
    began, ended = threading.active_count(), []

    def late():
        assert torch.get_num_threads() == 1
        ended.append(threading.current_thread())

    def fail():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), Halves() as both:
        both(fail, late)
    assert ended[0] is not threading.main_thread()
    assert (threading.active_count(), torch.get_num_threads()) == (began, 2)
    with pytest.raises(ZeroDivisionError), Halves() as both:
        both(late, lambda: 1 / 0)


def test_four_cores_are_shared():
    torch.set_num_threads(4)
    with Halves() as both:
        assert both(torch.get_num_threads, torch.get_num_threads) == (2, 2)
    torch.set_num_threads(1)
    with Halves() as both:
        assert both(threading.current_thread, threading.current_thread) == (threading.main_thread(),) * 2
