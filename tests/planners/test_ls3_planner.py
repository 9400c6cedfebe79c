import pytest
import torch
from stub_planners import SMALL, A, D, classifier, latents, random_planner, still, stub_planner
from tensordict import TensorDict
from tensordict.nn import InteractionType, TensorDictModule, set_interaction_type
from torch import nn
from torchrl.data import Bounded

from ls3_torchrl.modules import ConstraintEstimator, GoalEstimator, PixelEncoder, SafeSet
from ls3_torchrl.planners import FusedImagination, LatentEnv, LS3Planner, RolloutImagination


def assert_in_box(action, spec):
    assert (action >= spec.space.low - 1e-6).all()
    assert (action <= spec.space.high + 1e-6).all()


# --- what is optimised, and within what -----------------------------------------------------------------------


def test_the_plan_maximises_value():
    torch.manual_seed(0)
    planner = stub_planner(value=(1.0, -1.0, 0.0, 0.0), num_candidates=300, num_elites=10, optim_steps=6)
    out = planner(latents(2))
    torch.testing.assert_close(out["action"], torch.tensor([[1.0, -1.0]] * 2), atol=0.05, rtol=0)
    assert out["plan", "feasible"].all()
    assert not out["plan", "fallback"].any()
    torch.testing.assert_close(out["plan", "safe_set_threshold"], torch.full((2, 1), 0.8))


def test_every_imagined_step_in_the_goal_counts_one():
    torch.manual_seed(0)
    # The first of three steps can already reach the goal set at x > 0.5 from x = 0; the value is the same everywhere.
    planner = stub_planner(
        value=(0.0,) * 4, goal=classifier(GoalEstimator, slope=100.0, offset=0.5), num_candidates=200
    )
    out = planner(TensorDict({"latent": torch.zeros(1, D)}, [1]))
    assert out["plan", "score"].item() == 3.0
    assert out["action"][0, 0] > 0.5


def test_plans_stop_short_of_the_constraint():
    torch.manual_seed(0)
    # V pulls to the right, where the constraint begins at x = 1: f_C ≤ 0.2 needs x ≤ 1 - log(4) / 50 = 0.972.
    planner = stub_planner(
        constraint=classifier(ConstraintEstimator, slope=50.0, offset=1.0),
        num_candidates=300,
        num_elites=10,
        optim_steps=6,
    )
    result = planner.plan(torch.tensor([[0.5, 0.0, 0.0, 0.0]]))
    path = 0.5 + result.actions[0, :, 0].cumsum(0)
    assert path.max() <= 0.973
    assert path.max() > 0.9
    assert not result.fallback


def test_only_the_end_of_a_plan_must_be_safe():
    torch.manual_seed(0)
    # Safe (≥ 0.8) for x ≤ 1 - log(4) / 50; the goal further right pays for every step there but the last.
    planner = stub_planner(
        value=(0.0,) * 4,
        goal=classifier(GoalEstimator, slope=50.0, offset=1.2),
        safe_set=classifier(SafeSet, slope=-50.0, offset=1.0),
        num_candidates=300,
        num_elites=10,
        optim_steps=6,
    )
    result = planner.plan(torch.tensor([[0.9, 0.0, 0.0, 0.0]]))
    path = 0.9 + result.actions[0, :, 0].cumsum(0)
    assert path[-1] <= 0.973
    assert result.score.item() == 2.0
    assert (path[:2] > 1.2).all()


def test_actions_lie_within_asymmetric_bounds_and_reach_them():
    torch.manual_seed(0)
    spec = Bounded(low=torch.tensor([0.2, -3.0]), high=torch.tensor([0.5, -1.0]), shape=(A,))
    planner = stub_planner(spec=spec, value=(-1.0, 1.0, 0.0, 0.0), num_candidates=200, num_elites=10, optim_steps=6)
    action = planner(latents(5))["action"]
    assert_in_box(action, spec)
    torch.testing.assert_close(action, torch.tensor([[0.2, -1.0]] * 5), atol=0.03, rtol=0)


def test_one_elite_and_one_round_is_random_shooting():
    planner = stub_planner(num_elites=1, optim_steps=1)
    noise = planner.sample_noise(2)
    out = planner(TensorDict({"latent": torch.zeros(2, D)}, [2]), noise=noise)
    candidates = -1 + 2 * noise.candidates[1][0]  # [B, N, H, A]
    best = candidates[..., 0].sum(-1).argmax(-1)
    torch.testing.assert_close(out["action"], candidates[torch.arange(2), best, 0])


# --- relaxing the safe set ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("prob", "k"), [(0.9, 0), (0.7, 1), (0.6, 2), (0.45, 3), (0.3, 5)])
def test_the_threshold_is_relaxed_as_often_as_needed_and_no_further(prob, k):
    planner = stub_planner(safe_set=classifier(SafeSet, prob=prob))
    out = planner(latents(1))
    # 0.8, 0.64, 0.512, 0.4096, 0.32768, 0.262144
    assert out["plan", "safe_set_threshold"].item() == pytest.approx(0.8 * 0.8**k)
    assert out["plan", "iterations"].item() == k + SMALL["optim_steps"]
    assert not out["plan", "fallback"].any()


@pytest.mark.parametrize("engine", ["fused", "rollout"])
def test_without_a_constraint_threshold_plans_go_wherever_the_value_is(engine):
    wall = classifier(ConstraintEstimator, slope=40.0, offset=0.5)  # everything beyond 0.5 violates
    torch.manual_seed(0)
    kept = stub_planner(constraint=wall, constraint_threshold=0.2, engine=engine)(latents(1))
    torch.manual_seed(0)
    free = stub_planner(constraint=wall, constraint_threshold=None, engine=engine)(latents(1))
    assert kept["action"][0, 0] < 0.5 < free["action"][0, 0]
    assert free["plan", "feasible"].all()


@pytest.mark.parametrize("engine", ["fused", "rollout"])
def test_without_a_safe_set_threshold_plans_end_anywhere_and_are_not_relaxed(engine):
    nowhere = classifier(SafeSet, prob=0.001)
    planner = stub_planner(safe_set=nowhere, safe_set_threshold=None, engine=engine)
    out = planner(latents(2))
    assert out["plan", "feasible"].all()
    assert not out["plan", "relaxed"].any()
    assert (out["plan", "safe_set_threshold"] == 0.0).all()
    assert (out["plan", "iterations"] == planner.optimizer.optim_steps).all()
    blocked = stub_planner(constraint=classifier(ConstraintEstimator, prob=0.9), safe_set_threshold=None, engine=engine)
    out = blocked(latents(1))
    assert out["plan", "fallback"].all()
    assert not out["plan", "relaxed"].any()  # a lower threshold of nothing would change nothing


def test_each_row_relaxes_for_itself():
    # f_S depends on z_2, which no action moves: 0.9, 0.7 and 0.45 for the three rows.
    safe_set = classifier(SafeSet, slope=1.0, offset=0.0, axis=2)
    start = torch.zeros(3, D)
    start[:, 2] = torch.tensor([0.9, 0.7, 0.45]).logit()
    out = stub_planner(safe_set=safe_set)(TensorDict({"latent": start}, [3]))
    expected = torch.tensor([0.8, 0.8 * 0.8, 0.8 * 0.8**3])
    torch.testing.assert_close(out["plan", "safe_set_threshold"].flatten(), expected)
    assert out["plan", "iterations"].flatten().tolist() == [2, 3, 5]


def test_relaxation_and_its_limit_are_settings():
    planner = stub_planner(
        safe_set=classifier(SafeSet, prob=0.2), safe_set_threshold=0.6, relaxation=0.5, max_relaxations=1
    )
    out = planner(latents(1))
    assert out["plan", "safe_set_threshold"].item() == pytest.approx(0.3)
    assert out["plan", "fallback"].all()
    assert not out["plan", "feasible"].any()


@pytest.mark.parametrize("engine", ["fused", "rollout"])
def test_without_a_feasible_plan_the_least_harmful_is_taken_not_a_random_one(engine):
    # Violating everywhere; the end is the safer the further right: the best of all populations is known.
    planner = stub_planner(
        constraint=classifier(ConstraintEstimator, prob=0.9),
        safe_set=classifier(SafeSet, slope=0.5, offset=4.0),
        value=(-1.0, 0.0, 0.0, 0.0),  # the value would pull the other way
        max_relaxations=2,
        engine=engine,
    )
    noise = planner.sample_noise(2)
    out = planner(TensorDict({"latent": torch.zeros(2, D)}, [2]), noise=noise)
    assert out["plan", "fallback"].all()
    assert not out["plan", "feasible"].any()
    assert out["plan", "iterations"].flatten().tolist() == [3, 3]
    torch.testing.assert_close(out["plan", "safe_set_threshold"], torch.full((2, 1), 0.8 * 0.8**2))
    candidates = -1 + 2 * torch.cat(list(noise.candidates[1][:3]), 1)
    best = candidates[..., 0].sum(-1).argmax(-1)
    torch.testing.assert_close(out["action"], candidates[torch.arange(2), best, 0])
    assert_in_box(out["action"], planner.action_spec)


@pytest.mark.parametrize("engine", ["fused", "rollout"])
def test_safe_ends_that_only_violations_reach_relax_nothing(engine):
    planner = stub_planner(
        constraint=classifier(ConstraintEstimator, prob=0.9), safe_set=classifier(SafeSet, prob=0.9), engine=engine
    )
    out = planner(latents(1))
    assert out["plan", "safe_set_threshold"].item() == pytest.approx(0.8)
    assert out["plan", "iterations"].item() == SMALL["optim_steps"]
    assert out["plan", "fallback"].all()
    assert not out["plan", "relaxed"].any()


def test_a_fallback_prefers_fewer_violations_to_a_safer_end():
    torch.manual_seed(0)
    # Right of x = 1 violates, but only there lies the safe set, and the start is inside the violation.
    planner = stub_planner(
        constraint=classifier(ConstraintEstimator, slope=100.0, offset=1.0),
        safe_set=classifier(SafeSet, slope=2.0, offset=6.0),
        num_candidates=300,
        max_relaxations=0,
    )
    result = planner.plan(torch.tensor([[2.5, 0.0, 0.0, 0.0]]))
    path = 2.5 + result.actions[0, :, 0].cumsum(0)
    assert result.fallback.all()
    # One step at least is lost; the second can be out of it.
    assert (path > 1.0).int().tolist() == [1, 0, 0]


# --- engines, rows and repeatability --------------------------------------------------------------------------


def test_both_engines_pick_the_same_actions():
    fused, plain = (random_planner(engine=engine, constraint_threshold=0.6) for engine in ("fused", "rollout"))
    assert isinstance(fused.imagine, FusedImagination)
    assert isinstance(plain.imagine, RolloutImagination)
    noise = fused.sample_noise(4)
    one, other = (planner(latents(4), noise=noise) for planner in (fused, plain))
    torch.testing.assert_close(one["action"], other["action"], atol=1e-4, rtol=1e-4)
    for name in ("feasible", "fallback", "iterations"):
        assert torch.equal(one["plan", name], other["plan", name])
    torch.testing.assert_close(one["plan", "score"], other["plan", "score"], atol=1e-3, rtol=1e-3)
    for name in ("mean", "std"):
        torch.testing.assert_close(one["next", "plan", name], other["next", "plan", name], atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("engine", ["fused", "rollout"])
def test_a_row_of_a_batch_is_planned_as_if_alone(engine):
    planner = random_planner(engine=engine, constraint_threshold=0.6, p_random=0.5, max_relaxations=3, optim_steps=3)
    start = latents(6)
    start["plan"] = {
        "mean": torch.tensor([-2.0, 1.0]) + 0.2 * torch.randn(6, 3, A),
        "std": 0.1 + 0.4 * torch.rand(6, 3, A),
    }
    start["is_init"] = torch.tensor([True, False] * 3).unsqueeze(-1)
    noise = planner.sample_noise(6)
    together = planner(start.clone(), noise=noise)
    # Rows at different rounds at the same time, or the test would show little.
    assert together["plan", "iterations"].unique().numel() > 1
    for i in range(6):
        alone = planner(start[i : i + 1].clone(), noise=noise.row(i))
        for key in ("action", ("plan", "score"), ("next", "plan", "mean"), ("next", "plan", "std")):
            torch.testing.assert_close(together[key][i : i + 1], alone[key], atol=1e-4, rtol=1e-4, msg=str(key))
        for name in ("feasible", "safe_set_threshold", "iterations"):
            assert torch.equal(together["plan", name][i : i + 1], alone["plan", name])


def test_given_noise_makes_a_plan_repeatable_and_leaves_the_generator_alone():
    planner = random_planner()
    noise, start = planner.sample_noise(2), latents(2)
    before = torch.get_rng_state()
    one, two = (planner(start.clone(), noise=noise)["action"] for _ in range(2))
    assert torch.equal(one, two)
    assert torch.equal(before, torch.get_rng_state())
    assert not torch.equal(one, planner(start.clone(), noise=planner.sample_noise(2))["action"])


def test_the_shapes_of_all_noise():
    planner = random_planner(max_relaxations=1)
    noise = planner.sample_noise(5)
    iterations = 2 * 2  # rounds × (1 + relaxations)
    assert noise.candidates[0].shape == noise.candidates[1].shape == (iterations, 5, 24, 3, A)
    assert noise.members.shape == (iterations, 3, 3)
    assert noise.dynamics.shape == (iterations, 5, 3, 3, D)
    assert noise.row(2).dynamics.shape[1] == 1
    assert torch.equal(noise.row(2).candidates[0][:, 0], noise.candidates[0][:, 2])


@pytest.mark.parametrize("engine", ["fused", "rollout"])
@pytest.mark.parametrize("batch", [[], [1], [3], [2, 3]])
def test_any_batch_shape_goes(engine, batch):
    out = random_planner(engine=engine)(latents(*batch))
    assert out["action"].shape == (*batch, A)
    for name in ("feasible", "fallback", "relaxed", "safe_set_threshold", "score", "iterations"):
        assert out["plan", name].shape == (*batch, 1)
    for name in ("mean", "std"):
        assert out["next", "plan", name].shape == (*batch, 3, A)


def test_rows_of_a_two_dimensional_batch_keep_their_place():
    planner = random_planner()
    noise, start = planner.sample_noise(6), latents(6)
    flat = planner(start.clone(), noise=noise)
    square = planner(start.clone().reshape(2, 3), noise=noise)
    assert torch.equal(square["action"].reshape(6, A), flat["action"])


# --- the warm start -------------------------------------------------------------------------------------------


def test_a_row_that_was_reset_starts_afresh_while_others_stay_warm():
    spec = Bounded(low=torch.tensor([-3.0, 0.5]), high=torch.tensor([-1.0, 2.0]), shape=(A,))
    planner = stub_planner(spec=spec, p_random=0.0)
    warm = torch.tensor([[-1.5, 1.5], [-2.5, 0.7], [-1.2, 1.9]]).expand(2, 3, A)
    start = TensorDict(
        {
            "latent": torch.zeros(2, D),
            "plan": {"mean": warm, "std": torch.full((2, 3, A), 0.1)},
            "is_init": torch.tensor([[True], [False]]),
        },
        [2],
    )
    out = planner(start, noise=still(planner.sample_noise(2)))
    torch.testing.assert_close(out["action"], torch.tensor([[-2.0, 1.25], [-1.5, 1.5]]))


def test_the_next_steps_start_is_the_plan_shifted_with_a_wide_open_end():
    spec = Bounded(low=torch.tensor([-3.0, 0.5]), high=torch.tensor([-1.0, 2.0]), shape=(A,))
    planner = stub_planner(spec=spec)
    noise = planner.sample_noise(2)
    start = torch.zeros(2, D)
    result = planner.plan(start, noise=noise)
    out = planner(TensorDict({"latent": start}, [2]), noise=noise)
    middle, quarter = torch.tensor([-2.0, 1.25]), torch.tensor([0.5, 0.375])
    for name, last in (("mean", middle), ("std", quarter)):
        shifted = out["next", "plan", name]
        torch.testing.assert_close(shifted[:, :2], getattr(result, name)[:, 1:])
        torch.testing.assert_close(shifted[:, 2], last.expand(2, -1))


def test_a_start_without_spread_is_none():
    # What the primer writes at a reset; also right where no InitTracker marks the first step.
    spec = Bounded(low=torch.tensor([-3.0, 0.5]), high=torch.tensor([-1.0, 2.0]), shape=(A,))
    planner = stub_planner(spec=spec, p_random=0.0)
    zeros = torch.zeros(1, 3, A)
    start = TensorDict({"latent": torch.zeros(1, D), "plan": {"mean": zeros, "std": zeros}}, [1])
    out = planner(start, noise=still(planner.sample_noise(1)))
    torch.testing.assert_close(out["action"], torch.tensor([[-2.0, 1.25]]))


# --- keys -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["fused", "rollout"])
def test_all_keys_may_be_nested(engine):
    keys = {
        "latent_key": ("see", "latent"),
        "action_key": ("agent", "action"),
        "plan_key": ("agent", "plan"),
        "is_init_key": ("see", "first"),
    }
    plain, nested = random_planner(engine=engine, p_random=0.5), random_planner(engine=engine, p_random=0.5, **keys)
    noise = plain.sample_noise(2)
    mean, std = torch.tensor([-2.0, 1.0]).expand(2, 3, A), torch.full((2, 3, A), 0.3)
    first, latent = torch.tensor([[True], [False]]), latents(2)["latent"]
    one = plain(TensorDict({"latent": latent, "is_init": first, "plan": {"mean": mean, "std": std}}, [2]), noise=noise)
    td = TensorDict({"see": {"latent": latent, "first": first}, "agent": {"plan": {"mean": mean, "std": std}}}, [2])
    two = nested(td, noise=noise)
    assert torch.equal(one["action"], two["agent", "action"])
    assert torch.equal(one["plan", "score"], two["agent", "plan", "score"])
    assert torch.equal(one["next", "plan", "mean"], two["next", "agent", "plan", "mean"])
    assert "action" not in set(two.keys())
    assert nested.in_keys == [
        ("see", "latent"),
        *(("agent", "plan", name) for name in ("mean", "std")),
        ("see", "first"),
    ]
    assert nested.out_keys[:2] == [("agent", "action"), ("agent", "plan", "feasible")]


def test_a_missing_latent_is_named():
    with pytest.raises(KeyError, match=r"LS3Planner needs the keys \['latent'\].*It has: state"):
        random_planner()(TensorDict({"state": torch.zeros(1, D)}, [1]))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_latent_that_is_not_finite_is_refused(bad):
    start = latents(3)
    start["latent"][1, 2] = bad
    with pytest.raises(ValueError, match="latent to plan from is not finite: 1 of 12"):
        random_planner()(start)


def test_planning_returns_the_actions_and_leaves_its_input_alone():
    planner = random_planner()
    start, noise = latents(2), planner.sample_noise(2)
    actions = planner.planning(start, noise)
    assert list(start.keys()) == ["latent"]
    assert torch.equal(actions, planner(start, noise=noise)["action"])


def test_a_tensordict_of_its_own_may_receive_the_plan():
    planner = random_planner()
    start, out = latents(2), TensorDict({}, [2])
    assert planner(start, out) is out
    assert list(start.keys()) == ["latent"]
    assert out["action"].shape == (2, A)


def test_an_encoder_is_asked_for_its_mean():
    torch.manual_seed(0)
    encoder = PixelEncoder(latent_dim=D)
    planner = stub_planner(encoder=encoder)
    assert planner.in_keys == ["pixels"]
    seen = TensorDict({"pixels": torch.randint(256, (2, 3, 64, 64), dtype=torch.uint8)}, [2])
    with set_interaction_type(InteractionType.RANDOM):  # as collectors set for exploration
        latent = planner.encode(seen)
    torch.testing.assert_close(latent, encoder(seen.clone())["loc"])
    out = planner(seen)
    assert out["action"].shape == (2, A)
    assert "latent" not in set(out.keys())


def test_observations_that_an_encoder_cannot_read_are_refused():
    planner = stub_planner(encoder=PixelEncoder(latent_dim=D))
    with pytest.raises(KeyError, match=r"needs the keys \['pixels'\]"):
        planner(latents(2))
    pixels = torch.rand(1, 3, 64, 64)
    pixels[0, 0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="observation 'pixels' is not finite"):
        planner(TensorDict({"pixels": pixels}, [1]))


# --- settings -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["safe_set_threshold", "constraint_threshold", "relaxation"])
@pytest.mark.parametrize("value", [0.0, 1.0, -0.1, 1.5, float("nan")])
def test_probabilities_must_lie_strictly_between_zero_and_one(name, value):
    with pytest.raises(ValueError, match=f"{name} must lie strictly between 0 and 1"):
        stub_planner(**{name: value})


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_elites": 25}, "num_elites must lie between 1 and num_candidates = 24, got 25"),
        ({"num_elites": 0}, "num_elites must lie between 1"),
        ({"horizon": 0}, "horizon must be at least 1, got 0"),
        ({"num_particles": 0}, "num_particles must be at least 1"),
        ({"optim_steps": 0}, "optim_steps must be at least 1"),
        ({"max_relaxations": -1}, "max_relaxations must be at least 0, got -1"),
        ({"p_random": 1.5}, r"p_random must lie in \[0, 1\]"),
        ({"noise_scale": -0.1}, "noise_scale must not be negative, got -0.1"),
        ({"engine": "jax"}, "engine must be one of 'auto', 'fused', 'rollout'; got 'jax'"),
        ({"precision": "fp8"}, "precision must be one of 'auto', 'fp32', 'bf16'; got 'fp8'"),
        ({"safe_set_reduction": "max"}, "safe_set_reduction must be one of 'mean', 'min'; got 'max'"),
    ],
)
def test_settings_out_of_range_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        stub_planner(**wrong)


class OwnValue(nn.Module):
    """V = x of a user's own, which no snapshot can be made of."""

    in_keys, out_keys = ("latent",), ("state_value",)

    def forward(self, tensordict):
        return tensordict.set("state_value", tensordict["latent"][..., None, :1])


def test_auto_takes_the_fast_engine_where_it_can_and_any_module_otherwise():
    planner = stub_planner()
    assert isinstance(planner.imagine, FusedImagination)
    own = LS3Planner(planner.env, OwnValue(), planner.safe_set, **SMALL)
    assert isinstance(own.imagine, RolloutImagination)
    noise, start = planner.sample_noise(2), latents(2)
    torch.testing.assert_close(planner(start.clone(), noise=noise)["action"], own(start, noise=noise)["action"])
    with pytest.raises(TypeError, match='engine="rollout"'):
        LS3Planner(planner.env, OwnValue(), planner.safe_set, engine="fused", **SMALL)


def test_given_plans_are_imagined():
    planner = stub_planner(safe_set=classifier(SafeSet, slope=1.0))
    plans = torch.zeros(1, 2, 3, A)
    plans[0, 1, :, 0] = 1.0
    seen = planner.imagine_plans(torch.zeros(1, D), plans)
    torch.testing.assert_close(seen.value[0, :, 0], torch.tensor([0.0, 3.0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(seen.safe_set_prob[0], torch.tensor([0.0, 3.0]).sigmoid(), atol=1e-4, rtol=0)


def test_more_plans_than_candidates_can_be_imagined():
    planner = random_planner()
    assert planner.imagine_plans(torch.zeros(1, D), torch.zeros(1, 30, 3, A)).safe_set_prob.shape == (1, 30)


def test_planning_keeps_no_graph():
    out = random_planner()(latents(2))
    assert not any(value.requires_grad for value in out.values(True, True))


def test_noise_scale_multiplies_the_particles_noise_and_nothing_else():
    drawn = {}
    for scale in (0.0, 0.5, 1.0):
        torch.manual_seed(0)
        drawn[scale] = stub_planner(noise_scale=scale)._sample_imagination_noise(2)
    assert (drawn[0.0].noise == 0).all()
    torch.testing.assert_close(drawn[0.5].noise, 0.5 * drawn[1.0].noise)
    assert torch.equal(drawn[0.0].members, drawn[1.0].members)


# --- encoders, dtypes and sizes -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("out_keys", "latent_key"),
    [
        (["embedding"], "embedding"),
        (["loc", "scale"], "loc"),
        ([("net", "latent"), "other"], ("net", "latent")),
        (["loc", "latent"], "latent"),
    ],
)
def test_an_encoder_names_its_latent_as_it_likes(out_keys, latent_key):
    torch.manual_seed(0)
    width = D * len(out_keys)
    net = nn.Sequential(nn.Linear(10, width), nn.Unflatten(-1, (len(out_keys), D)))
    encoder = TensorDictModule(lambda x: net(x).unbind(-2), ["sensors"], out_keys)
    planner = stub_planner(encoder=encoder)
    seen = TensorDict({"sensors": torch.randn(3, 10)}, [3])
    torch.testing.assert_close(planner.encode(seen), encoder(seen.clone())[latent_key])
    assert planner(seen)["action"].shape == (3, A)


def test_an_encoder_whose_latent_cannot_be_guessed_is_refused():
    encoder = TensorDictModule(lambda x: (x, x), ["sensors"], ["one", "other"])
    with pytest.raises(ValueError, match=r"must write 'loc' .*'latent', or a single key.*'one', 'other'"):
        stub_planner(encoder=encoder)


@pytest.mark.parametrize("engine", ["fused", "rollout"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_action_specs_and_latents_of_other_dtypes(engine, dtype):
    # In float32 the bound 0.2 lies above that of float64, and -0.3 below it: an action must not.
    low, high = torch.tensor([0.1, -0.3], dtype=dtype), torch.tensor([0.2, 0.7], dtype=dtype)
    spec = Bounded(low=low, high=high, shape=(A,), dtype=dtype)
    for value, corner in (((1.0, 1.0, 0.0, 0.0), high), ((-1.0, -1.0, 0.0, 0.0), low)):
        torch.manual_seed(0)
        planner = stub_planner(spec=spec, value=value, engine=engine, num_candidates=300, optim_steps=6, p_random=0.3)
        start = TensorDict({"latent": torch.zeros(3, D, dtype=dtype)}, [3])
        start["plan"] = {"mean": corner.expand(3, 3, A), "std": torch.full((3, 3, A), 0.1, dtype=dtype)}
        out = planner(start)
        assert out["action"].dtype == dtype
        assert spec.expand(3, A).is_in(out["action"])
        assert (out["action"] == corner).any()
        assert out["plan", "score"].dtype == torch.float32


@pytest.mark.parametrize("engine", ["fused", "rollout"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_modules_of_other_dtypes_plan_the_same(engine, dtype):
    plain, other = (random_planner(engine=engine, constraint_threshold=0.6) for _ in range(2))
    other.to(dtype)
    noise, start = plain.sample_noise(4), latents(4)
    one, two = plain(start.clone(), noise=noise), other(start.clone(), noise=noise)
    tolerance = 1e-4 if dtype == torch.float64 else 0.05
    torch.testing.assert_close(one["action"], two["action"], atol=tolerance, rtol=0)
    assert torch.equal(one["plan", "feasible"], two["plan", "feasible"])


def test_an_action_spec_of_whole_numbers_is_refused():
    with pytest.raises(ValueError, match=r"floating dtype, got torch.int64"):
        stub_planner(spec=Bounded(low=-1, high=1, shape=(A,), dtype=torch.int64))


@pytest.mark.parametrize("engine", ["fused", "rollout"])
@pytest.mark.parametrize("batch", [[0], [2, 0]])
def test_no_rows_give_no_plans_of_the_right_shapes(engine, batch):
    given = (
        (stub_planner(engine=engine), latents(*batch)),
        (
            stub_planner(engine=engine, encoder=PixelEncoder(latent_dim=D), p_random=0.5),
            TensorDict(
                {
                    "pixels": torch.zeros(*batch, 3, 64, 64),
                    "plan": {"mean": torch.zeros(*batch, 3, A), "std": torch.zeros(*batch, 3, A)},
                    "is_init": torch.zeros(*batch, 1, dtype=torch.bool),
                },
                batch,
            ),
        ),
    )
    for planner, start in given:
        out = planner(start)
        assert out["action"].shape == (*batch, A)
        assert out["plan", "score"].shape == out["plan", "relaxed"].shape == (*batch, 1)
        assert out["next", "plan", "std"].shape == (*batch, 3, A)


# --- modules from elsewhere -----------------------------------------------------------------------------------


class Mover(nn.Module):
    """z' = z + (a_0, a_1, 0, 0)."""

    def forward(self, latent, action):
        return latent + torch.cat([action, torch.zeros_like(latent[..., A:])], -1)


def test_any_modules_can_be_planned_with():
    torch.manual_seed(0)

    def linear(weight, bias, out_key):
        layer = nn.Linear(D, 1)
        nn.init.zeros_(layer.weight)
        layer.weight.data[0, 0], layer.bias.data[0] = weight, bias
        return TensorDictModule(layer, [("my", "z")], [out_key])

    model = LatentEnv(
        TensorDictModule(Mover(), [("my", "z"), ("my", "u")], [("my", "following")]),
        linear(50.0, -50.0, "unsafe"),  # begins at x = 1
        linear(0.0, -9.0, "done_well"),
        action_spec=Bounded(low=-1.0, high=1.0, shape=(A,)),
        latent_dim=D,
    )
    # V = x writes [*B, 1], without members; the safe set is everywhere.
    planner = LS3Planner(
        model,
        linear(1.0, 0.0, "worth"),
        linear(0.0, 5.0, "safe"),
        **(SMALL | {"num_candidates": 300, "num_elites": 10, "optim_steps": 6}),
    )
    assert isinstance(planner.imagine, RolloutImagination)
    result = planner.plan(torch.tensor([[0.5, 0.0, 0.0, 0.0]]))
    path = 0.5 + result.actions[0, :, 0].cumsum(0)
    assert path.max() <= 0.973
    assert path.max() > 0.9
    torch.testing.assert_close(result.score, path[-1:], atol=1e-4, rtol=0)
    with pytest.raises(TypeError, match=r"model \(LatentEnv\)|dynamics \(TensorDictModule\) is no EnsembleDynamics"):
        LS3Planner(model, planner.value, planner.safe_set, engine="fused")
