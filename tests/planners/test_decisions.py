import pytest
import torch
from stub_planners import classifier, latents, stub_planner
from tensordict import TensorDict

from ls3_torchrl.modules import SafeSet
from ls3_torchrl.planners import describe_plan


def test_describe_plan_by_hand():
    plan = {
        "fallback": torch.tensor([[[False], [True]], [[False], [False]]]),
        "relaxed": torch.tensor([[[False], [True]], [[True], [False]]]),
        "iterations": torch.tensor([[[4], [6]], [[5], [4]]]),
    }
    described = describe_plan(TensorDict({"me": {"plan": plan}}, [2, 2]), plan_key=("me", "plan"))
    expected = {"fallback_rate": 0.25, "relaxed_rate": 0.5, "iterations": 4.75}
    assert {name: round(value.item(), 6) for name, value in described.items()} == expected


# f_S = 0.7 everywhere: the δ_S of 0.8 is relaxed once in every row, and that of 0.64 in none.
@pytest.mark.parametrize(("threshold", "rate"), [(0.8, 1.0), (0.64, 0.0)])
def test_plans_that_were_all_relaxed_are_not_taken_for_none(threshold, rate):
    planner = stub_planner(safe_set=classifier(SafeSet, prob=0.7), safe_set_threshold=threshold)
    out = planner(latents(6))
    assert out["plan", "relaxed"].dtype == torch.bool
    assert describe_plan(out)["relaxed_rate"].item() == rate


def test_a_fallback_without_any_relaxation_is_not_relaxed():
    out = stub_planner(safe_set=classifier(SafeSet, prob=0.1), max_relaxations=0)(latents(3))
    described = describe_plan(out)
    assert described["fallback_rate"].item() == 1.0
    assert described["relaxed_rate"].item() == 0.0
