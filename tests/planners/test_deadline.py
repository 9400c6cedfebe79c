"""A plan ends in time: after the last round that fits in, with the best that was found."""

import pytest
import torch
from stub_planners import A, D, classifier, latents, stub_planner
from tensordict import TensorDict

from ls3_torchrl.modules import ConstraintEstimator, SafeSet
from ls3_torchrl.planners import CrossEntropyMethod, PlanScores, SafeSetFilter, deadline
from ls3_torchrl.planners.deadline import Deadline


@pytest.fixture
def clock(monkeypatch):
    """Every look at the clock takes 10 ms, and nothing else takes any time."""

    class Clock:
        now = 0.0

        def __call__(self):
            self.now += 0.01
            return self.now

    clock = Clock()
    monkeypatch.setattr(deadline, "perf_counter", clock)
    return clock


def test_a_round_fits_in_if_one_as_long_as_the_longest_would(clock):
    limit = Deadline(75.0)
    limit.begin_round()  # after 10 ms
    assert limit.leaves_time()  # 20 ms, and a round takes 10
    clock.now += 0.015  # one that takes 25
    assert limit.leaves_time()  # 45 ms; 70 with another
    assert not limit.leaves_time()  # 55 ms; 80 with another as long as the longest
    assert Deadline(None).leaves_time(1000)


@pytest.mark.parametrize(("max_ms", "iterations"), [(None, 6), (1e4, 6), (45.0, 3), (1e-3, 1)])
def test_a_plan_ends_with_the_last_round_that_fits_in(clock, max_ms, iterations):
    torch.manual_seed(0)
    planner = stub_planner(num_candidates=60, optim_steps=6, max_ms=max_ms)
    out = planner(latents(3))
    assert out["plan", "iterations"].tolist() == [[iterations]] * 3
    assert out["plan", "feasible"].all()
    assert (out["action"][:, 0] > 0.0).all()  # V rises to the right: better than the average after one round, too


def test_a_plan_in_time_is_the_one_without_a_limit(clock):
    plans = []
    for max_ms in (None, 1e4):
        torch.manual_seed(3)
        plans.append(stub_planner(max_ms=max_ms)(latents(2)))
    assert (plans[0] == plans[1]).all()


def test_without_anything_feasible_in_time_it_takes_the_least_harm_and_starts_afresh(clock):
    torch.manual_seed(0)
    # No plan of three steps ends at x below 1 from x = 9: each round relaxes the safe set and starts again.
    planner = stub_planner(
        safe_set=classifier(SafeSet, slope=-50.0, offset=1.0), num_candidates=200, optim_steps=4, max_ms=45.0
    )
    out = planner(TensorDict({"latent": torch.full((1, D), 9.0)}, [1]))
    assert out["plan", "iterations"].item() == 3
    assert out["plan", "fallback"].all()
    assert out["action"].isfinite().all()
    # The search had no time to tell where plans are: the next one starts as wide as this one.
    torch.testing.assert_close(out["next", "plan", "std"], torch.full((1, 3, A), 0.5))


def test_the_optimiser_ends_rows_one_by_one_at_the_best_so_far():
    torch.manual_seed(0)

    def score(actions, rows, restarts, iteration):
        value = -actions.square().sum((-1, -2))
        return PlanScores(value, torch.ones_like(value, dtype=torch.bool), value, enough=rows == iteration)

    low, high = torch.full((A,), -1.0), torch.full((A,), 1.0)
    result = CrossEntropyMethod(num_candidates=20, optim_steps=5)(score, low, high, batch=3, horizon=2)
    assert result.iterations.tolist() == [1, 2, 3]
    torch.testing.assert_close(result.score, -result.actions.square().sum((-1, -2)))


def test_the_filter_keeps_time_for_an_action_of_its_own(clock):
    torch.manual_seed(0)
    wall = classifier(ConstraintEstimator, slope=50.0, offset=1.0)
    td = TensorDict({"latent": torch.tensor([[0.5, 0.0, 0.0, 0.0]]), "action": torch.tensor([[1.0, 0.0]])}, [1])
    filtered = SafeSetFilter(None, stub_planner(constraint=wall, num_candidates=200, optim_steps=6, max_ms=65.0))(td)
    assert filtered["filter", "intervened"].all()
    assert filtered["filter", "feasible"].all()
    assert filtered["latent"][0, 0] + filtered["action"][0, 0] < 1.0
    # It looked at 10 and 20 ms and, after four rounds of plans that start with the action, at 60; at 70 it began to
    # search for others, and what it had kept for that was one round.
    assert clock.now == pytest.approx(0.08)


@pytest.mark.parametrize("max_ms", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_that_is_none_is_refused(max_ms):
    with pytest.raises(ValueError, match="max_ms must be a finite number above 0"):
        stub_planner(max_ms=max_ms)
