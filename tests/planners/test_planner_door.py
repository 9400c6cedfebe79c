"""What a planner is given wrongly: never a random action, never a NaN, and every refusal names what it refuses."""

import copy
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Categorical, Unbounded

from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet, ValueEnsemble
from ls3_torchrl.planners import LatentEnv, LS3Planner

D, A, H = 3, 2, 2
BOX = Bounded(low=torch.tensor([-1.0, 0.5]), high=torch.tensor([2.0, 0.75]), shape=(A,))
SMALL = {"num_candidates": 12, "num_elites": 3, "num_particles": 3, "horizon": H, "precision": "fp32"}
PARTS = ("dynamics", "constraint", "goal", "value", "safe_set")


def networks(**changes):
    parts = {
        "dynamics": EnsembleDynamics(D, A, num_members=2, hidden=(4,)),
        "constraint": ConstraintEstimator(D, hidden=(4,)),
        "goal": GoalEstimator(D, hidden=(4,)),
        "value": ValueEnsemble(D, num_members=2, hidden=(4,)),
        "safe_set": SafeSet(D, hidden=(4,)),
    }
    return parts | changes


def planner(parts=None, spec=BOX, encoder=None, **options):
    parts = networks() if parts is None else parts
    env = LatentEnv(parts["dynamics"], parts["constraint"], parts["goal"], action_spec=spec)
    return LS3Planner(env, parts["value"], parts["safe_set"], encoder, **(SMALL | options))


def start(*batch):
    return TensorDict({"latent": torch.randn(*batch, D)}, batch)


def inside(action, spec=BOX):
    return bool((action >= spec.space.low).all() and (action <= spec.space.high).all())


# --- networks whose weights are not finite ----------------------------------------------------------------------


@settings(max_examples=300)
@given(
    part=st.sampled_from(PARTS),
    engine=st.sampled_from(["rollout", "fused"]),
    bad=st.sampled_from([float("nan"), float("inf"), float("-inf")]),
    where=st.floats(0, 1),
    layer=st.integers(0, 100),
    whole=st.booleans(),
    constraint=st.sampled_from([-9.0, 0.0, 9.0]),
    safe=st.sampled_from([-9.0, 0.0, 9.0]),
)
def test_weights_that_are_not_finite_never_give_an_action_that_nobody_chose(
    part, engine, bad, where, layer, whole, constraint, safe
):
    torch.manual_seed(0)
    parts = networks()
    for name, bias in (("constraint", constraint), ("safe_set", safe)):
        torch.nn.init.constant_(parts[name].network[-1].bias, bias)
    weights = list(parts[part].parameters())
    flat = weights[layer % len(weights)].data.reshape(-1)
    flat[:] = torch.where(torch.tensor(whole) | (torch.arange(len(flat)) == int(where * (len(flat) - 1))), bad, flat)
    td = start(2)
    try:
        out = planner(parts, engine=engine)(td)
    except FloatingPointError:
        assert "action" not in td
        return
    # Only where the plans can be judged all the same: by other members or units, or as a fallback without the value.
    assert engine == "rollout"
    assert inside(out["action"])
    assert out["plan", "score"].isfinite().all()


@pytest.mark.parametrize("part", PARTS)
def test_weights_that_break_between_two_plans_are_noticed(part):
    parts = networks()
    policy = planner(parts, engine="fused")
    policy(start(2))
    with torch.no_grad():
        next(parts[part].parameters()).fill_(torch.nan)
    with pytest.raises(FloatingPointError, match=f"Weights of {part} are not finite"):
        policy(start(2))


# --- bounds -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (Bounded(-torch.inf, torch.inf, shape=(A,)), "finite bounds"),
        (Bounded(1.0, -1.0, shape=(A,)), "low below high"),
        (
            Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 0.0]), shape=(A,)),
            "leave out actions that cannot move",
        ),
        (Bounded(torch.nan, 1.0, shape=(A,)), "finite bounds"),
        (Bounded(-1, 1, shape=(A,), dtype=torch.int64), "floating dtype"),
        (Categorical(4, shape=(A,)), "bounded spec, got Categorical"),
        (Unbounded(shape=(A,)), "bounded spec, got Unbounded"),
        (Bounded(-1.0, 1.0, shape=(A + 1,)), r"shape \[2\]"),
        (Bounded(-1.0, 1.0, shape=(5, A)), r"env\.action_spec\[0\]"),
        (Bounded(torch.tensor([[-1.0, -1.0], [-2.0, -1.0]]), torch.ones(2, A), shape=(2, A)), "rows .* differ"),
        (Bounded(-1.0, 1.0, shape=()), "needs a dimension"),
    ],
)
def test_bounds_that_no_robot_has_are_refused_when_the_planner_is_made(spec, message):
    with pytest.raises(ValueError, match=message):
        planner(spec=spec)


@settings(max_examples=60)
@given(
    low=st.floats(-1e6, 1e6, width=32),
    width=st.floats(0.0009765625, 1e6, width=32),
    dtype=st.sampled_from([torch.float16, torch.float32, torch.float64]),
)
def test_actions_lie_in_any_box_that_is_one(low, width, dtype):
    ends = torch.tensor([low, low + width], dtype=torch.float64).to(dtype)
    spec = Bounded(ends[0].expand(A), ends[1].expand(A), shape=(A,), dtype=dtype)
    if not (ends.isfinite().all() and ends[0] < ends[1]):
        with pytest.raises(ValueError, match="finite bounds"):
            planner(spec=spec)
        return
    action = planner(spec=spec)(start(3))["action"]
    assert action.dtype == dtype
    assert inside(action, spec)


# --- modules that do not fit ------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", ["constraint", "goal", "value", "safe_set"])
def test_heads_of_another_latent_size_are_refused_when_the_planner_is_made(part):
    kind = type(networks()[part])
    with pytest.raises(ValueError, match=rf"reads 'latent' of shape \[\*B, {D + 2}\], got \[1, {D}\]"):
        planner(networks(**{part: kind(D + 2, hidden=(4,))}))


@pytest.mark.parametrize("part", [*PARTS, "encoder"])
@pytest.mark.parametrize("wrong", [torch.nn.Linear(D, 1), {"in_keys": ["latent"]}, None])
def test_what_is_no_module_of_tensordicts_is_refused_by_name(part, wrong):
    if part == "encoder" and wrong is None:
        return
    with pytest.raises(TypeError, match=rf"{part} must be a module.*TensorDictModule\(network"):
        planner(encoder=wrong) if part == "encoder" else planner(networks(**{part: wrong}))


@pytest.mark.parametrize("width", [2, 3])
def test_a_head_that_writes_more_than_one_number_is_refused(width):
    wide = TensorDictModule(torch.nn.Linear(D, width), ["latent"], ["logit"])
    with pytest.raises(ValueError, match=rf"safe_set.*must write \[\*B, 1\].*it wrote \[1, {width}\]"):
        planner(networks(safe_set=wide))


def test_a_foreign_head_of_another_size_is_refused_in_words():
    own = TensorDictModule(torch.nn.Linear(D + 1, 1), ["latent"], ["logit"])
    with pytest.raises(ValueError, match=r"constraint .*cannot read latents of size 3.*one latent_dim"):
        planner(networks(constraint=own))


def test_an_encoder_for_other_latents_is_named():
    encoder = TensorDictModule(torch.nn.Linear(5, D + 1), ["state"], ["latent"])
    with pytest.raises(ValueError, match=r"'latent' to plan from has shape \[2, 4\].*need \[\*B, 3\]"):
        planner(encoder=encoder)(TensorDict({"state": torch.zeros(2, 5)}, [2]))


def test_making_a_planner_draws_no_random_numbers():
    parts = networks()
    before = torch.get_rng_state()
    planner(parts)
    assert torch.equal(before, torch.get_rng_state())


# --- the plan before --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -1.0])
@pytest.mark.parametrize("name", ["mean", "std"])
def test_a_last_plan_that_is_no_gaussian_starts_afresh(name, bad):
    if (name, bad) == ("mean", -1.0):
        return
    td = start(2)
    td["plan", "mean"], td["plan", "std"] = torch.ones(2, H, A), 0.1 * torch.ones(2, H, A)
    td["plan", name][0, 0, 0] = bad
    mean, std = planner(p_random=0.5).warm_start.read(td, 2)
    middle, wide = (BOX.space.low + BOX.space.high) / 2, (BOX.space.high - BOX.space.low) / 4
    assert torch.equal(mean[0], middle.expand(H, A))
    assert torch.equal(std[0], wide.expand(H, A))
    assert torch.equal(mean[1], torch.ones(H, A))  # the other row keeps its own
    assert planner(p_random=0.5)(td)["action"].isfinite().all()


@pytest.mark.parametrize("shape", [(2, H + 1, A), (2, H, A + 1), (3, H, A)])
def test_the_plan_of_another_planner_is_refused(shape):
    td = TensorDict({"latent": torch.zeros(2, D)}, [])
    td["plan", "mean"], td["plan", "std"] = torch.zeros(shape), torch.ones(shape)
    with pytest.raises(ValueError, match="Leave out a plan of another planner"):
        planner(p_random=0.5)(td)


class Broken:
    """An optimiser that returns what is no action."""

    num_candidates, uses_warm_start = 4, False

    def max_iterations(self, max_restarts):
        return 1

    def sample_noise(self, rows, horizon, action_dim):
        return ()

    def __call__(self, score_plans, low, high, *, batch, horizon, max_restarts, mean=None, std=None, noise=None):
        from ls3_torchrl.planners import OptimizerResult

        nothing = torch.full((batch, horizon, len(low)), torch.nan)
        zeros = torch.zeros(batch)
        return OptimizerResult(nothing, zeros, nothing, nothing, zeros.long(), zeros.bool(), zeros.long())


def test_an_optimiser_that_returns_nan_is_named():
    parts = networks()
    env = LatentEnv(parts["dynamics"], parts["constraint"], parts["goal"], action_spec=BOX)
    with pytest.raises(ValueError, match="The plan of Broken is not finite"):
        LS3Planner(env, parts["value"], parts["safe_set"], optimizer=Broken(), horizon=H)(start(2))


# --- copies -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["rollout", "fused"])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda policy: pickle.loads(pickle.dumps(policy))])
def test_a_copy_of_a_planner_that_has_planned_plans_alike(engine, copied):
    policy, td = planner(engine=engine), start(2)
    policy(td.copy())
    other = copied(policy)
    torch.manual_seed(3)
    one = policy(td.copy())["action"]
    torch.manual_seed(3)
    assert torch.equal(one, other(td.copy())["action"])
