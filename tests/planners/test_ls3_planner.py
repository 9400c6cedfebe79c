import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torch import nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from ls3_torchrl.modules import (
    ConstraintEstimator,
    EnsembleDynamics,
    GoalEstimator,
    PixelEncoder,
    SafeSet,
    ValueEnsemble,
)
from ls3_torchrl.planners import (
    FusedImagination,
    LatentEnv,
    LS3Planner,
    PlanNoise,
    RolloutImagination,
    describe_plan,
)

D, A = 4, 2
SMALL = {"horizon": 3, "num_candidates": 24, "num_elites": 4, "num_particles": 3, "optim_steps": 2, "precision": "fp32"}


def classifier(kind, *, prob=None, slope=0.0, offset=0.0, axis=0):
    """A classifier of one probability everywhere, or of logit slope * (z_axis - offset)."""
    module = kind(D, hidden=())
    with torch.no_grad():
        module.network[-1].weight.zero_()[0, axis] = slope
        module.network[-1].bias.fill_(-slope * offset if prob is None else float(torch.tensor(prob).logit()))
    return module


def never(kind):
    return classifier(kind, prob=0.001)


def stub_planner(
    *, spec=None, value=(1.0, 0.0, 0.0, 0.0), constraint=None, goal=None, safe_set=None, encoder=None, **options
):
    """A planner in a world where z' = z + (a_0, a_1, 0, 0) almost exactly and V = value · z."""
    dynamics = EnsembleDynamics(D, A, num_members=2, hidden=(), log_scale_bounds=(-20.0, 4.0))
    values = ValueEnsemble(D, num_members=2, hidden=())
    with torch.no_grad():
        dynamics.network.weights[0].zero_()[:, D : D + A, :A] = torch.eye(A)
        dynamics.network.biases[0].zero_()[..., D:] = -20.0
        values.network.weights[0].copy_(torch.as_tensor(value).expand(2, D).unsqueeze(-1))
        values.network.biases[0].zero_()
    env = LatentEnv(
        dynamics,
        constraint or never(ConstraintEstimator),
        goal or never(GoalEstimator),
        action_spec=Bounded(low=-1.0, high=1.0, shape=(A,)) if spec is None else spec,
    )
    return LS3Planner(env, values, safe_set or classifier(SafeSet, prob=0.99), encoder, **(SMALL | options))


def random_planner(propagation="ts1", *, constraint_bias=0.0, **options):
    """Random networks, so that nothing is symmetric; their probabilities spread round one half."""
    torch.manual_seed(0)
    env = LatentEnv(
        EnsembleDynamics(D, A, num_members=3, hidden=(8,), propagation=propagation),
        ConstraintEstimator(D, hidden=(8,)),
        GoalEstimator(D, hidden=(8,)),
        action_spec=Bounded(low=torch.tensor([-3.0, 0.5]), high=torch.tensor([-1.0, 2.0]), shape=(A,)),
    )
    with torch.no_grad():
        env.constraint.network[-1].bias.add_(constraint_bias)
        for head in (env.constraint, env.goal):
            head.network[-1].weight.mul_(4)
    safe_set = SafeSet(D, hidden=(8,))
    return LS3Planner(env, ValueEnsemble(D, num_members=2, hidden=(8,)), safe_set, **(SMALL | options))


def latents(*batch, seed=1):
    return TensorDict({"latent": 2 * torch.randn(*batch, D, generator=torch.Generator().manual_seed(seed))}, batch)


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


def test_pessimism_avoids_what_the_members_disagree_on():
    torch.manual_seed(0)
    # V = 3x and -x: on average x, with a standard deviation of 2|x|.
    wide = {"num_candidates": 300, "num_elites": 10, "optim_steps": 5}
    bold, timid = stub_planner(**wide), stub_planner(pessimism=1.0, **wide)
    for planner in (bold, timid):
        with torch.no_grad():
            planner.value.network.weights[0].zero_()[:, 0, 0] = torch.tensor([3.0, -1.0])
    start = torch.zeros(1, D)
    assert bold.plan(start).actions[0, :, 0].sum() > 2.5
    assert timid.plan(start).actions[0, :, 0].sum().abs() < 0.3


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
    # Violating everywhere; the end is the safer the further right: the best of the last iteration is known.
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
    candidates = -1 + 2 * noise.candidates[1][2]
    best = candidates[..., 0].sum(-1).argmax(-1)
    torch.testing.assert_close(out["action"], candidates[torch.arange(2), best, 0])
    assert_in_box(out["action"], planner.action_spec)


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


def test_describe_plan_by_hand():
    plan = {
        "fallback": torch.tensor([[[False], [True]], [[False], [False]]]),
        "relaxed": torch.tensor([[[False], [True]], [[True], [False]]]),
        "iterations": torch.tensor([[[4], [6]], [[5], [4]]]),
    }
    described = describe_plan(TensorDict({"me": {"plan": plan}}, [2, 2]), plan_key=("me", "plan"))
    expected = {"fallback_rate": 0.25, "relaxed_rate": 0.5, "iterations": 4.75}
    assert {name: round(value.item(), 6) for name, value in described.items()} == expected


# --- engines, rows and repeatability --------------------------------------------------------------------------


@pytest.mark.parametrize("propagation", ["ts1", "tsinf"])
@pytest.mark.parametrize("reduction", ["max", "mean"])
@pytest.mark.parametrize("common", [True, False], ids=["common", "own noise"])
def test_both_engines_pick_the_same_actions(propagation, reduction, common):
    options = {"constraint_reduction": reduction, "common_noise": common, "constraint_threshold": 0.6}
    fused, plain = (random_planner(propagation, engine=engine, **options) for engine in ("fused", "rollout"))
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
@pytest.mark.parametrize("common", [True, False], ids=["common", "own noise"])
def test_a_row_of_a_batch_is_planned_as_if_alone(engine, common):
    planner = random_planner(
        engine=engine, common_noise=common, constraint_threshold=0.6, p_random=0.5, max_relaxations=3, optim_steps=3
    )
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
    planner = random_planner(common_noise=False)
    noise, start = planner.sample_noise(2), latents(2)
    before = torch.get_rng_state()
    one, two = (planner(start.clone(), noise=noise)["action"] for _ in range(2))
    assert torch.equal(one, two)
    assert torch.equal(before, torch.get_rng_state())
    assert not torch.equal(one, planner(start.clone(), noise=planner.sample_noise(2))["action"])


@pytest.mark.parametrize("common", [True, False])
def test_the_shapes_of_all_noise(common):
    planner = random_planner("tsinf", common_noise=common, max_relaxations=1)
    noise = planner.sample_noise(5)
    iterations = 2 * 2  # rounds × (1 + relaxations)
    assert noise.candidates[0].shape == noise.candidates[1].shape == (iterations, 5, 24, 3, A)
    assert noise.members.shape == (iterations, 3, 3)
    assert (noise.members == noise.members[:, :1]).all()
    assert noise.dynamics.shape == (iterations, 5, 3, 3, 1 if common else 24, D)
    assert noise.row(2).dynamics.shape[1] == 1
    assert torch.equal(noise.row(2).candidates[0][:, 0], noise.candidates[0][:, 2])


@pytest.mark.parametrize("engine", ["fused", "rollout"])
@pytest.mark.parametrize("batch", [[], [1], [3], [2, 3]])
def test_any_batch_shape_goes(engine, batch):
    out = random_planner(engine=engine)(latents(*batch))
    assert out["action"].shape == (*batch, A)
    for name in ("feasible", "fallback", "safe_set_threshold", "score", "iterations"):
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


def still(noise: PlanNoise) -> PlanNoise:
    """Without candidate noise every candidate is its Gaussian's mean."""
    return noise._replace(candidates=(torch.zeros_like(noise.candidates[0]), noise.candidates[1]))


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


class Corridor(EnvBase):
    """Row i's episodes last 3 + i steps; the latent is observed as it is."""

    def __init__(self, rows=2):
        super().__init__(batch_size=[rows])
        self.observation_spec = Composite(latent=Unbounded(shape=(rows, D)), shape=(rows,))
        self.action_spec = Bounded(low=-1.0, high=1.0, shape=(rows, A))
        self.reward_spec = Unbounded(shape=(rows, 1))
        self.clock = torch.zeros(rows, 1, dtype=torch.long)
        self.where = torch.zeros(rows, D)

    def _reset(self, tensordict=None, **kwargs):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self.clock, dtype=torch.bool) if mask is None else mask
        self.clock = torch.where(mask, 0, self.clock)
        self.where = torch.where(mask, 0.0, self.where)
        return TensorDict({"latent": self.where.clone()}, self.batch_size)

    def _step(self, tensordict):
        self.clock = self.clock + 1
        self.where = torch.cat([self.where[:, :A] + tensordict["action"], self.where[:, A:]], -1)
        done = self.clock >= 3 + torch.arange(len(self.clock)).unsqueeze(-1)
        step = {"latent": self.where.clone(), "reward": self.where[:, :1], "done": done, "terminated": done}
        return TensorDict(step, self.batch_size)

    def _set_seed(self, seed):
        """It draws nothing."""


def corridor(planner, rows=2):
    env = TransformedEnv(Corridor(rows), InitTracker())
    env.append_transform(planner.make_tensordict_primer())
    return env


def assert_warm_starts_are_carried(path, plan_key=("plan",)):
    """``path`` [rows, T]: each step begins with what the step before left, or with nothing after a reset."""
    first = path["is_init"].squeeze(-1)
    # Row 0 has episodes of 3 steps, row 1 of 4: resets happen in one row at a time.
    assert first.int().tolist() == [[1, 0, 0] * 3, ([1, 0, 0, 0] * 3)[:9]]
    for name in ("mean", "std"):
        given, left = path[(*plan_key, name)], path[("next", *plan_key, name)]
        assert (given[first] == 0).all()
        later = ~first[:, 1:]
        torch.testing.assert_close(given[:, 1:][later], left[:, :-1][later])
        if name == "std":
            assert (given[:, 1:][later] > 0).any(-1).any(-1).all()


def test_rollout_carries_the_warm_start_and_drops_it_with_the_episode():
    torch.manual_seed(0)
    planner = stub_planner(p_random=0.5, min_std=0.05)
    path = corridor(planner).rollout(9, planner, break_when_any_done=False)
    assert_warm_starts_are_carried(path)
    assert ("plan", "score") in path.keys(True)


# TorchRL warns about classes of its own while this module is imported.
@pytest.mark.filterwarnings("ignore:Creating .* which inherits from WeightUpdaterBase:DeprecationWarning")
def test_collector_carries_the_warm_start_and_drops_it_with_the_episode():
    from torchrl.collectors import Collector

    torch.manual_seed(0)
    planner = stub_planner(p_random=0.5, min_std=0.05)
    collector = Collector(corridor(planner), planner, frames_per_batch=6, total_frames=18)
    # Batches of three steps: episodes, and with them the plans, run on from one batch to the next.
    path = torch.cat(list(collector), 1)
    collector.shutdown()
    assert_warm_starts_are_carried(path)


def test_nested_keys_are_carried_too():
    torch.manual_seed(0)
    planner = stub_planner(p_random=0.5, min_std=0.05, plan_key=("ls3", "plan"))
    path = corridor(planner).rollout(9, planner, break_when_any_done=False)
    assert_warm_starts_are_carried(path, ("ls3", "plan"))


def test_the_carried_start_is_what_the_next_plan_begins_with():
    planner = stub_planner(p_random=0.0, min_std=0.05)
    env = corridor(planner)
    # Noise free: the first plan is the middle of the box, so make the second start elsewhere by hand.
    noise = still(planner.sample_noise(2))
    state = env.reset()
    state = planner(state, noise=noise)
    state["next", "plan", "mean"] = torch.full((2, 3, A), 0.25)
    _, following = env.step_and_maybe_reset(state)
    torch.testing.assert_close(planner(following, noise=noise)["action"], torch.full((2, A), 0.25))


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
        ({"pessimism": -1.0}, "pessimism must not be negative"),
        ({"noise_scale": -0.1}, "noise_scale must not be negative, got -0.1"),
        ({"min_std": -1.0}, "min_std must not be negative"),
        ({"goal_reduction": "sum"}, "goal_reduction must be one of 'count', 'expected'; got 'sum'"),
        ({"engine": "jax"}, "engine must be one of 'auto', 'fused', 'rollout'; got 'jax'"),
        ({"precision": "fp8"}, "precision must be one of 'auto', 'fp32', 'bf16'; got 'fp8'"),
        ({"constraint_reduction": "min"}, "constraint_reduction must be one of 'max', 'mean'; got 'min'"),
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


def test_statistics_judge_given_plans():
    planner = stub_planner(safe_set=classifier(SafeSet, slope=1.0))
    plans = torch.zeros(1, 2, 3, A)
    plans[0, 1, :, 0] = 1.0
    seen = planner.imagine_plans(torch.zeros(1, D), plans)
    torch.testing.assert_close(seen.value[0, :, 0], torch.tensor([0.0, 3.0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(seen.safe_set_prob[0], torch.tensor([0.0, 3.0]).sigmoid(), atol=1e-4, rtol=0)


def test_planning_keeps_no_graph():
    out = random_planner()(latents(2))
    assert not any(value.requires_grad for value in out.values(True, True))


def test_noise_scale_multiplies_the_particles_noise_and_nothing_else():
    drawn = {}
    for scale in (0.0, 0.5, 1.0):
        torch.manual_seed(0)
        drawn[scale] = stub_planner(noise_scale=scale)._sample_imagination_noise(2, 1)
    assert (drawn[0.0].noise == 0).all()
    torch.testing.assert_close(drawn[0.5].noise, 0.5 * drawn[1.0].noise)
    assert torch.equal(drawn[0.0].members, drawn[1.0].members)
