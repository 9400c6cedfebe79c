"""Planners of small worlds whose best plans are known, and an environment to drive them in."""

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from ls3_torchrl.modules import ConstraintEstimator, EnsembleDynamics, GoalEstimator, SafeSet, ValueEnsemble
from ls3_torchrl.planners import LatentEnv, LS3Planner, PlanNoise

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
    if "optimizer" in options:
        options = {"horizon": 3, "num_particles": 3, "precision": "fp32"} | options
    else:
        options = SMALL | options
    return LS3Planner(env, values, safe_set or classifier(SafeSet, prob=0.99), encoder, **options)


def random_planner(*, constraint_bias=0.0, **options):
    """Random networks, so that nothing is symmetric; their probabilities spread round one half."""
    torch.manual_seed(0)
    env = LatentEnv(
        EnsembleDynamics(D, A, num_members=3, hidden=(8,)),
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


def still(noise: PlanNoise) -> PlanNoise:
    """Without candidate noise every candidate is its Gaussian's mean."""
    return noise._replace(candidates=(torch.zeros_like(noise.candidates[0]), noise.candidates[1]))
