import pytest
import torch
from stub_planners import A, D, classifier, latents, stub_planner
from tensordict import TensorDict

from ls3_torchrl.modules import ConstraintEstimator, SafeSet
from ls3_torchrl.planners import CrossEntropyMethod, LS3Planner, Optimizer, OptimizerResult


class MPPI:
    """Model predictive path integral control, as TorchRL's MPPIPlanner: weights exp(temperature * score).

    The outcome is the weighted mean of the feasible candidates, not a candidate: it needs no elites, no uniform
    candidates and no first round. It shares nothing with the cross-entropy method.
    """

    uses_warm_start = True

    def __init__(self, num_candidates=400, optim_steps=12, temperature=2.0):
        self.num_candidates, self.optim_steps, self.temperature = num_candidates, optim_steps, temperature

    def max_iterations(self, max_restarts):
        return self.optim_steps + max_restarts

    def sample_noise(self, rows, horizon, action_dim):
        return (torch.randn(rows.numel(), self.num_candidates, horizon, action_dim, device=rows.device),)

    def __call__(self, score_plans, low, high, *, batch, horizon, max_restarts, mean=None, std=None, noise=None):
        shape, rows = (batch, horizon, len(low)), torch.arange(batch)
        mean = ((low + high) / 2).expand(shape) if mean is None else mean
        std = ((high - low) / 2).expand(shape) if std is None else std
        restarts, found = torch.zeros(batch, dtype=torch.long), torch.zeros(batch, dtype=torch.bool)
        iterations = self.max_iterations(max_restarts)
        for iteration in range(iterations):
            (normal,) = self.sample_noise(rows, *shape[1:]) if noise is None else noise(rows, iteration)
            actions = (mean[:, None] + std[:, None] * normal).clamp(low, high)
            scores = score_plans(actions, rows, restarts, iteration)
            feasible = scores.feasible.any(-1)
            ranking = scores.score.masked_fill(~scores.feasible, -torch.inf)
            ranking = torch.where(feasible[:, None], ranking, scores.fallback)
            weight = (self.temperature * ranking).softmax(-1)[..., None, None]
            mean = (weight * actions).sum(1)
            std = (weight * (actions - mean[:, None]).square()).sum(1).sqrt().clamp(min=0.1)
            restarts += ~feasible & (restarts < max_restarts)
            found |= feasible
        used = torch.full((batch,), iterations)
        return OptimizerResult(mean, ranking.amax(-1), mean, std, restarts, ~found, used)


def mppi_planner(optimizer=None, **options):
    return stub_planner(optimizer=MPPI() if optimizer is None else optimizer, max_relaxations=2, **options)


def warm_latents(*batch):
    return latents(*batch).update({"plan": {"mean": torch.zeros(*batch, 3, A), "std": torch.ones(*batch, 3, A)}})


def test_mppi_takes_the_place_of_the_cross_entropy_method():
    torch.manual_seed(0)
    planner = mppi_planner(value=(1.0, -1.0, 0.0, 0.0))
    assert type(planner) is LS3Planner
    out = planner(warm_latents(3, 2))
    torch.testing.assert_close(out["action"], torch.tensor([1.0, -1.0]).expand(3, 2, A), atol=0.15, rtol=0)
    assert out["plan", "feasible"].all()
    assert out["plan", "iterations"].unique().tolist() == [14]


def test_its_plans_keep_to_the_constraint_and_its_thresholds_are_relaxed_by_the_planner():
    torch.manual_seed(0)
    # V pulls to the right, where the constraint begins at x = 1; f_S = 0.7 needs one relaxation of 0.8.
    planner = mppi_planner(
        constraint=classifier(ConstraintEstimator, slope=50.0, offset=1.0), safe_set=classifier(SafeSet, prob=0.7)
    )
    start = torch.tensor([[0.5, 0.0, 0.0, 0.0]])
    path = 0.5 + planner.plan(start).actions[0, :, 0].cumsum(0)
    assert path.max() <= 0.973  # without the constraint it would end at 3.5
    assert path[-1] > 0.6
    warm = {"mean": torch.zeros(1, 3, A), "std": torch.ones(1, 3, A)}
    out = planner(TensorDict({"latent": start, "plan": warm}, [1]))
    assert out["plan", "safe_set_threshold"].item() == pytest.approx(0.64)
    assert out["plan", "relaxed"].all()


def test_its_plans_are_repeatable_too():
    planner = mppi_planner()
    noise = planner.sample_noise(2)
    assert [part.shape for part in noise.candidates] == [(14, 2, 400, 3, A)]
    assert noise.dynamics.shape == (14, 2, 3, 3, D)
    start = torch.zeros(2, D)
    before = torch.get_rng_state()
    one, two = (planner.plan(start, noise=noise).actions for _ in range(2))
    assert torch.equal(one, two)
    assert torch.equal(before, torch.get_rng_state())


def test_an_action_outside_the_box_never_leaves_the_planner():
    class Careless(MPPI):
        def __call__(self, *args, **kwargs):
            return super().__call__(*args, **kwargs)._replace(actions=torch.full((2, 3, A), 7.0))

    planner = mppi_planner(Careless())
    assert (planner(warm_latents(2))["action"] == 1.0).all()


def test_both_are_optimisers():
    assert isinstance(CrossEntropyMethod(), Optimizer)
    assert isinstance(MPPI(), Optimizer)


def test_what_is_no_optimiser_is_refused_with_what_it_lacks():
    class Half:
        num_candidates = 5

        def __call__(self):
            """Nothing."""

    with pytest.raises(TypeError, match="Half lacks uses_warm_start, max_iterations, sample_noise"):
        mppi_planner(Half())


def test_settings_of_the_optimiser_belong_to_it():
    cem = CrossEntropyMethod(num_candidates=20, num_elites=3)
    assert stub_planner(optimizer=cem).optimizer is cem
    model = stub_planner()
    parts = model.env, model.value, model.safe_set
    # Without one, they make the cross-entropy method: a flat set of settings is enough for a configuration.
    made = LS3Planner(*parts, horizon=2, num_candidates=20, num_elites=3, p_random=0.25).optimizer
    assert (made.num_candidates, made.num_elites, made.p_random, made.optim_steps) == (20, 3, 0.25, 4)
    assert LS3Planner(*parts).optimizer.num_candidates == 1000
    with pytest.raises(TypeError, match="num_elites are settings of the optimiser: give them to CrossEntropyMethod"):
        LS3Planner(*parts, optimizer=cem, num_elites=3)
    with pytest.raises(
        TypeError, match=r"no setting depth, tempo\. Its own are .*horizon.*CrossEntropyMethod, are num_c"
    ):
        LS3Planner(*parts, depth=3, tempo=1)


def test_names_of_both_constructors_do_not_collide():
    import inspect

    own, other = (set(inspect.signature(kind).parameters) for kind in (LS3Planner, CrossEntropyMethod))
    assert not own & other
