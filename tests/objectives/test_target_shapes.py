"""Targets, labels and weights that would be broadcast: a loss is the formula on what was meant, or an error."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy
from torchrl.data import Bounded
from torchrl.objectives import HardUpdate

from ls3_torchrl.baselines import SafetyCritic, SafetyCriticLoss, deterministic_actor
from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, PixelEncoder, SafeSet, ValueEnsemble
from ls3_torchrl.objectives import (
    ClassifierLoss,
    EnsembleDynamicsLoss,
    OfflineValueLoss,
    SafeSetLoss,
    TD1ValueLoss,
)

B, D, M = 5, 3, 2


def reshaped(values, shape):
    """Values ``[B, 1]`` in another shape, in which each keeps its row or all are lost."""
    return values.reshape(-1)[torch.arange(torch.Size(shape).numel()) % B].reshape(shape)


SHAPES = st.sampled_from(
    [(B, 1), (B,), (1, B), (1, 1), (1,), (), (B, B), (B, 1, 1), (B, M), (B, 2), (B, M, 1), (M, B, 1)]
)


def lagged(loss):
    HardUpdate(loss, value_network_update_interval=99)
    return loss


def value_case(name, shape):
    torch.manual_seed(0)
    value = ValueEnsemble(D, num_members=M, hidden=(4,))
    z, target = torch.randn(B, D), torch.randn(B, 1)
    reached = {"latent": z, "reward": reshaped(target, shape) if name == "reward" else -torch.ones(B, 1)}
    batch = TensorDict({"latent": z, "reward_to_go": reshaped(target, shape), "next": reached}, [])
    members = value(TensorDict({"latent": z}, [B]))["state_value"].detach()
    if name == "reward":
        loss = lagged(TD1ValueLoss(value, gamma=0.5, zero_at_goal=False))
        expected = (members - (target.unsqueeze(1) + 0.5 * members)).square().mean()
    else:
        loss, expected = OfflineValueLoss(value), (members - target.unsqueeze(1)).square().mean()
    return loss, batch, "loss_value", expected


def classifier_case(name, shape):
    torch.manual_seed(0)
    z, label = torch.randn(B, D), torch.tensor([[1.0], [0.0], [0.0], [1.0], [1.0]])
    if name == "label":
        head = ConstraintEstimator(D, hidden=(4,))
        batch = TensorDict({"next": {"latent": z, "constraint": reshaped(label, shape)}}, [])
        return ClassifierLoss(head), batch, "loss_constraint", cross_entropy(head.network(z), label).detach()
    head = SafeSet(D, hidden=(4,))
    batch = TensorDict({"latent": z, "next": {"latent": z}, "in_success": label}, [])
    weight = torch.tensor([[1.0], [0.5], [0.0], [2.0], [1.0]])
    batch[{"in_success": "in_success", "weight": "safe_set_weight"}[name]] = reshaped(
        label if name == "in_success" else weight, shape
    )
    logit = head.network(z).detach()
    target = torch.maximum(label, 0.3 * logit.sigmoid())
    expected = cross_entropy(logit, target, weight if name == "weight" else None)
    return lagged(SafeSetLoss(head, gamma=0.3)), batch, "loss_safe_set", expected


@settings(max_examples=150)
@given(name=st.sampled_from(["reward", "reward_to_go", "label", "in_success", "weight"]), shape=SHAPES)
def test_a_loss_is_the_formula_on_what_was_meant_or_an_error_that_names_both_shapes(name, shape):
    make = value_case if name.startswith("reward") else classifier_case
    loss, batch, key, expected = make(name, shape)
    if shape == (B, 1):
        torch.testing.assert_close(loss(batch)[key], expected)
    elif shape != (B, M, 1) or make is classifier_case:  # one for each member's prediction is as clear
        with pytest.raises(ValueError, match="shape"):
            loss(batch)


@pytest.mark.parametrize("label", [2.0, -1.0, 1.5, float("nan"), float("inf")])
def test_labels_for_which_the_cross_entropy_has_no_lower_bound_are_refused(label):
    for name in ("label", "in_success"):
        loss, batch, _, _ = classifier_case(name, (B, 1))
        where = ("next", "constraint") if name == "label" else "in_success"
        batch[where] = torch.full((B, 1), label)
        with pytest.raises(ValueError, match=r"must be bools or lie in \[0, 1\]; received values from .*cost > 0"):
            loss(batch)


def test_negative_weights_are_refused():
    loss, batch, _, _ = classifier_case("weight", (B, 1))
    batch["safe_set_weight"][2] = -1.0
    with pytest.raises(ValueError, match=r"'safe_set_weight' of at least 0, got -1"):
        loss(batch)


@pytest.mark.parametrize("wrong", [(B,), (B, 2), (1, 1)])
def test_constraints_of_another_shape_are_refused_by_the_safety_critics_loss(wrong):
    spec = Bounded(-1.0, 1.0, shape=(2,))
    critic, policy = SafetyCritic(spec, D, hidden=(4,)), deterministic_actor(spec, D, hidden=(4,))
    loss = lagged(SafetyCriticLoss(critic, policy, gamma=0.5))
    reached = {"loc": torch.zeros(B, D), "constraint": torch.zeros(wrong, dtype=torch.bool)}
    batch = TensorDict({"loc": torch.zeros(B, D), "action": torch.zeros(B, 2), "next": reached}, [])
    with pytest.raises(ValueError, match="SafetyCriticLoss compares"):
        loss(batch)


def test_next_latents_of_another_shape_are_refused_by_the_dynamics_loss():
    loss = EnsembleDynamicsLoss(EnsembleDynamics(D, 2, num_members=M, hidden=(4,)))
    batch = TensorDict(
        {"latent": torch.zeros(B, D), "action": torch.zeros(B, 2), "next": {"latent": torch.zeros(1, D)}}, []
    )
    with pytest.raises(ValueError, match="EnsembleDynamicsLoss compares targets of shape"):
        loss(batch)


@pytest.mark.parametrize(("scale", "shift"), [(255.0, 0.0), (2.0, -1.0), (1.0, 0.5)])
def test_float_images_in_other_units_are_refused_by_the_encoder(scale, shift):
    images = scale * torch.rand(2, 3, 64, 64) + shift
    with pytest.raises(ValueError, match=r"must lie in \[0, 1\]; received values from .*divide by 255"):
        PixelEncoder(latent_dim=4)(TensorDict({"pixels": images}, [2]))
