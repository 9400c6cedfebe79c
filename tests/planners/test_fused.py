from contextlib import suppress

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import Bounded

from ls3_torchrl.layers import fastest_precision
from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet, ValueEnsemble
from ls3_torchrl.planners import FusedImagination, ImaginationNoise, LatentEnv, RolloutImagination, feasible
from ls3_torchrl.planners.imagination import Limits

D, A, M = 4, 2, 3
B, N, H, P = 2, 7, 3, 4
NAMES = ("dynamics", "constraint", "goal", "value", "safe_set")


def build(seed=0, **dynamics):
    torch.manual_seed(seed)
    return {
        "dynamics": EnsembleDynamics(D, A, num_members=M, hidden=(8,), **dynamics),
        "constraint": ConstraintEstimator(D, hidden=(8,)),
        "goal": GoalEstimator(D, hidden=(8,)),
        "value": ValueEnsemble(D, num_members=2, hidden=(8,)),
        "safe_set": SafeSet(D, hidden=(8,)),
    }


def env_of(parts):
    spec = Bounded(low=-1.0, high=1.0, shape=(A,))
    return LatentEnv(parts["dynamics"], parts["constraint"], parts["goal"], action_spec=spec)


def fused_of(parts, **options):
    return FusedImagination(env_of(parts), parts["value"], parts["safe_set"], **options)


def problem():
    torch.manual_seed(1)
    noise = ImaginationNoise(torch.randint(M, (H, P)), torch.randn(B, H, P, D))
    return torch.randn(B, D), torch.rand(B, N, H, A) * 2 - 1, noise


def assert_same(got, want):
    for name, one, other in zip(got._fields, got, want, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5, msg=name)


def test_bf16_stays_close_relative_to_the_spread_of_plans():
    parts = build()
    latent, actions, noise = problem()
    exact = fused_of(parts, precision="fp32")(latent, actions, noise)
    rough = fused_of(parts, precision="bf16")(latent, actions, noise)
    for name, one, other in zip(exact._fields, rough, exact, strict=True):
        assert one.dtype == torch.float32
        scale = max(float(other.abs().max()), float(other.std()))
        assert (one - other).abs().max() < 0.05 * scale, name
    # It did run in another precision.
    assert not torch.equal(exact.value, rough.value)


# One candidate, some of the seven, all of them, and then two, three and all four particles at a time.
@pytest.mark.parametrize("block", [1, 3, 7, 14, 21, 100])
def test_blocks_are_a_matter_of_speed_only(block):
    parts = build()
    latent, actions, noise = problem()
    whole = fused_of(parts, precision="fp32")(latent, actions, noise)
    assert_same(fused_of(parts, precision="fp32", block=block)(latent, actions, noise), whole)


@pytest.mark.parametrize("block", [1024, 10])
@pytest.mark.parametrize("fraction", [0.0, 0.7, 1.0])
def test_with_limits_only_what_is_feasible_is_valued_and_nothing_else_changes(fraction, block):
    imagine = fused_of(build(), precision="fp32", block=block)
    whole = imagine(*problem())
    # Half of the plans end safely enough, and none or some or all of those keep to the constraint.
    constraint_threshold = whole.constraint_prob.amax(-1).quantile(fraction).item() + (1e-6 if fraction else -1e-6)
    limits = Limits(whole.safe_set_prob.median(dim=1, keepdim=True).values, constraint_threshold)
    part = imagine(*problem(), limits)
    allowed = feasible(whole, safe_set_threshold=limits.safe_set_threshold, constraint_threshold=constraint_threshold)
    assert allowed.any() == (fraction > 0.0)
    assert not allowed.all()
    for name in ("constraint_prob", "safe_set_prob"):
        assert torch.equal(getattr(part, name), getattr(whole, name))
    for name in ("value", "goal_prob"):
        torch.testing.assert_close(getattr(part, name)[allowed], getattr(whole, name)[allowed])
        assert getattr(part, name)[~allowed].isnan().all()


class LargestTensor(TorchDispatchMode):
    """Remembers the bytes of the largest tensor that any operation returned."""

    def __init__(self):
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        for tensor in out if isinstance(out, (tuple, list)) else [out]:
            if isinstance(tensor, torch.Tensor) and not func.is_view:
                self.bytes = max(self.bytes, tensor.nbytes)
        return out


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_memory_is_that_of_a_block_however_many_plans_there_are(precision, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)  # modes watch their own thread alone
    torch.manual_seed(0)
    env = LatentEnv(
        EnsembleDynamics(32, 2),
        ConstraintEstimator(32),
        GoalEstimator(32),
        action_spec=Bounded(low=-1.0, high=1.0, shape=(A,)),
    )
    imagine = FusedImagination(env, ValueEnsemble(32), SafeSet(32), precision=precision, block=512)
    imagine.refresh()
    largest = {}
    for b, n, p in ((1, 50, 20), (1, 400, 20), (4, 100, 20), (1, 100, 200)):
        members = torch.randint(5, (2, p))
        noise = ImaginationNoise(members, torch.randn(b, 2, p, 32))
        with LargestTensor() as seen:
            imagine(torch.randn(b, 32), torch.rand(b, n, 2, 2), noise)
        largest[b, n, p] = seen.bytes
    # The widest layer of a block, in float32: 256 numbers a particle.
    assert max(largest.values()) <= 512 * 256 * 4
    assert largest[1, 400, 20] == largest[4, 100, 20]


@pytest.mark.parametrize("block", [None, 4 * 7])
def test_what_a_gpu_compiles_is_one_graph_with_the_same_results(monkeypatch, block):
    parts, kept = build(), torch.compile
    exact = fused_of(parts, precision="fp32")(*problem())
    compiled = []

    def compile_whole(function, *, dynamic, mode):
        compiled.append(mode)
        return kept(function, dynamic=dynamic, fullgraph=True, backend="eager")

    monkeypatch.setattr(torch, "compile", compile_whole)
    imagine = fused_of(parts, precision="fp32", compiled=True, block=block)
    for _ in range(2):
        for one, other in zip(imagine(*problem()), exact, strict=True):
            torch.testing.assert_close(one, other)
    assert compiled == ["reduce-overhead"]
    with torch.no_grad():
        for parameter in parts["value"].parameters():
            parameter.mul_(0.5)
    again = fused_of(parts, precision="fp32")(*problem())
    torch.testing.assert_close(imagine(*problem()).value, again.value)
    assert not torch.equal(again.value, exact.value)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_the_gpu_imagines_what_the_cpu_does(precision):
    latent, actions, noise = problem()
    exact = fused_of(build(), precision="fp32")(latent, actions, noise)
    parts = {name: module.cuda() for name, module in build().items()}
    spec = Bounded(low=-1.0, high=1.0, shape=(A,), device="cuda")
    env = LatentEnv(parts["dynamics"], parts["constraint"], parts["goal"], action_spec=spec, device="cuda")
    imagine = FusedImagination(env, parts["value"], parts["safe_set"], precision=precision)
    on_gpu = imagine(latent.cuda(), actions.cuda(), ImaginationNoise(*(part.cuda() for part in noise)))
    for name, one, other in zip(exact._fields, on_gpu, exact, strict=True):
        tolerance = (0.01 if precision == "fp32" else 0.05) * max(float(other.abs().max()), float(other.std()))
        assert (one.cpu() - other).abs().max() < tolerance, name


def test_a_snapshot_is_taken_only_when_something_changed():
    imagine = fused_of(build(), precision="fp32")
    assert imagine.refresh() is True
    assert imagine.refresh() is False
    imagine(*problem())
    assert imagine.refresh() is False


def test_with_fixed_parameters_changes_are_looked_for_once_and_again_after_it():
    parts = build()
    imagine = fused_of(parts, precision="fp32")
    looked = []
    refresh = imagine.refresh
    imagine.refresh = lambda: looked.append(refresh())
    with imagine.parameters_fixed():
        first = imagine(*problem())
        imagine(*problem())
    assert looked == [True]
    with torch.no_grad():
        parts["safe_set"].network[-1].bias += 3.0
    with suppress(RuntimeError), imagine.parameters_fixed():
        raise RuntimeError("an error in between must not leave them fixed")
    after = imagine(*problem())
    assert looked == [True, True, False]
    assert (after.safe_set_prob > first.safe_set_prob).all()


@pytest.mark.parametrize("fused", [False, True], ids=["Adam", "fused Adam"])
@pytest.mark.parametrize("name", NAMES)
def test_weights_after_an_optimiser_step_are_used(name, fused):
    parts = build()
    imagine = fused_of(parts, precision="fp32")
    before = imagine(*problem())
    module = parts[name]
    optimizer = torch.optim.Adam(module.parameters(), lr=0.1, fused=fused)
    sum(p.square().sum() for p in module.parameters()).backward()
    optimizer.step()
    after = imagine(*problem())
    assert any(not torch.allclose(one, other, atol=1e-4) for one, other in zip(before, after, strict=True))
    assert_same(after, fused_of(parts, precision="fp32")(*problem()))


def test_weights_after_load_state_dict_are_used():
    parts, others = build(0), build(1)
    imagine = fused_of(parts, precision="fp32")
    imagine(*problem())
    for name in NAMES:
        parts[name].load_state_dict(others[name].state_dict())
    assert_same(imagine(*problem()), fused_of(others, precision="fp32")(*problem()))


def test_the_snapshot_does_not_alias_the_networks():
    parts = build()
    imagine = fused_of(parts, precision="fp32")
    before = imagine(*problem())
    imagine.refresh = lambda: False
    with torch.no_grad():
        for name in NAMES:
            for parameter in parts[name].parameters():
                parameter.zero_()
    assert_same(imagine(*problem()), before)


def test_inputs_are_left_as_they_were():
    latent, actions, noise = problem()
    copies = latent.clone(), actions.clone(), noise.noise.clone()
    fused_of(build(), precision="fp32")(latent, actions, noise)
    assert all(torch.equal(a, b) for a, b in zip(copies, (latent, actions, noise.noise), strict=True))


def test_log_scales_are_clamped_as_in_the_module():
    parts = build()
    with torch.no_grad():  # one half of the log standard deviations far above the bound, one far below
        bias = parts["dynamics"].network.biases[-1]
        bias[..., D : D + 2], bias[..., D + 2 :] = 50.0, -50.0
    plain = RolloutImagination(env_of(parts), parts["value"], parts["safe_set"])(*problem())
    for got, want in zip(fused_of(parts, precision="fp32")(*problem()), plain, strict=True):
        torch.testing.assert_close(got, want, atol=1e-3, rtol=1e-4)


def test_control_affine_dynamics_are_imagined_as_in_the_module():
    parts = build(control_affine=True)
    plain = RolloutImagination(env_of(parts), parts["value"], parts["safe_set"])(*problem())
    assert_same(fused_of(parts, precision="fp32")(*problem()), plain)


def test_auto_settles_on_what_was_measured():
    assert fastest_precision("cpu") in ("fp32", "bf16")
    imagine = fused_of(build(), precision="auto")
    imagine(*problem())
    expected = {"fp32": torch.float32, "bf16": torch.bfloat16}[fastest_precision("cpu")]
    assert imagine._snapshot.dtype == expected


def test_unknown_precision_is_refused():
    with pytest.raises(ValueError, match="precision must be one of 'auto', 'fp32', 'bf16'; got 'fp16'"):
        fused_of(build(), precision="fp16")


class OwnValue(nn.Module):
    """A value function of the user's own."""

    in_keys, out_keys = ("latent",), ("state_value",)

    def forward(self, tensordict: TensorDict) -> TensorDict:
        return tensordict.set("state_value", tensordict["latent"][..., None, :1])


def test_other_networks_are_refused_with_the_way_out():
    parts = build() | {"value": OwnValue()}
    assert not FusedImagination.supports(env_of(parts), parts["value"], parts["safe_set"])
    with pytest.raises(TypeError, match='engine="rollout"'):
        fused_of(parts)


def test_a_classifier_with_another_activation_is_not_mistaken_for_a_relu_network():
    parts = build()
    parts["goal"].network = nn.Sequential(nn.Linear(D, 8), nn.Tanh(), nn.Linear(8, 1))
    assert not FusedImagination.supports(env_of(parts), parts["value"], parts["safe_set"])
