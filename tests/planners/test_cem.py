import numpy as np
import pytest
import torch

from ls3_torchrl.planners import CrossEntropyMethod, PlanScores

LOW, HIGH = torch.tensor([-3.0, 0.5]), torch.tensor([-1.0, 2.0])


def quadratic(target):
    def score_plans(actions, rows, restarts, iteration):
        score = -(actions - torch.as_tensor(target)).square().sum((-1, -2))
        return PlanScores(score, torch.ones_like(score, dtype=torch.bool), score)

    return score_plans


class Record:
    """Passes scores on and remembers everything that was asked."""

    def __init__(self, score_plans):
        self.score_plans, self.asked = score_plans, []

    def __call__(self, actions, rows, restarts, iteration):
        scores = self.score_plans(actions, rows, restarts, iteration)
        self.asked.append((actions.clone(), rows.clone(), restarts.clone(), iteration, scores))
        return scores


def table(batch, cem, horizon, action_dim=2, seed=0, max_restarts=5):
    """Noise that depends on row and iteration alone, whatever else is asked for."""
    generator = torch.Generator().manual_seed(seed)
    shape = (cem.max_iterations(max_restarts), batch, cem.num_candidates, horizon, action_dim)
    normal, uniform = torch.randn(shape, generator=generator), torch.rand(shape, generator=generator)
    return normal, uniform, lambda rows, iteration: (normal[iteration][rows], uniform[iteration][rows])


def test_finds_the_optimum_inside_the_box():
    torch.manual_seed(0)
    cem = CrossEntropyMethod(num_candidates=200, num_elites=20, optim_steps=10)
    result = cem(quadratic([-2.4, 1.1]), LOW, HIGH, batch=2, horizon=3)
    assert (result.actions - torch.tensor([-2.4, 1.1])).abs().max() < 0.05
    assert (result.mean - torch.tensor([-2.4, 1.1])).abs().max() < 0.05
    assert not result.fallback.any()


def test_finds_an_optimum_at_a_corner_of_asymmetric_bounds():
    torch.manual_seed(0)
    cem = CrossEntropyMethod(num_candidates=200, num_elites=20, optim_steps=10)
    result = cem(quadratic([5.0, -5.0]), LOW, HIGH, batch=2, horizon=3)
    assert (result.actions - torch.tensor([-1.0, 0.5])).abs().max() < 0.02


@pytest.mark.parametrize("p_random", [0.0, 0.4, 1.0])
def test_every_candidate_and_result_lies_in_the_box(p_random):
    torch.manual_seed(0)
    cem = CrossEntropyMethod(num_candidates=60, num_elites=5, optim_steps=4, p_random=p_random)
    record = Record(quadratic([9.0, 9.0]))
    # The warm start lies far out.
    start = torch.full((2, 3, 2), 10.0)
    result = cem(record, LOW, HIGH, batch=2, horizon=3, mean=start, std=start)
    for values in (*(actions for actions, *_ in record.asked), result.actions, result.mean):
        assert (values >= LOW).all()
        assert (values <= HIGH).all()


def test_one_elite_refits_on_the_best_alone():
    torch.manual_seed(0)
    cem = CrossEntropyMethod(num_candidates=50, num_elites=1, optim_steps=3)
    record = Record(quadratic([-2.0, 1.0]))
    result = cem(record, LOW, HIGH, batch=1, horizon=2)
    actions, *_, scores = record.asked[0]
    torch.testing.assert_close(result.actions[0], actions[0, scores.score[0].argmax()])
    torch.testing.assert_close(result.mean, result.actions)
    assert (result.std == 0).all()
    # Without any spread the later rounds repeat it.
    assert (record.asked[2][0] == result.actions[:, None]).all()


def test_elites_refit_by_hand():
    torch.manual_seed(0)
    cem = CrossEntropyMethod(num_candidates=30, num_elites=4, optim_steps=1)
    record = Record(quadratic([-2.0, 1.0]))
    result = cem(record, LOW, HIGH, batch=2, horizon=2)
    actions, *_, scores = record.asked[0]
    for row in range(2):
        elite = actions[row, scores.score[row].argsort(descending=True)[:4]]
        torch.testing.assert_close(result.mean[row], elite.mean(0))
        torch.testing.assert_close(result.std[row], elite.std(0, correction=0))


def test_elites_come_from_feasible_candidates_even_if_they_are_few():
    torch.manual_seed(0)

    def three_bad_ones(actions, rows, restarts, iteration):
        score = -torch.arange(10.0).expand(1, -1)  # the infeasible ones score best
        return PlanScores(score, torch.arange(10).expand(1, -1) >= 7, score)

    record = Record(three_bad_ones)
    result = CrossEntropyMethod(num_candidates=10, num_elites=5, optim_steps=1)(record, LOW, HIGH, batch=1, horizon=2)
    few = record.asked[0][0][0, 7:]
    torch.testing.assert_close(result.mean[0], few.mean(0))
    torch.testing.assert_close(result.std[0], few.std(0, correction=0))
    assert torch.equal(result.actions[0], few[0])
    assert result.score.tolist() == [-7.0]
    assert not result.fallback


def test_nan_ranks_last():
    torch.manual_seed(0)

    def mostly_nan(actions, rows, restarts, iteration):
        score = torch.full((1, 10), torch.nan)
        score[0, 3], score[0, 8] = -50.0, -60.0
        return PlanScores(score, torch.ones(1, 10, dtype=torch.bool), torch.zeros(1, 10))

    record = Record(mostly_nan)
    result = CrossEntropyMethod(num_candidates=10, num_elites=5, optim_steps=1)(record, LOW, HIGH, batch=1, horizon=2)
    actions = record.asked[0][0][0]
    assert torch.equal(result.actions[0], actions[3])
    torch.testing.assert_close(result.mean[0], actions[[3, 8]].mean(0))


@pytest.mark.parametrize("worthless", [torch.nan, -torch.inf])
def test_scores_that_rank_nothing_count_as_infeasible_and_never_leave_the_box(worthless):
    torch.manual_seed(0)

    def score_plans(actions, rows, restarts, iteration):
        score = torch.full((1, 10), worthless)
        fallback = torch.full((1, 10), torch.nan)
        fallback[0, 4] = -1e6
        return PlanScores(score, torch.ones(1, 10, dtype=torch.bool), fallback)

    record = Record(score_plans)
    cem = CrossEntropyMethod(num_candidates=10, num_elites=5, optim_steps=2)
    result = cem(record, LOW, HIGH, batch=1, horizon=2, max_restarts=1)
    assert result.fallback.tolist() == [True]
    # The only candidate with a ranking wins over those without; the first of those that rank alike stays.
    assert torch.equal(result.actions[0], record.asked[0][0][0, 4])
    assert result.mean.isfinite().all()
    assert result.std.isfinite().all()


@pytest.mark.parametrize("max_restarts", [0, 1, 3])
def test_nothing_feasible_restarts_and_then_takes_the_best_fallback(max_restarts):
    torch.manual_seed(0)

    def never(actions, rows, restarts, iteration):
        ranking = actions[..., 0].sum(-1)
        return PlanScores(-ranking, torch.zeros_like(ranking, dtype=torch.bool), ranking)

    record = Record(never)
    cem = CrossEntropyMethod(num_candidates=20, num_elites=5, optim_steps=3)
    result = cem(record, LOW, HIGH, batch=2, horizon=2, max_restarts=max_restarts)
    assert result.fallback.tolist() == [True, True]
    assert result.restarts.tolist() == [max_restarts] * 2
    assert result.iterations.tolist() == [max_restarts + 1] * 2
    assert [asked[2].tolist() for asked in record.asked] == [[k, k] for k in range(max_restarts + 1)]
    actions = torch.cat([asked[0] for asked in record.asked], 1)
    ranking = torch.cat([asked[-1].fallback for asked in record.asked], 1)
    for row in range(2):
        best = ranking[row].argmax()
        assert torch.equal(result.actions[row], actions[row, best])
        assert result.score[row] == ranking[row, best]


def test_rows_that_need_no_restart_refit_on_the_best_of_what_is_not_feasible():
    torch.manual_seed(0)

    def never(actions, rows, restarts, iteration):
        score = torch.zeros(len(rows), 20)
        ranking = -(actions + 2).square().sum((-1, -2))
        return PlanScores(score, torch.zeros_like(score, dtype=torch.bool), ranking, torch.tensor([True, False])[rows])

    record = Record(never)
    cem = CrossEntropyMethod(num_candidates=20, num_elites=5, optim_steps=3)
    result = cem(record, LOW, HIGH, batch=2, horizon=2, max_restarts=1)
    assert result.restarts.tolist() == [1, 0]
    assert result.iterations.tolist() == [2, 3]
    assert result.fallback.tolist() == [True, True]
    populations = [(asked[0][asked[1] == 1], asked[-1].fallback[asked[1] == 1]) for asked in record.asked]
    best = max(float(ranking.max()) for _, ranking in populations)
    assert result.score[1] == best
    last, ranking = populations[-1]
    elites = last[0, ranking[0].topk(5).indices]
    torch.testing.assert_close(result.mean[1], elites.mean(0))
    torch.testing.assert_close(result.std[1], elites.std(0, correction=0))


def test_a_feasible_sequence_goes_before_a_higher_fallback_of_an_earlier_round():
    torch.manual_seed(0)

    def only_at_last(actions, rows, restarts, iteration):
        score = actions[..., 0].sum(-1) - 1e3
        return PlanScores(
            score,
            torch.full_like(score, iteration == 1, dtype=torch.bool),
            torch.zeros_like(score),
            torch.zeros(1, dtype=torch.bool),
        )

    record = Record(only_at_last)
    cem = CrossEntropyMethod(num_candidates=20, num_elites=5, optim_steps=3)
    result = cem(record, LOW, HIGH, batch=1, horizon=2)
    assert result.fallback.tolist() == [False]
    assert result.restarts.tolist() == [0]
    actions, *_, scores = record.asked[1]
    assert torch.equal(result.actions[0], actions[0, scores.score[0].argmax()])


@pytest.mark.parametrize("k", [1, 2, 4])
def test_feasible_only_after_k_restarts(k):
    torch.manual_seed(0)

    def later(actions, rows, restarts, iteration):
        score = -(actions + 2).square().sum((-1, -2))
        return PlanScores(score, (restarts >= k)[:, None].expand_as(score), score)

    cem = CrossEntropyMethod(num_candidates=20, num_elites=5, optim_steps=3)
    result = cem(later, LOW, HIGH, batch=1, horizon=2, max_restarts=4)
    assert result.restarts.tolist() == [k]
    assert result.iterations.tolist() == [k + 3]  # the failed ones, then all rounds
    assert result.fallback.tolist() == [False]


def test_a_restart_begins_again_from_the_given_gaussian():
    # Feasible at first, nothing in the second round, feasible again after the restart.
    def score_plans(actions, rows, restarts, iteration):
        score = actions[..., 0].sum(-1)
        return PlanScores(score, torch.full_like(score, iteration != 1, dtype=torch.bool), score)

    cem = CrossEntropyMethod(num_candidates=10, num_elites=2, optim_steps=2, p_random=0.0)
    normal, _, noise = table(1, cem, 2)
    record = Record(score_plans)
    mean = torch.tensor([-2.0, 1.2]).expand(1, 2, 2)
    std = torch.full((1, 2, 2), 0.1)
    result = cem(record, LOW, HIGH, batch=1, horizon=2, max_restarts=2, mean=mean, std=std, noise=noise)
    assert result.restarts.tolist() == [1]
    assert result.iterations.tolist() == [4]
    torch.testing.assert_close(record.asked[2][0], (mean[:, None] + 0.1 * normal[2]).clamp(LOW, HIGH))
    refitted = record.asked[3][0]
    assert not torch.allclose(refitted, (mean[:, None] + 0.1 * normal[3]).clamp(LOW, HIGH))


def test_a_feasible_sequence_of_an_earlier_round_beats_a_fallback():
    torch.manual_seed(0)

    def only_at_first(actions, rows, restarts, iteration):
        score = actions[..., 0].sum(-1)
        return PlanScores(score, torch.full_like(score, iteration == 0, dtype=torch.bool), -score)

    record = Record(only_at_first)
    cem = CrossEntropyMethod(num_candidates=20, num_elites=5, optim_steps=3)
    result = cem(record, LOW, HIGH, batch=1, horizon=2, max_restarts=1)
    assert result.fallback.tolist() == [False]
    actions, *_, scores = record.asked[0]
    assert torch.equal(result.actions[0], actions[0, scores.score[0].argmax()])
    assert result.score[0] == scores.score.max()


def test_rows_are_independent():
    # Row 0 is easy, row 1 restarts twice, row 2 never succeeds: all are at different rounds at the same time.
    needs = torch.tensor([0, 2, 99])
    targets = torch.tensor([[-2.4, 1.1], [-1.2, 0.6], [-2.9, 1.9]])

    def score_plans_of(which):
        def score_plans(actions, rows, restarts, iteration):
            row = which[rows]
            score = -(actions - targets[row][:, None, None]).square().sum((-1, -2))
            return PlanScores(score, (restarts >= needs[row])[:, None].expand_as(score), 2 * score)

        return score_plans

    cem = CrossEntropyMethod(num_candidates=40, num_elites=5, optim_steps=3, p_random=0.5)
    normal, uniform, noise = table(3, cem, 2)
    start = {"mean": torch.tensor([-2.0, 1.0]) + 0.1 * torch.randn(3, 2, 2), "std": 0.3 * torch.rand(3, 2, 2)}
    options = {"horizon": 2, "max_restarts": 3}
    together = cem(score_plans_of(torch.arange(3)), LOW, HIGH, batch=3, noise=noise, **options, **start)
    assert together.iterations.tolist() == [3, 5, 4]
    for i in range(3):
        alone = cem(
            score_plans_of(torch.tensor([i])),
            LOW,
            HIGH,
            batch=1,
            noise=lambda rows, k, i=i: (normal[k, i : i + 1], uniform[k, i : i + 1]),
            **options,
            **{name: value[i : i + 1] for name, value in start.items()},
        )
        for name in together._fields:
            torch.testing.assert_close(getattr(together, name)[i : i + 1], getattr(alone, name), msg=name)


@pytest.mark.parametrize(("p_random", "expected"), [(0.0, 0), (0.3, 3), (0.96, 10), (1.0, 10)])
def test_p_random_shares_the_first_round_between_box_and_warm_start(p_random, expected):
    cem = CrossEntropyMethod(num_candidates=10, num_elites=2, optim_steps=2, p_random=p_random)
    record = Record(quadratic([-2.0, 1.0]))
    warm = torch.tensor([-1.5, 1.5]).expand(1, 2, 2)
    # Without normal noise whatever is not uniform sits exactly at the mean.
    _, uniform, _ = table(1, cem, 2)
    noise = lambda rows, k: (torch.zeros(1, 10, 2, 2), uniform[k])  # noqa: E731
    result = cem(record, LOW, HIGH, batch=1, horizon=2, mean=warm, std=warm.abs(), noise=noise)
    first, second = record.asked[0][0][0], record.asked[1][0][0]
    at_warm = (first == warm).all(-1).all(-1)
    assert int((~at_warm).sum()) == expected
    torch.testing.assert_close(first[:expected], LOW + (HIGH - LOW) * uniform[0, 0, :expected])
    # Later rounds are the refitted Gaussian alone.
    assert (second == second[:1]).all()
    assert result.iterations.tolist() == [2]


def test_held_candidates_repeat_their_first_uniform_action_in_the_first_round_alone():
    cem = CrossEntropyMethod(num_candidates=10, num_elites=2, optim_steps=2, p_random=0.3, p_constant=0.4)
    record = Record(quadratic([-2.0, 1.0]))
    normal, uniform, noise = table(2, cem, 3)
    kept = uniform.clone()
    cem(record, LOW, HIGH, batch=2, horizon=3, noise=noise)
    first, second = record.asked[0][0], record.asked[1][0]
    box = LOW + (HIGH - LOW) * uniform[0]
    torch.testing.assert_close(first[:, :3], box[:, :3])
    torch.testing.assert_close(first[:, 3:7], box[:, 3:7, :1].expand(-1, -1, 3, -1))
    middle, quarter = (LOW + HIGH) / 2, (HIGH - LOW) / 4
    torch.testing.assert_close(first[:, 7:], (middle + quarter * normal[0, :, 7:]).clamp(LOW, HIGH))
    assert not (second[:, :, 0] == second[:, :, 1]).all(-1).any()
    assert torch.equal(uniform, kept)


def test_held_candidates_find_what_must_be_kept_up():
    # Only sequences that go up at nearly full speed at every step score: independent draws hardly ever do.
    def score_plans(actions, rows, restarts, iteration):
        score = torch.where((actions[..., 0] > 0.8).all(-1), 1.0, 0.0)
        return PlanScores(score, torch.ones_like(score, dtype=torch.bool), score)

    box = torch.tensor([-1.0]), torch.tensor([1.0])
    settings = {"num_candidates": 100, "num_elites": 10, "optim_steps": 1}
    found = []
    for p_constant in (0.0, 0.5):
        torch.manual_seed(0)
        cem = CrossEntropyMethod(p_random=0.5, p_constant=p_constant, **settings)
        found.append(cem(score_plans, *box, batch=50, horizon=5).score.mean().item())
    assert found[0] < 0.1
    assert found[1] > 0.9


def test_without_a_start_the_gaussian_covers_the_box():
    cem = CrossEntropyMethod(num_candidates=10, num_elites=2, optim_steps=1, p_random=0.0)
    normal, _, noise = table(1, cem, 2)
    record = Record(quadratic([-2.0, 1.0]))
    cem(record, LOW, HIGH, batch=1, horizon=2, noise=noise)
    middle, quarter = torch.tensor([-2.0, 1.25]), torch.tensor([0.5, 0.375])
    torch.testing.assert_close(record.asked[0][0], (middle + quarter * normal[0]).clamp(LOW, HIGH))


def test_every_iteration_is_scored_and_the_result_is_one_of_them():
    torch.manual_seed(0)
    cem = CrossEntropyMethod(num_candidates=30, num_elites=5, optim_steps=4)
    record, drawn = Record(quadratic([-2.0, 1.0])), []

    def noise(rows, iteration):
        drawn.append(iteration)
        return cem.sample_noise(rows, 2, 2)

    result = cem(record, LOW, HIGH, batch=3, horizon=2, noise=noise)
    assert drawn == [asked[3] for asked in record.asked] == [0, 1, 2, 3]
    assert result.iterations.tolist() == [4, 4, 4]
    scores = torch.stack([asked[-1].score for asked in record.asked])  # [K, B, N]
    torch.testing.assert_close(result.score, scores.amax((0, 2)))
    for row in range(3):
        seen = torch.cat([asked[0][row] for asked in record.asked])
        assert (seen == result.actions[row]).all(-1).all(-1).any()


def test_the_best_of_all_rounds_is_kept_not_of_the_last():
    torch.manual_seed(0)

    def ever_worse(actions, rows, restarts, iteration):
        score = actions[..., 0].sum(-1) - 100.0 * iteration
        return PlanScores(score, torch.ones_like(score, dtype=torch.bool), score)

    record = Record(ever_worse)
    result = CrossEntropyMethod(num_candidates=20, num_elites=5, optim_steps=3)(record, LOW, HIGH, batch=1, horizon=2)
    actions, *_, scores = record.asked[0]
    assert torch.equal(result.actions[0], actions[0, scores.score[0].argmax()])
    assert result.score[0] == scores.score.max()


def test_finished_rows_are_not_scored_any_more():
    torch.manual_seed(0)

    def score_plans(actions, rows, restarts, iteration):
        score = actions[..., 0].sum(-1)
        return PlanScores(score, ((rows == 0) | (restarts >= 1))[:, None].expand_as(score), score)

    record = Record(score_plans)
    cem = CrossEntropyMethod(num_candidates=10, num_elites=2, optim_steps=2)
    result = cem(record, LOW, HIGH, batch=2, horizon=1, max_restarts=1)
    assert [asked[1].tolist() for asked in record.asked] == [[0, 1], [0, 1], [1]]
    assert result.iterations.tolist() == [2, 3]


def test_a_negative_number_of_restarts_is_refused():
    cem = CrossEntropyMethod(num_candidates=10, num_elites=2)
    with pytest.raises(ValueError, match="max_restarts must be at least 0, got -1"):
        cem(quadratic([-2.0, 1.0]), LOW, HIGH, batch=1, horizon=1, max_restarts=-1)


@pytest.mark.parametrize(("candidates", "elites"), [(1000, 100), (2000, 200), (25, 2), (5, 1), (np.int64(30), 3)])
def test_a_tenth_of_the_candidates_are_elites(candidates, elites):
    found = CrossEntropyMethod(num_candidates=candidates).num_elites
    assert (found, type(found)) == (elites, int)


def test_the_defaults_are_the_papers():
    cem = CrossEntropyMethod()
    settings = (cem.num_candidates, cem.num_elites, cem.optim_steps, cem.p_random, cem.p_constant)
    assert settings == (1000, 100, 4, 1.0, 0.0)  # Table 1; n_cem_iters = 5 scores four
    assert not cem.uses_warm_start


@pytest.mark.parametrize(
    ("p_random", "p_constant", "uses"), [(1.0, 0.0, False), (0.5, 0.0, True), (0.5, 0.5, False), (0.99, 0.0, False)]
)
def test_a_warm_start_is_used_where_a_candidate_is_drawn_from_it(p_random, p_constant, uses):
    cem = CrossEntropyMethod(num_candidates=10, num_elites=2, p_random=p_random, p_constant=p_constant)
    assert cem.uses_warm_start is uses
    record = Record(quadratic([-2.0, 1.0]))
    noise = table(1, cem, 2)[-1]
    for start in (-2.9, -1.1):
        cem(record, LOW, HIGH, batch=1, horizon=2, mean=torch.full((1, 2, 2), start), noise=noise)
    first = [asked[0] for asked in record.asked if asked[3] == 0]
    assert torch.equal(*first) is not uses


def test_no_rows_need_no_scores():
    cem = CrossEntropyMethod(num_candidates=10, num_elites=2)
    result = cem(None, LOW, HIGH, batch=0, horizon=3)
    assert result.actions.shape == result.mean.shape == result.std.shape == (0, 3, 2)
    assert result.score.shape == result.fallback.shape == result.iterations.shape == (0,)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_bounds_scores_and_starts_of_any_floating_dtype_are_searched_in_float32(dtype):
    def score_plans(actions, rows, restarts, iteration):
        assert actions.dtype == torch.float32
        score = -(actions + 2).square().sum((-1, -2)).to(dtype)
        return PlanScores(score, (score > -2.0) & (restarts[:, None] > 0), score)

    cem = CrossEntropyMethod(num_candidates=50, num_elites=5, p_random=0.5)
    start = torch.full((2, 3, 2), -1.5, dtype=dtype)
    torch.manual_seed(0)
    result = cem(score_plans, LOW.to(dtype), HIGH.to(dtype), batch=2, horizon=3, max_restarts=1, mean=start)
    assert result.actions.dtype == result.mean.dtype == result.score.dtype == torch.float32


def test_the_given_start_is_left_as_it_was():
    torch.manual_seed(0)
    mean, std = torch.full((1, 2, 2), -1.5), torch.full((1, 2, 2), 0.2)
    cem = CrossEntropyMethod(num_candidates=10, num_elites=2, optim_steps=2)
    cem(quadratic([-2.0, 1.0]), LOW, HIGH, batch=1, horizon=2, mean=mean, std=std)
    assert (mean == -1.5).all()
    assert (std == 0.2).all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_candidates": 0}, "num_candidates must be at least 1"),
        ({"num_elites": 0}, "num_elites must lie between 1 and num_candidates = 10, got 0"),
        ({"num_elites": 11}, "num_elites must lie between 1 and num_candidates = 10, got 11"),
        ({"optim_steps": 0}, "optim_steps must be at least 1"),
        ({"p_random": 1.1}, r"p_random must lie in \[0, 1\]"),
        ({"p_random": -0.1}, r"p_random must lie in \[0, 1\]"),
        ({"p_constant": -0.1}, r"p_constant must lie in \[0, 1\]"),
        ({"p_random": 0.6, "p_constant": 0.5}, "together they must not exceed 1"),
    ],
)
def test_settings_out_of_range_are_refused(wrong, message):
    settings = {"num_candidates": 10, "num_elites": 2, "optim_steps": 2} | wrong
    with pytest.raises(ValueError, match=message):
        CrossEntropyMethod(**settings)
