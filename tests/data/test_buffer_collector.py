"""The buffer as a Collector's replay_buffer."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, Unbounded
from torchrl.data.tensor_specs import Composite
from torchrl.envs import EnvBase

from ls3_torchrl.data import EpisodeKeys, Tag, TaggedReplayBuffer

KEYS = EpisodeKeys(observation="state")
HORIZON = 4


class Counting(EnvBase):
    """World w counts its steps from 100 w on; it is in the goal from the third step on and violates in the second."""

    def __init__(self, worlds, horizon=HORIZON):
        super().__init__(batch_size=[worlds])
        self.horizon = torch.as_tensor(horizon).expand(worlds).reshape(-1, 1)
        self.observation_spec = Composite(
            state=Unbounded([worlds, 1]),
            constraint=Unbounded([worlds, 1], dtype=torch.bool),
            success=Unbounded([worlds, 1], dtype=torch.bool),
            shape=[worlds],
        )
        self.action_spec = Bounded(-1, 1, [worlds, 2])
        self.reward_spec = Unbounded([worlds, 1])
        self.step_number = torch.zeros(worlds, 1)

    def _look(self, **more):
        state = self.step_number + 100 * torch.arange(float(len(self.step_number))).unsqueeze(-1)
        flags = {"constraint": self.step_number == 2, "success": self.step_number >= 3}
        return TensorDict({"state": state, **flags, **more}, self.batch_size)

    def _reset(self, tensordict=None):
        which = None if tensordict is None else tensordict.get("_reset", None)
        again = torch.ones_like(self.step_number, dtype=torch.bool) if which is None else which
        self.step_number = torch.where(again, 0.0, self.step_number)
        return self._look()

    def _step(self, tensordict):
        self.step_number = self.step_number + 1
        over = self.step_number >= self.horizon
        flags = {"truncated": over, "done": over, "terminated": torch.zeros_like(over)}
        return self._look(reward=-torch.ones_like(self.step_number), **flags)

    def _set_seed(self, seed):
        pass


def identity():
    return TensorDictModule(nn.Identity(), in_keys=["state"], out_keys=["latent"])


def collect(buffer, env, **options):
    collector = Collector(env, None, replay_buffer=buffer, **options)
    assert all(batch is None for batch in collector)
    collector.shutdown()


def assert_whole_episodes(buffer, worlds, episodes, horizon=HORIZON):
    """All steps of so many episodes, each row with its own states and labels."""
    rows = buffer.transitions.storage[:]
    assert len(rows) == episodes * horizon
    assert (rows["tag"] == int(Tag.ONLINE)).all()
    state = rows["loc"].reshape(episodes, horizon)
    assert torch.equal(state % 100, torch.arange(float(horizon)).expand(episodes, -1))
    assert sorted((state[:, 0] // 100).tolist()) == sorted(
        [w for w in range(worlds) for _ in range(episodes // worlds)]
    )
    assert torch.equal(rows["next", "loc"], rows["loc"] + 1)
    step = torch.arange(horizon).repeat(episodes).unsqueeze(-1)
    assert torch.equal(rows["next", "constraint"], step == 1)
    assert torch.equal(rows["next", "success"], step >= 2)
    assert torch.equal(rows["steps_left"], horizon - step)
    assert rows["in_success"].all()
    drawn = buffer.sample(64, observations=True)
    assert torch.equal(drawn["state"], drawn["loc"])
    assert torch.equal(drawn["next", "state"], drawn["next", "loc"])
    assert (drawn["action"].abs() <= 1).all()


def new_buffer(scratch=None):
    buffer = TaggedReplayBuffer(200, latent_dim=1, keys=KEYS, scratch_dir=scratch)
    buffer.encode(identity())
    return buffer


def test_batches_that_are_whole_episodes_are_stored():
    buffer = new_buffer()
    collect(buffer, Counting(2), frames_per_batch=2 * HORIZON, total_frames=6 * HORIZON)
    assert_whole_episodes(buffer, 2, 6)
    assert buffer.write_count == 6 * HORIZON


def test_several_whole_episodes_in_a_row_of_a_batch_are_taken_apart():
    buffer = new_buffer()
    collect(buffer, Counting(2), frames_per_batch=4 * HORIZON, total_frames=8 * HORIZON)
    assert_whole_episodes(buffer, 2, 8)


@pytest.mark.parametrize("options", [{}, {"trajs_per_write": 1}, {"trajs_per_write": 2}])
def test_trajs_per_batch_gathers_episodes_that_batches_cut_off(options, tmp_path):
    buffer = new_buffer(tmp_path)
    # Batches of three steps a world, episodes of four.
    collect(buffer, Counting(2), frames_per_batch=6, total_frames=48, trajs_per_batch=1, **options)
    assert_whole_episodes(buffer, 2, 12)


def test_trajs_per_batch_with_episodes_of_different_lengths():
    buffer = new_buffer()
    collect(buffer, Counting(2, horizon=[2, 5]), frames_per_batch=6, total_frames=60, trajs_per_batch=1)
    rows = buffer.transitions.storage[:]
    assert torch.equal(rows["next", "loc"], rows["loc"] + 1)
    short = rows["loc"] < 100
    assert torch.equal(rows["steps_left"], torch.where(short, 2 - rows["loc"] % 100, 5 - rows["loc"] % 100).long())
    assert int(short.sum()) == 30


def test_batches_that_cut_episodes_off_are_refused_with_the_remedy():
    buffer = new_buffer()
    with pytest.raises(ValueError, match=r"has not ended.*trajs_per_batch=1"):
        collect(buffer, Counting(2), frames_per_batch=6, total_frames=48)
    with pytest.raises(ValueError, match=r"Steps 4 to 5 of a row of 6 belong.*trajs_per_batch=1"):
        collect(buffer, Counting(2), frames_per_batch=12, total_frames=48)
    assert len(buffer) == 0


def test_random_frames_are_counted_by_the_buffer():
    policy = TensorDictModule(lambda state: torch.full((len(state), 2), 7.0), in_keys=["state"], out_keys=["action"])
    buffer = new_buffer()
    collector = Collector(
        Counting(2),
        policy,
        replay_buffer=buffer,
        frames_per_batch=2 * HORIZON,
        total_frames=6 * HORIZON,
        init_random_frames=2 * HORIZON,
        auto_register_policy_transforms=False,
    )
    list(collector)
    collector.shutdown()
    by_policy = (buffer.transitions.storage[:]["action"] == 7.0).all(-1)
    assert by_policy.tolist() == [False] * 2 * HORIZON + [True] * 4 * HORIZON


@pytest.mark.parametrize("form", ["padded", "cat"])
def test_batches_of_trajectories_can_be_added_by_hand(form):
    buffer = new_buffer()
    collector = Collector(
        Counting(2, horizon=[2, 5]), None, frames_per_batch=6, total_frames=60, trajs_per_batch=3, traj_format=form
    )
    for batch in collector:
        buffer.add(batch, "online")
    collector.shutdown()
    rows = buffer.transitions.storage[:]
    assert len(rows) > 30
    assert torch.equal(rows["next", "loc"], rows["loc"] + 1)
    assert (rows["next", "reward"] == -1).all()
