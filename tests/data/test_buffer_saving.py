"""What is saved of a buffer goes on to the same bits."""

import io

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.checkpoint import Checkpoint

from ls3_torchrl.data import EpisodeKeys, TaggedReplayBuffer, episode_from_arrays

KEYS = EpisodeKeys(("agent", "state"), ("agent", "action"), ("next", "cost"), ("next", "hit"), ("next", "there"))
OPTIONS = {"latent_dim": 2, "gamma": 0.9, "success_tail": 2, "keys": KEYS}

# Rings are to wrap round here, whatever is in them.
pytestmark = pytest.mark.filterwarnings("ignore:A buffer of .* is full:ls3_torchrl.data.DataWarning")


class Spread(nn.Module):
    def __init__(self):
        super().__init__()
        self.calls = 0

    def forward(self, x):
        self.calls += 1
        return 2 * x, x.abs() + 0.1


def encoder():
    return TensorDictModule(Spread(), in_keys=["x"], out_keys=["loc", "scale"])


def episode(number, steps=7):
    rng = np.random.default_rng(number)
    data = episode_from_arrays(
        rng.normal(size=(steps + 1, 2)),
        rng.normal(size=(steps, 3)),
        rng.normal(size=steps),
        rng.random(steps) < 0.1,
        rng.random(steps) < 0.1,
        keys=KEYS,
    )
    data["wish"] = torch.full((steps, 1), number)
    return data


def fill(buffer, first, count):
    for i in range(first, first + count):
        buffer.add(episode(i, steps=1 + i % 7), ["success", "rand", "constraint", "online"][i % 4])


def make(scratch=None, capacity=40):
    return TaggedReplayBuffer(capacity, extra_keys=["wish"], scratch_dir=scratch, **OPTIONS)


def draws(buffer):
    torch.manual_seed(5)
    batches = [
        buffer.sample(20, members=2, observations=True),
        buffer.sample(20, tags=["success", "online"], steps=2, online_fraction=0.5),
        buffer.sample_frame_transitions(20, without="after_violation"),
        buffer.sample_frames(20),
    ]
    return [item for batch in batches for item in sorted(batch.items(True, True), key=lambda item: str(item[0]))]


def assert_same_draws(one, other):
    for (key, value), (same_key, same_value) in zip(draws(one), draws(other), strict=True):
        assert key == same_key
        assert torch.equal(value, same_value), key


def through_state_dict(buffer, other, folder):
    file = io.BytesIO()
    torch.save(buffer.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))


def through_dumps(buffer, other, folder):
    buffer.dumps(folder / "dump")
    other.loads(folder / "dump")


def through_checkpoint(buffer, other, folder):
    Checkpoint(buffer=buffer).save(folder / "checkpoint")
    Checkpoint(buffer=other).load(folder / "checkpoint")


WAYS = [through_state_dict, through_dumps, through_checkpoint]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("memory", ["memory", "memmap", "memmap to memory"])
@pytest.mark.parametrize("episodes", [5, 40])
def test_a_restored_buffer_goes_on_to_the_same_bits(tmp_path, way, memory, episodes):
    buffer = make(None if memory == "memory" else tmp_path / "one")
    fill(buffer, 0, episodes // 2)
    buffer.encode(encoder())
    fill(buffer, episodes // 2, episodes - episodes // 2)
    other, kept = make(tmp_path / "two" if memory == "memmap" else None), encoder()
    other.encode(kept)  # before anything is there: it is kept for the episodes to come
    fill(other, 70, 3)  # goes away
    draws(other)  # and so do cached indices
    calls = kept.module.calls
    way(buffer, other, tmp_path)
    assert kept.module.calls == calls  # nothing is encoded again
    assert (len(other), other.write_count) == (len(buffer), buffer.write_count)
    assert_same_draws(buffer, other)
    for each in (buffer, other):
        fill(each, episodes, 9)
    assert_same_draws(buffer, other)
    assert buffer.frame_capacity == other.frame_capacity


@pytest.mark.parametrize("way", WAYS)
def test_without_its_encoder_a_restored_buffer_draws_but_takes_no_new_episodes(tmp_path, way):
    buffer, other = make(), make()
    fill(buffer, 0, 5)
    buffer.encode(encoder())
    way(buffer, other, tmp_path)
    assert_same_draws(buffer, other)
    with pytest.raises(RuntimeError, match=r"without the encoder that new episodes need.*buffer\.encode\(encoder\)"):
        other.add(episode(9), "online")
    other.encode(encoder())
    for each in (buffer, other):
        each.add(episode(9), "online")
    assert_same_draws(buffer, other)


@pytest.mark.parametrize("way", WAYS)
def test_a_buffer_without_latents_has_none_when_it_is_restored(tmp_path, way):
    buffer, other = make(), make()
    fill(buffer, 0, 5)
    other.encode(encoder())
    way(buffer, other, tmp_path)
    for each in (buffer, other):
        with pytest.raises(RuntimeError, match="no latents yet"):
            each.sample(3)
        each.add(episode(9), "online")
        each.encode(encoder())
    assert_same_draws(buffer, other)


@pytest.mark.parametrize("way", WAYS)
def test_an_empty_buffer_is_restored(tmp_path, way):
    buffer, other = make(), make()
    buffer.encode(encoder())
    other.encode(encoder())
    fill(other, 0, 3)
    way(buffer, other, tmp_path)
    assert len(other) == len(other.frames) == other.write_count == 0
    for each in (buffer, other):
        fill(each, 0, 8)
    assert_same_draws(buffer, other)


@pytest.mark.parametrize(
    ("name", "value"),
    [("capacity", 41), ("gamma", 0.5), ("latent_dim", 3), ("success_tail", None)],
)
@pytest.mark.parametrize("way", WAYS[:2])
def test_content_of_other_settings_is_refused_and_changes_nothing(tmp_path, way, name, value):
    buffer, other = make(), TaggedReplayBuffer(**({"capacity": 40, "extra_keys": ["wish"], **OPTIONS} | {name: value}))
    fill(buffer, 0, 5)
    fill(other, 1, 1)
    before = len(other)
    with pytest.raises(ValueError, match=rf"saved by a buffer with {name}=.*but this one has {value}"):
        way(buffer, other, tmp_path)
    assert len(other) == before


def test_content_under_other_keys_is_refused():
    with pytest.raises(ValueError, match="saved by a buffer with keys="):
        TaggedReplayBuffer(40, **{**OPTIONS, "keys": None}, extra_keys=["wish"]).load_state_dict(make().state_dict())


def test_a_state_does_not_change_with_the_buffer():
    buffer, other = make(), make()
    fill(buffer, 0, 5)
    buffer.encode(encoder())
    state, before = buffer.state_dict(), draws(buffer)
    fill(buffer, 5, 20)
    other.load_state_dict(state)
    for (key, value), (_, same_value) in zip(before, draws(other), strict=True):
        assert torch.equal(value, same_value), key


def test_a_scratch_dir_is_used_again(tmp_path):
    one = make(tmp_path)
    fill(one, 0, 20)
    one.encode(encoder())
    before = draws(one)
    two = make(tmp_path)
    assert len(two) == 0  # afresh
    fill(two, 50, 20)
    two.encode(encoder())
    fresh = make()
    fill(fresh, 50, 20)
    fresh.encode(encoder())
    assert_same_draws(two, fresh)
    # Who still uses it keeps its content.
    for (key, value), (_, same_value) in zip(before, draws(one), strict=True):
        assert torch.equal(value, same_value), key


def test_nothing_is_saved_into_the_scratch_dir_nor_read_from_elsewhere(tmp_path):
    buffer = make(tmp_path / "scratch")
    fill(buffer, 0, 3)
    with pytest.raises(ValueError, match="scratch_dir"):
        buffer.dumps(tmp_path / "scratch")
    with pytest.raises(FileNotFoundError, match="holds no saved buffer"):
        buffer.loads(tmp_path / "scratch")
    assert len(buffer) == 1 + 2 + 3
