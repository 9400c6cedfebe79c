"""Safe set, constraint and goal estimators: the same network under three names."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from ls3_torchrl.modules import ConstraintEstimator, GoalEstimator, LatentClassifier, SafeSet

NAMED = [
    (LatentClassifier, "logit"),
    (SafeSet, "safe_set_logit"),
    (ConstraintEstimator, "constraint_logit"),
    (GoalEstimator, "goal_logit"),
]
each_classifier = pytest.mark.parametrize(("kind", "logit_key"), NAMED)


@each_classifier
def test_default_network_is_three_layers_of_256(kind: type[LatentClassifier], logit_key: str):
    layers = [layer for layer in kind(latent_dim=32).modules() if isinstance(layer, nn.Linear)]
    sizes = [(layer.in_features, layer.out_features) for layer in layers]
    assert sizes == [(32, 256), (256, 256), (256, 256), (256, 1)]


@each_classifier
def test_only_the_logit_is_written_unless_the_probability_is_asked_for(kind: type[LatentClassifier], logit_key: str):
    latent = torch.randn(4, 8)
    td = kind(8, hidden=(16,))(TensorDict({"latent": latent}, [4]))
    assert set(td.keys()) == {"latent", logit_key}
    asked = kind(8, hidden=(16,), prob_key="p")
    assert asked.out_keys == [logit_key, "p"]
    td = asked(TensorDict({"latent": latent}, [4]))
    assert set(td.keys()) == {"latent", logit_key, "p"}
    assert td[logit_key].shape == td["p"].shape == (4, 1)


@each_classifier
def test_probability_is_the_logistic_function_of_the_logit(kind: type[LatentClassifier], logit_key: str):
    classifier = kind(1, hidden=(), prob_key="p")
    (layer,) = [layer for layer in classifier.modules() if isinstance(layer, nn.Linear)]
    with torch.no_grad():
        layer.weight.fill_(2.0)
        layer.bias.fill_(-1.0)
    latent = torch.tensor([[0.5], [3.0], [-1.0]])
    td = classifier(TensorDict({"latent": latent}, [3]))
    assert td[logit_key].flatten().tolist() == [0.0, 5.0, -3.0]
    expected = torch.tensor([[1 / (1 + math.exp(-logit))] for logit in (0.0, 5.0, -3.0)])
    torch.testing.assert_close(td["p"], expected)
    torch.testing.assert_close(classifier.probability(latent), expected)


@each_classifier
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_any_batch_shape(kind: type[LatentClassifier], logit_key: str, batch: tuple[int, ...]):
    td = kind(8, hidden=(16,))(TensorDict({"latent": torch.randn(*batch, 8)}, batch))
    assert td[logit_key].shape == (*batch, 1)


@each_classifier
def test_nested_keys(kind: type[LatentClassifier], logit_key: str):
    classifier = kind(8, hidden=(16,), latent_key=("model", "z"), logit_key=("judge", "logit"), prob_key=("judge", "p"))
    td = classifier(TensorDict({"model": {"z": torch.randn(4, 8)}}, [4]))
    torch.testing.assert_close(td["judge", "p"], td["judge", "logit"].sigmoid())
    assert logit_key not in td


def test_a_classifier_knows_its_name_and_its_label():
    told = {kind: (kind.name, kind.label_key) for kind, _ in NAMED}
    assert told == {
        LatentClassifier: (None, None),
        SafeSet: ("safe_set", None),
        ConstraintEstimator: ("constraint", ("next", "constraint")),
        GoalEstimator: ("goal", ("next", "success")),
    }


def test_a_subclass_is_two_attributes():
    class Slippery(LatentClassifier):
        name = "slippery"
        label_key = ("next", "slippery")

    assert Slippery(8, hidden=(16,)).out_keys == ["slippery_logit"]
    assert Slippery(8, hidden=(16,), logit_key="ice").out_keys == ["ice"]


def test_the_probability_is_that_of_a_forward_of_ones_own():
    class Shifted(SafeSet):
        def forward(self, tensordict: TensorDict) -> TensorDict:
            tensordict = super().forward(tensordict)
            return tensordict.set("safe_set_logit", tensordict["safe_set_logit"] + 3.0)

    classifier, latent = Shifted(8, hidden=(16,)), torch.randn(4, 8)
    torch.testing.assert_close(classifier.probability(latent), (classifier.network(latent) + 3.0).sigmoid())


@each_classifier
@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_it_computes_in_the_dtype_it_was_moved_to(kind: type[LatentClassifier], logit_key: str, dtype: torch.dtype):
    classifier, latent = kind(8, hidden=(16,), prob_key="p"), torch.randn(4, 8)
    before = classifier(TensorDict({"latent": latent}, [4]))
    after = classifier.to(dtype)(TensorDict({"latent": latent.to(dtype)}, [4]))
    for key in (logit_key, "p"):
        assert after[key].dtype == dtype
        tolerance = 1e-6 if dtype == torch.float64 else 0.02
        torch.testing.assert_close(after[key], before[key].to(dtype), atol=tolerance, rtol=tolerance)


@each_classifier
def test_missing_latent_is_named(kind: type[LatentClassifier], logit_key: str):
    with pytest.raises(KeyError, match=rf"{kind.__name__} needs the keys \['latent'\].*It has: z"):
        kind(8, hidden=(16,))(TensorDict({"z": torch.zeros(4, 8)}, [4]))
