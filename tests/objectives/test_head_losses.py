"""Losses of several classifiers at once are what each would be alone."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.objectives import HardUpdate

from ls3_torchrl.modules import ConstraintEstimator, GoalEstimator, SafeSet
from ls3_torchrl.objectives import ClassifierLoss, OfflineValueLoss, SafeSetLoss
from ls3_torchrl.objectives.head import StackedHeads


def three(hidden=(16, 16)):
    heads = [kind(4, hidden=hidden) for kind in (SafeSet, ConstraintEstimator, GoalEstimator)]
    safe_set = SafeSetLoss(heads[0])
    HardUpdate(safe_set, value_network_update_interval=99)
    return [safe_set, *map(ClassifierLoss, heads[1:])]


def batch(size=32):
    def flag():
        return torch.rand(size, 1) < 0.5

    reached = {"latent": torch.randn(size, 4), "constraint": flag(), "success": flag()}
    return TensorDict({"latent": torch.randn(size, 4), "in_success": flag(), "next": reached}, [size])


def test_stacked_losses_and_gradients_are_those_of_each_alone():
    losses, batches = three(), [batch() for _ in range(3)]
    assert StackedHeads.can_stack(losses)
    names = [loss.out_keys[0] for loss in losses]
    found = []
    for compute in (
        StackedHeads(losses).losses,
        lambda rows: [one.losses(b) for one, b in zip(losses, rows, strict=True)],
    ):
        for loss in losses:
            loss.zero_grad()
        outputs = compute(batches)
        sum(output[name] for output, name in zip(outputs, names, strict=True)).backward()
        gradients = [p.grad.clone() for loss in losses for p in loss.parameters() if p.requires_grad]
        found.append((outputs, gradients))
    (outputs, gradients), (expected, alone) = found
    assert [sorted(output) for output in outputs] == [sorted(output) for output in expected]
    for output, other in zip(outputs, expected, strict=True):
        for name, value in output.items():
            torch.testing.assert_close(value, other[name])
    assert len(gradients) == 3 * 6
    torch.testing.assert_close(gradients, alone)


def test_weights_that_change_in_place_are_seen():
    losses, batches = three(), [batch() for _ in range(3)]
    stacked = StackedHeads(losses)
    with torch.no_grad():
        for loss in losses:
            for parameter in loss.parameters():
                parameter.zero_()
    for output in stacked.losses(batches)[1:]:
        value = next(item for name, item in output.items() if name.startswith("loss_"))
        torch.testing.assert_close(value, torch.tensor(2.0).log())


class Doubled(GoalEstimator):
    def of_latent(self, latent):
        return 2.0 * super().of_latent(latent)


class Weighed(ClassifierLoss):
    def losses(self, tensordict):
        return {name: 2.0 * value for name, value in super().losses(tensordict).items()}


@pytest.mark.parametrize(
    "other",
    [
        lambda: ClassifierLoss(GoalEstimator(4, hidden=(16, 8))),
        lambda: ClassifierLoss(Doubled(4, hidden=(16, 16))),
        lambda: Weighed(GoalEstimator(4, hidden=(16, 16))),
        lambda: ClassifierLoss(TensorDictModule(torch.nn.Linear(4, 1), ["latent"], ["logit"]), name="goal"),
        lambda: OfflineValueLoss(TensorDictModule(torch.nn.Linear(4, 1), ["latent"], ["state_value"])),
    ],
    ids=["another shape", "another output", "another loss", "another module", "no classifier"],
)
def test_what_is_not_alike_is_not_stacked(other):
    assert not StackedHeads.can_stack([*three()[:2], other()])


def test_a_hook_on_a_classifier_or_a_loss_is_not_passed_over():
    losses = three()
    losses[1].classifier.register_forward_hook(lambda *_: None)
    assert not StackedHeads.can_stack(losses)
    losses = three()
    losses[2].register_forward_hook(lambda *_: None)
    assert not StackedHeads.can_stack(losses)


class Counting:
    """Wraps ``forward`` without being a loss."""

    def forward(self, tensordict):
        self.calls = getattr(self, "calls", 0) + 1
        return super().forward(tensordict)


class Counted(Counting, ClassifierLoss):
    pass


def test_what_happens_in_a_call_is_known():
    assert ClassifierLoss(GoalEstimator(4)).is_plain
    assert not Counted(GoalEstimator(4)).is_plain
    for register in ("register_forward_hook", "register_forward_pre_hook", "register_full_backward_hook"):
        loss = ClassifierLoss(GoalEstimator(4))
        getattr(loss, register)(lambda *_: None)
        assert not loss.is_plain
