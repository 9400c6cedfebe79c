import pytest
import torch

from ls3_torchrl.planners import PlanScores, PlanStatistics, feasible, least_harm, objective
from ls3_torchrl.planners.scoring import require_sound


def statistics(value=((0.0,),), goal=((0.0,),), constraint=((0.0,),), safe=(1.0,)):
    return PlanStatistics(*(torch.tensor(field) for field in (value, goal, constraint, safe)))


def test_objective_is_the_mean_value_plus_the_steps_in_the_goal():
    plans = statistics(
        value=[[-10.0, -20.0], [1.0, 3.0], [0.0, 0.0]],
        # One half is not yet "in the goal".
        goal=[[0.4, 0.6, 0.9], [0.5, 0.5, 0.51], [0.0, 0.0, 0.0]],
    )
    assert objective(plans).tolist() == [-13.0, 3.0, 0.0]


def test_counting_goal_steps_equals_summing_rewards_up_to_the_horizon():
    torch.manual_seed(0)
    goal = torch.rand(50, 4)
    plans = PlanStatistics(torch.zeros(50, 2), goal, torch.zeros(50, 4), torch.ones(50))
    rewards = torch.where(goal > 0.5, 0.0, -1.0).sum(-1)
    assert torch.equal(objective(plans) - 4, rewards)


def test_feasible_asks_every_step_and_the_end_both_bounds_included():
    plans = statistics(
        constraint=[[0.25, 0.0], [0.0, 0.26], [0.0, 0.0], [0.0, 0.0], [0.9, 0.9]],
        safe=[0.75, 1.0, 0.75, 0.74, 0.0],
    )
    allowed = feasible(plans, safe_set_threshold=0.75, constraint_threshold=0.25)
    assert allowed.tolist() == [True, False, True, False, False]


def test_each_row_may_have_its_own_safe_set_threshold():
    plans = PlanStatistics(
        torch.zeros(2, 3, 1), torch.zeros(2, 3, 1), torch.zeros(2, 3, 1), torch.tensor([[0.5, 0.6, 0.7]] * 2)
    )
    allowed = feasible(plans, safe_set_threshold=torch.tensor([[0.6], [0.65]]), constraint_threshold=0.2)
    assert allowed.tolist() == [[False, True, True], [False, False, True]]


def test_probabilities_that_are_not_a_number_are_never_feasible():
    plans = statistics(constraint=[[torch.nan], [0.0]], safe=[1.0, torch.nan])
    assert not feasible(plans, safe_set_threshold=0.5, constraint_threshold=0.5).any()


def test_least_harm_counts_violations_first_and_the_safe_end_second():
    plans = statistics(
        # Violating steps: 2, 1, 1, 0, 0; the least safe end with fewer violations beats the safest with more.
        constraint=[[0.9, 0.9], [0.9, 0.1], [0.1, 0.3], [0.2, 0.2], [0.0, 0.0]],
        safe=[1.0, 0.0, 0.4, 0.0, 0.1],
    )
    ranking = least_harm(plans, constraint_threshold=0.2)
    assert ranking.argsort(descending=True).tolist() == [4, 3, 2, 1, 0]


def test_without_a_safe_set_the_least_likely_violation_comes_second():
    plans = statistics(constraint=[[0.9, 0.1], [0.6, 0.1], [0.1, 0.15]], safe=[0.9, 0.1, 0.0])
    ranks = least_harm(plans, constraint_threshold=0.2, safe_set=False)
    assert ranks.argsort(descending=True).tolist() == [2, 1, 0]
    assert least_harm(plans, constraint_threshold=0.2).argsort(descending=True).tolist() == [2, 0, 1]


def test_least_harm_is_lexicographic_for_any_probabilities():
    torch.manual_seed(0)
    constraint, safe = torch.rand(300, 5), torch.rand(300)
    ranking = least_harm(PlanStatistics(torch.zeros(300, 1), constraint, constraint, safe), constraint_threshold=0.3)
    keys = list(zip((-(constraint > 0.3).sum(-1)).tolist(), safe.tolist(), strict=True))
    assert ranking.argsort(descending=True).tolist() == sorted(range(300), key=keys.__getitem__, reverse=True)


# --- nothing is known of a plan ---------------------------------------------------------------------------------


def judged(statistics, threshold=0.8):
    allowed = feasible(statistics, safe_set_threshold=threshold, constraint_threshold=0.2)
    return PlanScores(objective(statistics), allowed, least_harm(statistics, constraint_threshold=0.2))


def three_plans(**changes):
    """One row of three plans over two steps: the first is feasible."""
    parts = {
        "value": torch.tensor([[[-1.0], [-2.0], [-3.0]]]),
        "goal_prob": torch.zeros(1, 3, 2),
        "constraint_prob": torch.tensor([[[0.1, 0.1], [0.9, 0.9], [0.1, 0.9]]]),
        "safe_set_prob": torch.tensor([[0.9, 0.9, 0.9]]),
    }
    return PlanStatistics(**(parts | changes))


def test_a_plan_of_which_nothing_is_known_ranks_behind_one_that_surely_violates():
    nan = torch.nan
    statistics = three_plans(constraint_prob=torch.tensor([[[nan, 0.0], [1.0, 1.0], [0.0, nan]]]))
    scores = judged(statistics)
    assert scores.fallback.isnan().tolist() == [[True, False, True]]
    assert not scores.feasible.any()
    require_sound(statistics, scores)  # the one that violates can still be judged


@pytest.mark.parametrize(
    ("part", "named"),
    [
        ("constraint_prob", "constraint estimator's probabilities"),
        ("safe_set_prob", "safe set's probabilities"),
        ("value", "value"),
    ],
)
def test_a_row_in_which_nothing_is_known_is_refused_by_the_name_of_the_network(part, named):
    sound = three_plans()
    require_sound(sound, judged(sound))
    broken = three_plans(**{part: torch.full_like(getattr(sound, part), torch.nan)})
    with pytest.raises(FloatingPointError, match=f"1 of 1 rows, the first being 0: the {named}.*training diverged"):
        require_sound(broken, judged(broken))
    both = PlanStatistics(*(torch.cat([a, b]) for a, b in zip(sound, broken, strict=True)))
    with pytest.raises(FloatingPointError, match="1 of 2 rows, the first being 1"):
        require_sound(both, judged(both))


def test_values_of_plans_that_are_not_feasible_may_be_missing():
    statistics = three_plans(value=torch.tensor([[[-1.0], [torch.nan], [torch.nan]]]))
    require_sound(statistics, judged(statistics))
    infinite = three_plans(value=torch.tensor([[[torch.inf], [-2.0], [-3.0]]]))
    with pytest.raises(FloatingPointError, match="the value"):
        require_sound(infinite, judged(infinite))
