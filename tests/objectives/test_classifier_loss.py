"""The constraint and goal estimators' binary cross-entropy, restated by hand."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from ls3_torchrl.modules import ConstraintEstimator, GoalEstimator
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


def test_goal_estimator_is_the_same_loss_under_another_name_and_label():
    estimator = linear_estimator(2.0)
    goal = ClassifierLoss(estimator, name="goal")
    goal.set_keys(label=("next", "success"))
    out = goal(reached([1.0, -0.5], [True, False], name="success"))
    assert set(out.keys()) == {"loss_goal", "goal_accuracy"}
    same = ClassifierLoss(estimator)(reached([1.0, -0.5], [True, False]))
    assert torch.equal(out["loss_goal"], same["loss_constraint"])
    assert out["goal_accuracy"].item() == 1.0


def test_nested_keys_of_loss_and_module():
    estimator = GoalEstimator(3, hidden=(8,), latent_key=("m", "z"), logit_key=("m", "logit"))
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
    batch = TensorDict({"next": {"latent": torch.randn(8, 4), "constraint": label}}, [8])
    loss = ClassifierLoss(kind(4))
    first, last = minimise(loss, batch, "loss_constraint", steps=80, lr=1e-3)
    assert last < 0.1 * first
    assert loss(batch)["constraint_accuracy"].item() == 1.0
