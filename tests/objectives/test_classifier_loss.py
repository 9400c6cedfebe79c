"""The constraint and goal estimators' binary cross-entropy, restated by hand."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from ls3_torchrl.modules import ConstraintEstimator, GoalEstimator, LatentClassifier, SafeSet
from ls3_torchrl.objectives import ClassifierLoss


def linear_estimator(slope: float) -> ConstraintEstimator:
    """An estimator whose logit is slope * z."""
    estimator = ConstraintEstimator(1, hidden=())
    estimator.network = nn.Linear(1, 1, bias=False)
    with torch.no_grad():
        estimator.network.weight.fill_(slope)
    return estimator


def reached(latent: list[float], label: list[bool], name: str = "constraint") -> TensorDict:
    z, y = torch.tensor(latent).unsqueeze(-1), torch.tensor(label).unsqueeze(-1)
    return TensorDict({"next": {"latent": z, name: y}}, [len(latent)])


def test_loss_and_accuracy_by_hand():
    z, violated = [0.1, -0.5, 2.0, -3.0], [True, True, False, False]
    out = ClassifierLoss(linear_estimator(2.0))(reached(z, violated))
    probability = [1 / (1 + math.exp(-2 * a)) for a in z]
    terms = [math.log(p if y else 1 - p) for p, y in zip(probability, violated, strict=True)]
    assert out["loss_constraint"].item() == pytest.approx(-sum(terms) / 4, rel=1e-5)
    # Logits 0.2, -1, 4, -6 say yes, no, yes, no: the second and third are wrong.
    assert out["constraint_accuracy"].item() == 0.5
    assert out["loss_constraint"].requires_grad
    assert not out["constraint_accuracy"].requires_grad


def test_loss_is_about_the_state_that_was_reached():
    loss = ClassifierLoss(linear_estimator(2.0))
    batch = reached([1.0], [True])
    before = loss(batch)["loss_constraint"]
    batch["latent"] = torch.tensor([[-100.0]])
    batch["constraint"] = torch.tensor([[False]])
    assert torch.equal(loss(batch)["loss_constraint"], before)


def test_goal_estimator_is_the_same_loss_under_its_own_name_and_label():
    estimator = linear_estimator(2.0)
    goal_estimator = GoalEstimator(1, hidden=())
    goal_estimator.network = estimator.network
    out = ClassifierLoss(goal_estimator)(reached([1.0, -0.5], [True, False], name="success"))
    assert set(out.keys()) == {"loss_goal", "goal_accuracy"}
    same = ClassifierLoss(estimator)(reached([1.0, -0.5], [True, False]))
    assert torch.equal(out["loss_goal"], same["loss_constraint"])
    assert out["goal_accuracy"].item() == 1.0


class Slippery(LatentClassifier):
    name = "slippery"
    label_key = ("labels", "ice")


def foreign() -> TensorDictModule:
    return TensorDictModule(nn.Linear(1, 1), [("model", "z")], [("model", "score")])


@pytest.mark.parametrize(
    ("make", "name", "loss_name", "label"),
    [
        (ConstraintEstimator, None, "constraint", ("next", "constraint")),
        (GoalEstimator, None, "goal", ("next", "success")),
        (GoalEstimator, "arrival", "arrival", ("next", "success")),
        (ConstraintEstimator, "goal", "goal", ("next", "constraint")),
        (Slippery, None, "slippery", ("labels", "ice")),
        (LatentClassifier, None, "constraint", ("next", "constraint")),
        (None, None, "constraint", ("next", "constraint")),
        (None, "goal", "goal", ("next", "success")),
        (None, "slippery", "slippery", ("next", "slippery")),
    ],
)
def test_name_and_label_come_from_the_classifier_unless_told_otherwise(make, name, loss_name, label):
    loss = ClassifierLoss(foreign() if make is None else make(1, hidden=()), name=name)
    assert loss.out_keys == [f"loss_{loss_name}", f"{loss_name}_accuracy"]
    assert loss.in_keys == [("next", "latent"), label]
    loss.set_keys(label="mine")
    assert loss.in_keys == [("next", "latent"), "mine"]
    loss.set_keys(label=None)  # back to its own
    assert loss.in_keys == [("next", "latent"), label]


def test_a_foreign_classifiers_first_output_is_its_logit():
    classifier, own = foreign(), linear_estimator(2.0)
    with torch.no_grad():
        classifier.module.weight.fill_(2.0)
        classifier.module.bias.zero_()
    batch = reached([0.1, -0.5, 2.0], [True, True, False])
    assert torch.equal(
        ClassifierLoss(classifier)(batch)["loss_constraint"], ClassifierLoss(own)(batch)["loss_constraint"]
    )
    ClassifierLoss(classifier)(batch)["loss_constraint"].backward()
    assert classifier.module.weight.grad.abs().sum() > 0


def test_a_safe_set_is_sent_to_its_own_loss():
    with pytest.raises(TypeError, match=r"SafeSet has no labels.*Train it with SafeSetLoss"):
        ClassifierLoss(SafeSet(1))


def test_labels_of_another_shape_are_refused():
    batch = reached([0.1, -0.5], [True, False])
    batch["next"].batch_size = []
    batch["next", "constraint"] = torch.tensor([True, False])
    with pytest.raises(ValueError, match=r"shape \[2\] with predictions of shape \[2, 1\]"):
        ClassifierLoss(linear_estimator(1.0))(batch)


def test_nested_keys_of_loss_and_module():
    estimator = ConstraintEstimator(3, hidden=(8,), latent_key=("m", "z"), logit_key=("m", "logit"))
    loss = ClassifierLoss(estimator)
    z, label = torch.randn(5, 3), torch.rand(5, 1) > 0.5
    flat = loss(TensorDict({"next": {"latent": z, "constraint": label}}, [5]))
    loss.set_keys(latent=("later", "model", "z"), label=("later", "labels", "goal"))
    nested = loss(TensorDict({"later": {"model": {"z": z}, "labels": {"goal": label}}}, [5]))
    assert torch.equal(nested["loss_constraint"], flat["loss_constraint"])


def test_misspelt_and_missing_keys():
    loss = ClassifierLoss(linear_estimator(1.0))
    with pytest.raises(ValueError, match="labels is not an accepted tensordict key"):
        loss.set_keys(labels=("next", "success"))
    with pytest.raises(KeyError, match=r"ClassifierLoss needs the keys \[\('next', 'constraint'\)\]"):
        loss(reached([0.0], [True], name="success"))


def test_loss_names_its_keys():
    loss = ClassifierLoss(linear_estimator(1.0), name="goal")
    loss.set_keys(label=("next", "success"))
    assert loss.in_keys == [("next", "latent"), ("next", "success")]
    assert loss.out_keys == ["loss_goal", "goal_accuracy"]
    assert "loss_goal" in repr(loss)


@pytest.mark.parametrize("kind", [ConstraintEstimator, GoalEstimator])
def test_estimators_overfit_eight_states(kind: type, minimise):
    label = torch.tensor([True, False] * 4).unsqueeze(-1)
    batch = TensorDict({"next": {"latent": torch.randn(8, 4), "label": label}}, [8])
    loss = ClassifierLoss(kind(4))
    loss.set_keys(label=("next", "label"))
    first, last = minimise(loss, batch, f"loss_{kind.name}", steps=80, lr=1e-3)
    assert last < 0.1 * first
    assert loss(batch)[f"{kind.name}_accuracy"].item() == 1.0
