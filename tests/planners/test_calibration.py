"""Calibrated thresholds miss a chosen share of violations at most, whatever the estimators are worth."""

import math

import pytest
import torch
from stub_planners import A, D, classifier, random_planner, stub_planner
from tensordict import TensorDict

from ls3_torchrl.modules import ConstraintEstimator, SafeSet
from ls3_torchrl.planners import calibrate, conformal_threshold, foresee


@pytest.mark.parametrize("alpha", [0.01, 0.05, 0.1, 0.2, 0.5])
@pytest.mark.parametrize("n", [99, 100, 250])
def test_of_n_scores_the_kth_is_the_first_that_is_not_missed(alpha, n):
    scores = torch.rand(n)
    delta = conformal_threshold(scores[torch.randperm(n)], alpha)
    k = max(k for k in range(n + 1) if k <= alpha * (n + 1) + 1e-9)
    assert (scores <= delta).sum() == k - 1
    assert (scores <= delta + 1e-6).sum() >= k  # no larger one would do


@pytest.mark.parametrize("alpha", [0.05, 0.2])
@pytest.mark.parametrize("grid", [None, 4])  # with ties, too
def test_new_scores_are_missed_with_probability_alpha_at_most(alpha, grid):
    n, repetitions = 39, 4000
    scores = torch.rand(repetitions, n + 1, generator=torch.Generator().manual_seed(0))
    scores = scores if grid is None else (grid * scores).floor() / grid
    missed = [float(row[-1]) <= conformal_threshold(row[:-1], alpha) for row in scores]
    rate, spread = sum(missed) / repetitions, math.sqrt(alpha * (1 - alpha) / repetitions)
    assert rate <= alpha + 4 * spread
    assert grid is not None or rate >= alpha - 4 * spread  # α (n + 1) is whole: the bound is reached


@pytest.mark.parametrize(("alpha", "needed"), [(0.1, 9), (0.05, 19), (0.01, 99), (0.3, 3)])
def test_too_few_violations_are_refused_with_how_many_are_needed(alpha, needed):
    conformal_threshold(torch.rand(needed), alpha)
    with pytest.raises(ValueError, match=rf"alpha={alpha} needs {needed} violations at least, got {needed - 1}\."):
        conformal_threshold(torch.rand(needed - 1), alpha)


@pytest.mark.parametrize("alpha", [0.0, 1.0, -0.1, math.nan])
def test_a_level_that_is_none_is_refused(alpha):
    with pytest.raises(ValueError, match="alpha must lie between 0 and 1"):
        conformal_threshold(torch.rand(99), alpha)


def test_scores_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match=r"score.*not finite|finite"):
        conformal_threshold(torch.tensor([0.1, math.nan, 0.3]), 0.5)


def steps(x, action=0.0):
    latent = torch.zeros(len(x), D)
    latent[:, 0] = torch.tensor(x)
    return TensorDict({"latent": latent, "action": torch.full((len(x), A), action)}, [len(x)])


def test_what_is_foreseen_is_the_end_of_the_step_that_was_taken():
    planner = stub_planner(
        constraint=classifier(ConstraintEstimator, slope=5.0, offset=1.0), safe_set=classifier(SafeSet, slope=-3.0)
    )
    seen = foresee(planner, steps([0.0, 0.7, 2.0], action=0.5))
    ends = torch.tensor([0.5, 1.2, 2.5])
    torch.testing.assert_close(seen["constraint_prob"], (5.0 * (ends - 1.0)).sigmoid(), atol=1e-4, rtol=0)
    torch.testing.assert_close(seen["safe_set_prob"], (-3.0 * ends).sigmoid(), atol=1e-4, rtol=0)


def test_both_thresholds_are_calibrated_to_what_the_planner_foresees():
    constraint = classifier(ConstraintEstimator, slope=5.0, offset=1.0)
    planner = stub_planner(constraint=constraint, safe_set=classifier(SafeSet, slope=-3.0))
    before = planner.constraint_threshold, planner.safe_set_threshold
    x = torch.linspace(-1.0, 1.0, 19)
    found = calibrate(planner, steps(x.tolist()), alpha=0.1)
    assert (found.alpha, found.violations) == (0.1, 19)
    assert (planner.constraint_threshold, planner.safe_set_threshold) == before
    # Of 19 the second is the first that may not be missed: of f_C from the left, of f_S, which falls, as well.
    assert found.constraint_threshold == pytest.approx((5.0 * (x[1] - 1.0)).sigmoid().item(), rel=1e-3)
    assert found.safe_set_threshold == pytest.approx((-3.0 * x[1]).sigmoid().item(), rel=1e-3)


def test_a_planner_foresees_with_its_own_particles_and_noise():
    td = TensorDict({"latent": torch.randn(50, D), "action": torch.full((50, A), 1.0)}, [50])
    torch.manual_seed(0)
    many, one = (foresee(random_planner(num_particles=p), td)["constraint_prob"] for p in (12, 3))
    assert (many >= one).float().mean() > 0.6  # the worst of more particles
    still = foresee(random_planner(noise_scale=0.0), td)
    torch.testing.assert_close(still, foresee(random_planner(noise_scale=0.0), td))


def test_estimators_that_are_certain_of_the_contrary_are_refused():
    never = classifier(ConstraintEstimator, slope=1000.0, offset=1.0)
    with pytest.raises(
        ValueError, match=r"The constraint estimator is certain that some .* too many of them for alpha=0\.1"
    ):
        calibrate(stub_planner(constraint=never), steps([0.0] * 19), alpha=0.1)
    with pytest.raises(ValueError, match=r"The safe set is certain that some .* too many of them for alpha=0\.1"):
        calibrate(stub_planner(safe_set=classifier(SafeSet, slope=1000.0, offset=-1.0)), steps([0.0] * 19), alpha=0.1)


def test_actions_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="action"):
        foresee(stub_planner(), steps([0.0], action=math.inf))
