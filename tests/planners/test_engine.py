import pytest
import torch
from stub_planners import latents, random_planner
from torch import nn

from ls3_torchrl.planners import FusedImagination, RolloutImagination
from ls3_torchrl.planners.engine import Engine


def modules():
    planner = random_planner()
    return planner.env, planner.value, planner.safe_set


@pytest.mark.parametrize(("name", "kind"), [("auto", FusedImagination), ("fused", FusedImagination)])
def test_the_fast_engine_is_kept_from_plan_to_plan(name, kind):
    engine = Engine(*modules(), name)
    assert type(engine.choose()) is kind
    assert engine.choose() is engine.choose()


def test_rollout_is_what_was_asked_for():
    assert isinstance(Engine(*modules(), "rollout").choose(), RolloutImagination)


@pytest.mark.parametrize("reduction", ["max", "mean"])
def test_both_reduce_as_they_were_told(reduction):
    parts = modules()
    for name in ("fused", "rollout"):
        imagine = Engine(*parts, name, constraint_reduction=reduction, safe_set_reduction="min").choose()
        assert imagine.constraint_reduction == reduction
        assert imagine.safe_set_reduction == "min"


def test_the_choice_follows_the_modules():
    env, value, safe_set = modules()
    engine = Engine(env, value, safe_set)
    kept = env.goal.network
    env.goal.network = nn.Sequential(*kept, nn.Hardtanh())
    assert isinstance(engine.choose(), RolloutImagination)
    env.goal.network = kept
    assert isinstance(engine.choose(), FusedImagination)


def test_a_planner_imagines_with_what_is_chosen_at_each_plan():
    planner = random_planner()
    chosen = []
    choose = planner.engine.choose
    planner.engine.choose = lambda: chosen.append(True) or choose()
    for _ in range(2):
        planner(latents(2))
    assert len(chosen) == 2
    assert torch.is_tensor(planner.imagine_plans(torch.zeros(1, 4), torch.zeros(1, 2, 3, 2)).value)
