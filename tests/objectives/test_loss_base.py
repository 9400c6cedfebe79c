"""What holds for every loss: keys, calls by keyword, chosen outputs, compilation, and moves to another dtype."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.distributions import Normal
from torchrl.data import Bounded
from torchrl.objectives import HardUpdate, LossModule

from ls3_torchrl.baselines import SafetyCritic, SafetyCriticLoss, deterministic_actor
from ls3_torchrl.modules import (
    ConstraintEstimator,
    EnsembleDynamics,
    GoalEstimator,
    PixelDecoder,
    PixelEncoder,
    SafeSet,
    ValueEnsemble,
)
from ls3_torchrl.objectives import (
    ClassifierLoss,
    EnsembleDynamicsLoss,
    LatentLoss,
    LatentPredictionLoss,
    OfflineValueLoss,
    SafeSetLoss,
    TD1ValueLoss,
    VAELoss,
)
from ls3_torchrl.objectives.base import with_members

B, D, A = 4, 3, 2
SPEC = Bounded(low=-2.0, high=2.0, shape=(A,))


def lagged(loss: LossModule) -> LossModule:
    HardUpdate(loss, value_network_update_interval=99)
    return loss


LOSSES: dict[str, Callable[[], LossModule]] = {
    "vae": lambda: VAELoss(PixelEncoder(latent_dim=D), PixelDecoder(latent_dim=D, background=True), beta=0.1),
    "vae_sum": lambda: VAELoss(PixelEncoder(latent_dim=D), PixelDecoder(latent_dim=D), reduction="sum"),
    "prediction": lambda: LatentPredictionLoss(
        PixelEncoder(latent_dim=D), EnsembleDynamics(D, A, hidden=(8,), control_affine=True)
    ),
    "dynamics": lambda: EnsembleDynamicsLoss(EnsembleDynamics(D, A, hidden=(8,), action_scale=0.5)),
    "offline_value": lambda: OfflineValueLoss(ValueEnsemble(D, hidden=(8,))),
    "td1_value": lambda: lagged(TD1ValueLoss(ValueEnsemble(D, hidden=(8,)))),
    "safe_set": lambda: lagged(SafeSetLoss(SafeSet(D, hidden=(8,)))),
    "constraint": lambda: ClassifierLoss(ConstraintEstimator(D, hidden=(8,))),
    "goal": lambda: ClassifierLoss(GoalEstimator(D, hidden=(8,))),
    "safety_critic": lambda: lagged(
        SafetyCriticLoss(SafetyCritic(SPEC, D, hidden=(8,)), deterministic_actor(SPEC, D, hidden=(8,)))
    ),
}
each_loss = pytest.mark.parametrize("make", LOSSES.values(), ids=LOSSES)


def batch_of(loss: LossModule, *, optional: bool = True) -> TensorDict:
    """A batch of what the loss reads, under the keys that it has now."""
    flags = {"label", "in_success", "constraint"}
    sizes = {
        "action": A,
        "reward": 1,
        "reward_to_go": 1,
        "weight": 1,
        "lagged_value_target": 1,
        "lagged_safe_set_target": 1,
        **dict.fromkeys(flags, 1),
    }
    batch = TensorDict({}, [B])
    for name, key in vars(loss.tensor_keys).items():
        if key is None or name in loss._written or (name in loss._optional and not optional):
            continue
        if "pixels" in name or name == "target":
            batch[key] = torch.randint(256, (B, 3, 64, 64), dtype=torch.uint8)
        elif name in flags:
            batch[key] = torch.rand(B, 1) > 0.5
        else:
            batch[key] = torch.rand(B, sizes.get(name, D))
    return batch


def joined(key: NestedKey) -> str:
    return key if isinstance(key, str) else "_".join(key)


def by_keyword(batch: TensorDictBase) -> dict[str, Tensor]:
    return {joined(key): value for key, value in batch.items(include_nested=True, leaves_only=True)}


def seeded(loss: LossModule, *args: object, **kwargs: object) -> object:
    torch.manual_seed(3)
    return loss(*args, **kwargs)


def total(out: TensorDictBase) -> Tensor:
    return sum(value for key, value in out.items() if key.startswith("loss_"))


def gradients(loss: LossModule, out: TensorDictBase) -> list[Tensor]:
    return list(torch.autograd.grad(total(out), [p for p in loss.parameters() if p.requires_grad]))


# Keys


@each_loss
def test_a_call_by_keyword_equals_one_with_a_tensordict(make: Callable[[], LossModule]):
    loss = make()
    batch = batch_of(loss)
    expected = seeded(loss, batch.copy())
    assert list(expected.keys()) == loss.out_keys
    out = seeded(loss, **by_keyword(batch))
    assert len(loss.out_keys) == 1 or isinstance(out, tuple)
    for key, value in zip(loss.out_keys, [out] if isinstance(out, Tensor) else out, strict=True):
        assert torch.equal(value, expected[key])


@each_loss
def test_renamed_and_nested_keys_are_keywords_too(make: Callable[[], LossModule]):
    loss = make()
    batch = batch_of(loss)
    expected = seeded(loss, batch.copy())
    renamed = {name: ("my", "own", name) for name in vars(loss.tensor_keys) if name not in loss._written}
    kept = {name: key for name, key in vars(loss.tensor_keys).items() if key is not None}
    renamed = {name: key for name, key in renamed.items() if name in kept}
    loss.set_keys(**renamed)
    nested = TensorDict({renamed[name]: batch[kept[name]] for name in renamed}, [B])
    assert set(loss.in_keys) <= set(renamed.values())
    outs = [seeded(loss, nested.copy()), seeded(loss, **by_keyword(nested))]
    by_name = dict(zip(loss.out_keys, [outs[1]] if isinstance(outs[1], Tensor) else outs[1], strict=True))
    for key in loss.out_keys:
        assert torch.equal(outs[0][key], expected[key])
        assert torch.equal(by_name[key], expected[key])


@each_loss
def test_tensors_may_come_in_the_order_of_the_keys(make: Callable[[], LossModule]):
    loss = make()
    batch = batch_of(loss, optional=False)
    expected = seeded(loss, batch.copy())
    out = seeded(loss, *(batch[key] for key in loss.in_keys))
    for key, value in zip(loss.out_keys, [out] if isinstance(out, Tensor) else out, strict=True):
        assert torch.equal(value, expected[key])


@each_loss
def test_missing_and_unknown_keywords_are_named(make: Callable[[], LossModule]):
    loss = make()
    tensors = by_keyword(batch_of(loss, optional=False))
    last = joined(loss.in_keys[-1])
    with pytest.raises(KeyError, match=f"{type(loss).__name__} needs the keys"):
        loss(**{name: value for name, value in tensors.items() if name != last})
    with pytest.raises(TypeError, match="unexpected keyword argument 'misspelt'"):
        loss(**tensors, misspelt=torch.zeros(B, 1))


@each_loss
def test_keys_return_to_those_that_the_loss_was_made_with(make: Callable[[], LossModule]):
    loss = make()
    before, names = loss.in_keys, list(vars(loss.tensor_keys))
    loss.set_keys(**{name: f"other_{name}" for name in names})
    assert loss.in_keys != before
    loss.set_keys(**dict.fromkeys(names))
    assert loss.in_keys == before
    assert type(loss).default_keys is type(loss)._AcceptedKeys


def test_the_optional_weight_is_a_keyword_and_no_in_key():
    loss = LOSSES["safe_set"]()
    batch = batch_of(loss)
    assert "safe_set_weight" in batch
    assert "safe_set_weight" not in loss.in_keys
    weighted, plain = loss(**by_keyword(batch)), loss(**by_keyword(batch.exclude("safe_set_weight")))
    assert torch.equal(weighted, loss(batch)["loss_safe_set"])
    assert not torch.equal(weighted, plain)


# Outputs


@each_loss
def test_outputs_can_be_chosen(make: Callable[[], LossModule]):
    loss = make()
    batch = batch_of(loss)
    first, every = loss.out_keys[0], list(loss.out_keys)
    expected = seeded(loss, batch.copy())[first]
    assert loss.select_out_keys(first) is loss
    assert loss.out_keys == [first]
    assert torch.equal(seeded(loss, **by_keyword(batch)), expected)
    out = seeded(loss, batch.copy())
    assert list(out.keys()) == [first]
    assert torch.equal(out[first], expected)
    loss.reset_out_keys()
    assert loss.out_keys == every


@each_loss
def test_out_keys_can_be_set(make: Callable[[], LossModule]):
    loss = make()
    batch = batch_of(loss)
    expected = seeded(loss, batch.copy())
    loss.out_keys = list(reversed(loss.out_keys))
    out = seeded(loss, **by_keyword(batch))
    for key, value in zip(loss.out_keys, [out] if isinstance(out, Tensor) else out, strict=True):
        assert torch.equal(value, expected[key])


# Compilation and dtypes


@each_loss
def test_it_compiles_in_one_graph_with_the_same_bits(make: Callable[[], LossModule], monkeypatch: pytest.MonkeyPatch):
    loss = make()
    batch = batch_of(loss)
    torch._dynamo.reset()
    # What earlier tests looked up would not have to be traced.
    monkeypatch.setattr(torch.distributions.kl, "_KL_MEMOIZE", {})
    # Compiled before it is called eagerly: the first call must not prepare anything that the compiler cannot trace.
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    outs = [seeded(call, batch.copy()) for call in (compiled, loss)]
    for key in loss.out_keys:
        assert torch.equal(outs[0][key], outs[1][key])
    for ours, theirs in zip(*(gradients(loss, out) for out in outs), strict=True):
        assert torch.equal(ours, theirs)


@pytest.fixture
def _same_noise_in_every_dtype(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Normal, "rsample", lambda self, shape=(): self.loc + 0.5 * self.scale)


@pytest.mark.usefixtures("_same_noise_in_every_dtype")
@each_loss
def test_in_double_precision_it_is_the_same_loss_with_the_same_gradients(make: Callable[[], LossModule]):
    loss = make()
    batch = batch_of(loss)
    single = loss(batch.copy())
    of_single = gradients(loss, single)
    loss.double()
    if isinstance(loss, SafetyCriticLoss):
        loss.policy.double()  # it is no part of the loss's parameters
    double = loss(batch.apply(lambda x: x.double() if x.is_floating_point() else x))
    for key in loss.out_keys:
        torch.testing.assert_close(double[key], single[key].double(), atol=1e-5, rtol=1e-5, check_dtype=False)
    of_double = gradients(loss, double)
    for ours, theirs in zip(of_double, of_single, strict=True):
        assert ours.dtype == torch.float64
        torch.testing.assert_close(ours, theirs.double(), atol=1e-3, rtol=1e-3)
    assert any(g.abs().sum() > 0 for g in of_double)
    assert all(double[key].dtype == torch.float64 for key in loss.out_keys if key.startswith("loss_"))


@each_loss
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_in_half_precision_it_can_be_computed(make: Callable[[], LossModule], dtype: torch.dtype):
    loss = make().to(dtype)
    if isinstance(loss, SafetyCriticLoss):
        loss.policy.to(dtype)
    out = loss(batch_of(loss).apply(lambda x: x.to(dtype) if x.is_floating_point() else x))
    assert all(torch.isfinite(value) for value in out.values())
    assert all(g.dtype == dtype for g in gradients(loss, out))


# A loss of one's own, and targets for members


class DistanceLoss(LatentLoss):
    @dataclass
    class _AcceptedKeys:
        latent: NestedKey = "latent"
        next_latent: NestedKey = ("next", "latent")

    def __init__(self) -> None:
        super().__init__()
        self.out_keys = ["loss_distance"]

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        z, z_next = (tensordict.get(key) for key in self.in_keys)
        return {"loss_distance": (z_next - z).square().mean()}


def test_a_loss_of_ones_own_is_its_keys_and_its_formula():
    loss = DistanceLoss()
    batch = batch_of(loss)
    by_hand = (batch["next", "latent"] - batch["latent"]).square().mean()
    assert torch.equal(loss(batch)["loss_distance"], by_hand)
    assert torch.equal(loss(**by_keyword(batch)), by_hand)
    loss.set_keys(latent="z")
    assert loss.in_keys == ["z", ("next", "latent")]
    assert loss.default_keys().latent == "latent"
    with pytest.raises(KeyError, match=r"DistanceLoss needs the keys \['z'\]"):
        loss(batch)


@pytest.mark.parametrize(
    ("target", "predicted", "trailing", "expected"),
    [
        ((4, 1), (4, 1), 1, (4, 1)),
        ((4, 1), (4, 5, 1), 1, (4, 1, 1)),
        ((4, 5, 1), (4, 5, 1), 1, (4, 5, 1)),
        ((4, 3, 8), (4, 5, 3, 8), 2, (4, 1, 3, 8)),
        ((1,), (5, 1), 1, (1, 1)),
    ],
)
def test_targets_get_a_dimension_for_members_where_there_are_some(target, predicted, trailing, expected):
    assert with_members(torch.zeros(target), torch.zeros(predicted), "Loss", trailing=trailing).shape == expected


@pytest.mark.parametrize(
    ("target", "predicted"), [((4, 1), (4,)), ((4, 1), (4, 5)), ((4, 1), (3, 5, 1)), ((4, 2), (4, 1))]
)
def test_predictions_that_would_broadcast_into_nonsense_are_refused(target, predicted):
    with pytest.raises(ValueError, match=r"Loss compares targets of shape .* for M members"):
        with_members(torch.zeros(target), torch.zeros(predicted), "Loss")


def test_an_error_names_the_shape_that_was_given():
    with pytest.raises(ValueError, match=r"targets of shape \[3\] with predictions of shape \[3, 1\]"):
        with_members(torch.zeros(3), torch.zeros(3, 1), "ALoss")
