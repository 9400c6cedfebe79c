"""A policy's action is carried out where a feasible plan starts with it; else that of the safest feasible plan."""

import math

import pytest
import torch
from stub_planners import A, D, assert_warm_starts_are_carried, classifier, corridor, random_planner, stub_planner
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import check_env_specs
from torchrl.modules import RandomPolicy

from ls3_torchrl.modules import ConstraintEstimator, SafeSet
from ls3_torchrl.planners import SafeSetFilter, describe_filter

#: f_C <= 0.2 and f_S >= 0.8 hold up to here, where the slope is 50 and the offset 1.
EDGE = 1.0 - math.log(4.0) / 50.0
WIDE = {"num_candidates": 300, "num_elites": 20, "optim_steps": 6}


def wall(**options):
    """A planner in a world where x beyond 1 violates."""
    return stub_planner(constraint=classifier(ConstraintEstimator, slope=50.0, offset=1.0), **(WIDE | options))


def home(**options):
    """A planner in a world where a plan must end at x below 1."""
    return stub_planner(safe_set=classifier(SafeSet, slope=-50.0, offset=1.0), **(WIDE | options))


def at(*x, action, y=0.0):
    latent = torch.zeros(len(x), D)
    latent[:, 0], latent[:, 1] = torch.tensor(x), y
    return TensorDict({"latent": latent, "action": torch.tensor(action).expand(len(x), A).clone()}, [len(x)])


def test_safe_actions_pass_untouched():
    torch.manual_seed(0)
    td = at(0.5, -3.0, action=[0.4, 0.123456])
    wanted = td["action"].clone()
    out = SafeSetFilter(None, wall())(td)
    assert torch.equal(out["action"], wanted)
    group = out["filter"]
    assert group["feasible"].all()
    assert not (group["intervened"] | group["constraint"] | group["safe_set"]).any()
    assert torch.equal(group["distance"], torch.zeros(2, 1))


def test_an_action_that_violates_is_replaced_by_one_that_does_not():
    torch.manual_seed(0)
    out = SafeSetFilter(None, wall())(at(0.5, 0.0, action=[1.0, -0.3]))
    assert (out["latent"][:, 0] + out["action"][:, 0] <= EDGE + 1e-3).all()
    group = out["filter"]
    assert (group["intervened"] & group["feasible"] & group["constraint"]).all()
    assert not group["safe_set"].any()
    assert torch.equal(group["proposed"], torch.tensor([[1.0, -0.3]] * 2))
    torch.testing.assert_close(group["distance"], (out["action"] - group["proposed"]).norm(dim=-1, keepdim=True))


@pytest.mark.parametrize("threshold", [0.5, None])
def test_the_action_instead_is_that_of_the_safest_plan(threshold):
    torch.manual_seed(0)
    judges = {
        "constraint": classifier(ConstraintEstimator, slope=4.0, offset=1.0),
        "safe_set": classifier(SafeSet, slope=2.0, offset=0.0),
    }
    planner = stub_planner(**judges, **WIDE, horizon=1, safe_set_threshold=threshold)
    out = SafeSetFilter(None, planner)(at(0.0, action=[1.0, 0.0]))
    x = torch.linspace(-1.0, 1.0, 2001)
    f_c, f_s = torch.sigmoid(4.0 * (x - 1.0)), torch.sigmoid(2.0 * x)
    margin = torch.where((f_c <= 0.2) & (f_s >= 0.5), f_s - f_c, -1.0) if threshold else -f_c
    assert out["filter", "intervened"].all()
    assert out["action"][0, 0].item() == pytest.approx(x[margin.argmax()].item(), abs=0.05)


def test_the_safest_plan_is_safe_at_every_step():
    torch.manual_seed(0)
    judges = {
        "constraint": classifier(ConstraintEstimator, slope=4.0, offset=1.0),
        "safe_set": classifier(SafeSet, slope=2.0, offset=0.0),
    }
    planner = stub_planner(**judges, **WIDE, horizon=2, safe_set_threshold=0.5)
    out = SafeSetFilter(None, planner)(at(*[1.5] * 6, action=[0.0, 0.0]))
    # One step away from x = 1.5 lie 0.5 and more, of which f_C allows up to 0.65; the second step is free.
    assert out["filter", "feasible"].all()
    torch.testing.assert_close(out["action"][:, 0], torch.full((6,), -1.0), atol=0.05, rtol=0)


def test_the_safe_set_is_asked_for_the_end_of_the_plan_alone():
    torch.manual_seed(0)
    # One step from x = 0.5 to 1.5 can be taken back in a plan of three steps, and not in a plan of one.
    assert not SafeSetFilter(None, home())(at(0.5, action=[1.0, 0.0]))["filter", "intervened"].any()
    out = SafeSetFilter(None, home(horizon=1))(at(0.5, action=[1.0, 0.0]))
    group = out["filter"]
    assert (group["intervened"] & group["safe_set"] & group["feasible"]).all()
    assert not group["constraint"].any()
    assert out["action"][0, 0] <= EDGE - 0.5
    assert not SafeSetFilter(None, home(horizon=1, safe_set_threshold=None))(at(0.5, action=[1.0, 0.0]))[
        "filter", "intervened"
    ].any()


def test_where_nothing_is_feasible_it_takes_the_least_harm_and_says_so():
    torch.manual_seed(0)
    # The edge is 1.53 away: the way out violates once at least, and goes straight back.
    out = SafeSetFilter(None, wall(horizon=3))(at(2.5, action=[1.0, 0.0]))
    assert out["action"][0, 0] < -0.5
    assert out["filter", "intervened"].all()
    assert not out["filter", "feasible"].any()


def test_rows_are_judged_by_themselves_in_any_batch():
    torch.manual_seed(0)
    td = at(0.5, 0.0, 2.5, -3.0, action=[1.0, 0.0]).reshape(2, 2)
    out = SafeSetFilter(None, wall())(td)
    assert out["filter", "intervened"].squeeze(-1).tolist() == [[True, True], [True, False]]
    assert out["filter", "feasible"].squeeze(-1).tolist() == [[True, True], [False, True]]
    assert out["next", "plan", "mean"].shape == (2, 2, 3, A)


def test_actions_out_of_the_box_are_proposed_at_its_edge():
    torch.manual_seed(0)
    out = SafeSetFilter(None, wall())(at(-3.0, action=[7.0, -7.0]))
    assert out["action"].tolist() == [[1.0, -1.0]]
    assert not out["filter", "intervened"].any()


def test_units_of_the_distance_are_half_ranges():
    planner = random_planner(safe_set_threshold=None, constraint_threshold=None)  # half ranges 1 and 0.75
    group = SafeSetFilter(None, planner)
    td = TensorDict({"latent": torch.zeros(1, D), "action": torch.tensor([[-1.0, 2.0]])}, [1])
    assert group._distance(td["action"], torch.tensor([[-3.0, 0.5]])).item() == pytest.approx(math.sqrt(8.0))


def push(**options):
    """A policy that goes right whatever it sees."""
    return TensorDictModule(
        lambda latent: torch.tensor([1.0, 0.0]).expand(*latent.shape[:-1], A), ["latent"], ["action"]
    )


def test_a_careless_policy_never_passes_the_wall_in_a_rollout():
    torch.manual_seed(0)
    planner = wall(p_random=0.3)
    safe = SafeSetFilter(push(), planner)
    assert safe.in_keys == planner.in_keys
    env = corridor(safe)
    path = env.rollout(9, safe, break_when_any_done=False)
    assert set(safe.out_keys) <= set(path.keys(True, True))
    assert_warm_starts_are_carried(path)
    bare = env.rollout(9, push(), break_when_any_done=False)
    assert bare["next", "latent"][..., 0].max() > 2.5
    assert path["next", "latent"][..., 0].max() <= EDGE + 1e-3
    rates = describe_filter(path)
    assert rates["constraint_rate"] == rates["intervention_rate"] > 0.5
    assert rates["infeasible_rate"] == 0.0


def test_a_collector_finds_the_warm_start_by_itself():
    torch.manual_seed(0)
    safe = SafeSetFilter(push(), wall(p_random=0.3))
    env = corridor(safe)
    check_env_specs(env)
    collector = Collector(
        env.base_env, safe, frames_per_batch=9 * 2, total_frames=18, auto_register_policy_transforms=True
    )
    for batch in collector:
        assert batch["next", "latent"][..., 0].max() <= EDGE + 1e-3
    collector.shutdown()


def test_torchrls_random_policy_is_one_like_others():
    torch.manual_seed(0)
    env = corridor(planner := wall(p_random=0.3))
    safe = SafeSetFilter(RandomPolicy(env.action_spec), planner)
    path = env.rollout(60, safe, break_when_any_done=False)
    assert path["next", "latent"][..., 0].max() <= EDGE + 1e-3
    assert 0 < describe_filter(path)["intervention_rate"] < 0.5


def test_what_does_not_fit_is_refused():
    planner = wall()
    with pytest.raises(TypeError, match="planner must be an LS3Planner, such as"):
        SafeSetFilter(None, push())
    other = TensorDictModule(lambda latent: latent, ["latent"], ["wish"])
    with pytest.raises(ValueError, match=r"must write 'action', the planner's action, but TensorDictModule writes"):
        SafeSetFilter(other, planner)
    with pytest.raises(ValueError, match=r"both write .*'plan', 'mean'.* Give the filter's planner a plan_key"):
        SafeSetFilter(wall(), planner)
    SafeSetFilter(wall(), wall(plan_key="filter_plan"))
    with pytest.raises(KeyError, match="action"):
        SafeSetFilter(None, planner)(TensorDict({"latent": torch.zeros(1, D)}, [1]))
    with pytest.raises(ValueError, match=r"must have the shape \[1, 2\], got \[1, 3\]"):
        SafeSetFilter(None, planner)(TensorDict({"latent": torch.zeros(1, D), "action": torch.zeros(1, 3)}, [1]))
    with pytest.raises(ValueError, match="The policy's action"):
        SafeSetFilter(None, planner)(at(0.0, action=[math.nan, 0.0]))
