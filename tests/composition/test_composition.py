"""The parts in pipelines of TorchRL: each test reads as an example."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector, Evaluator, MultiSyncCollector
from torchrl.data import Bounded

from ls3_envs import make
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import EpisodeKeys, Tag, TaggedReplayBuffer
from ls3_torchrl.modules import ConstraintEstimator, GoalEstimator, SafeSet, ValueEnsemble
from ls3_torchrl.planners import LatentEnv, LS3Planner, SafeSetFilter, describe_plan

BOX = Bounded(low=-3.0, high=3.0, shape=(2,))
SMALL = {"horizon": 2, "num_candidates": 12, "num_elites": 3, "num_particles": 2, "optim_steps": 2, "p_random": 0.5}


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


def test_a_collector_feeds_the_buffer_that_an_agent_learns_from():
    env, agent = make("navigation", num_envs=2, seed=0, horizon=5), LS3Agent(action_spec=BOX, latent_dim=8)
    buffer = TaggedReplayBuffer(100, latent_dim=8)
    policy = agent.planner(**SMALL)
    for episodes in Collector(env, policy, frames_per_batch=10, total_frames=20, auto_register_policy_transforms=True):
        buffer.extend(episodes)
        assert 0.0 <= describe_plan(episodes)["fallback_rate"] <= 1.0
    buffer.encode(agent.encoder)
    assert len(buffer) == 20
    assert buffer.sample(16)["next", "latent"].shape == (16, 8)


@pytest.mark.slow
def test_processes_collect_side_by_side():
    agent = LS3Agent(action_spec=BOX, latent_dim=8)
    make_env = partial(make, "navigation", num_envs=2, horizon=5)
    options = {"frames_per_batch": 20, "total_frames": 20, "auto_register_policy_transforms": True}
    collector = MultiSyncCollector([make_env, make_env], agent.planner(**SMALL), **options)
    try:
        batch = next(iter(collector))
    finally:
        collector.shutdown()
    assert batch.numel() == 20
    assert batch["plan", "iterations"].min() >= 1


def test_an_evaluator_measures_the_planner():
    planner = LS3Agent(action_spec=BOX, latent_dim=8).planner(**SMALL)
    env = make("navigation", num_envs=1, horizon=4).append_transform(planner.make_tensordict_primer())
    options = {"collector_kwargs": {"traj_format": "cat"}}
    evaluator = Evaluator(env, planner, num_trajectories=2, dump_video=False, **options)
    try:
        measured = evaluator.evaluate()
    finally:
        evaluator.shutdown()
    assert measured["eval/reward"] == -4.0  # nobody arrives in four steps


def test_nested_keys_go_through_encoder_planner_and_filter():
    pixels_to_latent = nn.Sequential(nn.Flatten(), nn.Linear(12, 8))
    encoder = TensorDictModule(pixels_to_latent, in_keys=[("robot", "camera")], out_keys=[("robot", "z")])
    agent = LS3Agent(action_spec=BOX, latent_dim=8, encoder=encoder)
    keys = {"latent_key": ("robot", "z"), "action_key": ("robot", "action"), "plan_key": ("robot", "plan")}
    model = LatentEnv(agent.dynamics, agent.constraint, agent.goal, action_spec=BOX)
    planner = LS3Planner(model, agent.value, agent.safe_set, encoder, is_init_key=("robot", "new"), **keys, **SMALL)
    drive = TensorDictModule(nn.Linear(12, 2), in_keys=[("robot", "camera")], out_keys=[("robot", "action")])
    td = TensorDict({"robot": {"camera": torch.rand(3, 12), "new": torch.ones(3, 1).bool()}}, [3])
    td["robot"].update(planner.make_tensordict_primer().primers.expand(3).zero()["robot"])
    out = SafeSetFilter(drive, planner, filter_key=("robot", "filter"))(td)
    assert out["robot", "action"].shape == out["robot", "filter", "proposed"].shape == (3, 2)


def test_a_cost_in_the_style_of_safety_gymnasium_is_the_constraint():
    cost = torch.tensor([0.0, 0.0, 2.5, 0.0]).unsqueeze(-1)
    flags = {"reward": -torch.ones(4, 1), "success": torch.zeros(4, 1).bool(), "done": torch.arange(4)[:, None] == 3}
    nxt = {"sensors": torch.randn(4, 6), "constraint": cost > 0, **flags}
    episode = TensorDict({"sensors": torch.randn(4, 6), "action": torch.zeros(4, 2), "next": nxt}, [4])
    buffer = TaggedReplayBuffer(100, latent_dim=6, keys=EpisodeKeys(observation="sensors"))
    buffer.add(episode, Tag.CONSTRAINT)
    buffer.encode(TensorDictModule(nn.Identity(), in_keys=["sensors"], out_keys=["latent"]))
    rows = buffer.sample(50)
    assert rows["next", "constraint"].any()
    assert rows["after_violation"].any()


def test_a_pretrained_encoder_stays_as_it_is():
    backbone = nn.Sequential(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(48, 8)).requires_grad_(False)
    scale = TensorDictModule(lambda pixels: pixels.float() / 255.0, in_keys=["pixels"], out_keys=["images"])
    encoder = TensorDictSequential(scale, TensorDictModule(backbone, in_keys=["images"], out_keys=["latent"]))
    encoder.select_out_keys("latent")
    agent = LS3Agent(action_spec=BOX, latent_dim=8, encoder=encoder)
    td = TensorDict({"pixels": torch.randint(256, (4, 3, 224, 224), dtype=torch.uint8)}, [4])
    policy = agent.planner(**SMALL | {"p_random": 1.0})
    assert policy(td)["action"].shape == (4, 2)
    assert not any(parameter.requires_grad for parameter in agent.encoder.parameters())


class Members(TensorDictModuleBase):
    """A world model of one's own: two networks, of which each row takes one at random."""

    in_keys, out_keys, latent_dim = ["latent", "action"], [("next", "latent")], 8

    def __init__(self):
        super().__init__()
        self.networks = nn.ModuleList(nn.Linear(10, 8) for _ in range(2))

    def forward(self, td):
        seen = torch.cat([td["latent"], td["action"]], -1)
        both = torch.stack([network(seen) for network in self.networks])
        chosen = torch.randint(2, (*td.batch_size, 1), device=seen.device).bool()
        return td.set(("next", "latent"), td["latent"] + torch.where(chosen, *both))


def test_an_ensemble_of_ones_own_is_the_world_model():
    model = LatentEnv(Members(), ConstraintEstimator(8), GoalEstimator(8), action_spec=BOX)
    planner = LS3Planner(model, ValueEnsemble(8), SafeSet(8), **SMALL | {"p_random": 1.0})
    out = planner(TensorDict({"latent": torch.randn(5, 8)}, [5]))
    assert out["action"].shape == (5, 2)
    assert BOX.expand(5, 2).is_in(out["action"])
