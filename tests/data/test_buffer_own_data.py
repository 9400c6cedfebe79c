"""Observations of any kind, any encoder, own keys, and episodes in all the ways in which they come."""

import numpy as np
import pytest
import torch
from tensordict import LazyStackedTensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from ls3_torchrl.data import EpisodeKeys, RowSelection, TaggedReplayBuffer, episode_from_arrays
from ls3_torchrl.modules import PixelEncoder

KEYS = EpisodeKeys(
    ("agent", "state"), ("agent", "action"), ("next", "agent", "cost"), ("next", "flags", "hit"), ("flags", "reached")
)
STANDARD = EpisodeKeys(observation="state")


def episode(steps, start=0.0, keys=KEYS, dtype=np.float32, shape=(2,), success=()):
    """States that count on; the action is the state's first number."""
    number = np.arange(start, start + steps + 1, dtype=dtype)
    states = np.broadcast_to(number.reshape(-1, *[1] * len(shape)), (steps + 1, *shape)).copy()
    reached = np.isin(np.arange(steps), success)
    return episode_from_arrays(states, number[:-1, None], reached - 1.0, number[:-1] % 3 == 2, reached, keys=keys)


def identity(in_key="state", out_key="latent"):
    return TensorDictModule(nn.Identity(), in_keys=[in_key], out_keys=[out_key])


@pytest.fixture(params=[KEYS, STANDARD], ids=["nested", "flat"])
def keys(request):
    return request.param


def test_states_with_an_identity_encoder_under_any_keys(keys):
    buffer = TaggedReplayBuffer(50, latent_dim=2, gamma=0.5, keys=keys)
    buffer.add(episode(5, keys=keys, success=[4]), "success")
    buffer.encode(identity(keys.observation))
    buffer.add(episode(4, start=10, keys=keys), "online")  # encoded as it comes
    rows = buffer.sample(200, observations=True)
    number = rows[keys.action]
    for group, key, ahead in ((rows, keys.observation, 0), (rows, keys.next_observation, 1)):
        assert group[key].dtype == torch.float32
        assert torch.equal(group[key], (number + ahead).expand(-1, 2))
    # The encoder is certain: latents are the states themselves.
    assert torch.equal(rows["latent"], rows[keys.observation])
    assert torch.equal(rows["next", "latent"], rows[keys.next_observation])
    assert (rows["scale"] == 0).all()
    assert rows[keys.reward].shape == rows[keys.constraint].shape == rows[keys.success].shape == (200, 1)
    assert torch.equal(rows[keys.constraint], number % 3 == 2)
    assert torch.equal(rows[keys.success], number == 4)
    assert torch.equal(rows[keys.reward], rows[keys.success].float() - 1)
    assert torch.equal(rows["in_success"], number <= 4)
    assert torch.equal(rows["after_violation"], ((number > 2) & (number < 5)) | (number > 11))
    if keys is KEYS:  # nothing is written under other names
        assert not {"action", "state"} & set(rows.keys())
        assert not {"reward", "constraint", "success", "state"} & set(rows["next"].keys())


def test_frames_and_transitions_of_frames_have_own_keys_too(keys):
    buffer = TaggedReplayBuffer(50, latent_dim=2, keys=keys)
    buffer.add([episode(5, keys=keys), episode(4, start=10, keys=keys)], "success")
    frames = buffer.sample_frames(300)[keys.observation]
    assert set(frames[:, 0].tolist()) == {*range(6), *range(10, 15)}
    batch = buffer.sample_frame_transitions(100, RowSelection(steps=3))
    assert batch[keys.action].shape == (100, 3, 1)
    assert torch.equal(batch[keys.observation][:, :1], batch[keys.action][:, 0])
    assert torch.equal(batch[keys.next_observation][:, :1], batch[keys.action][:, 2] + 1)
    mean = buffer.mean_frame(frames=20_000)
    torch.testing.assert_close(mean, torch.full((2,), 75 / 11), atol=0.2, rtol=0)  # floats keep their unit


@pytest.mark.parametrize(
    ("dtype", "shape"),
    [(np.uint8, (3, 8, 8)), (np.uint8, (4,)), (np.float32, ()), (np.float64, (2, 3)), (np.int64, (5,))],
)
def test_observations_of_any_type_and_shape(tmp_path, dtype, shape):
    shape = shape or (1,)
    keys = EpisodeKeys(observation=("deep", "observation"))
    flatten = TensorDictModule(lambda x: x.flatten(1)[:, :1].float(), in_keys=["whatever"], out_keys=["anything"])
    for scratch in (None, tmp_path):
        buffer = TaggedReplayBuffer(20, latent_dim=1, keys=keys, scratch_dir=scratch)
        buffer.add(episode(6, keys=keys, dtype=dtype, shape=shape), "rand")
        buffer.encode(flatten)
        rows = buffer.sample(30, observations=True)
        assert rows["deep", "observation"].shape == (30, *shape)
        assert rows["deep", "observation"].dtype == (
            torch.float32 if dtype == np.float64 else torch.as_tensor(dtype(0)).dtype
        )
        assert torch.equal(rows["deep", "observation"].flatten(1)[:, :1].float(), rows["action"])
        assert torch.equal(rows["loc"], rows["action"])
        assert torch.equal(rows["next", "loc"], rows["action"] + 1)


def test_a_foreign_encoder_with_a_spread_is_drawn_from():
    torch.manual_seed(0)
    encoder = TensorDictModule(lambda x: (x, 0 * x + 0.5), in_keys=["x"], out_keys=[("q", "loc"), ("q", "scale")])
    buffer = TaggedReplayBuffer(50, latent_dim=2, keys=KEYS)
    buffer.add(episode(5), "success")
    buffer.encode(encoder)
    rows = buffer.sample(4000)
    assert ((rows["latent"] - rows["loc"]).std() - 0.5).abs() < 0.02


def test_an_encoder_on_pixels_under_another_key():
    keys = EpisodeKeys(observation=("camera", "top"))
    frames = np.random.default_rng(0).integers(0, 256, (4, 3, 64, 64), dtype=np.uint8)
    data = episode_from_arrays(frames, np.zeros((3, 1)), np.zeros(3), np.zeros(3), np.zeros(3), keys=keys)
    encoder = PixelEncoder(latent_dim=4, pixels_key=("camera", "top"))
    buffer = TaggedReplayBuffer(10, latent_dim=4, keys=keys)
    buffer.add(data, "success")
    buffer.encode(encoder)
    torch.testing.assert_close(buffer.transitions.storage[:]["loc"], encoder(data)["loc"].detach())


class Failing(nn.Module):
    """Works for so many calls."""

    def __init__(self, calls):
        super().__init__()
        self.calls = calls

    def forward(self, x):
        self.calls -= 1
        if self.calls < 0:
            raise RuntimeError("out of memory")
        return x


def failing(calls):
    return TensorDictModule(Failing(calls), in_keys=["x"], out_keys=["latent"])


@pytest.mark.parametrize("encoded", [True, False])
@pytest.mark.parametrize("how", ["second chunk", "size", "progress"])
def test_an_encode_that_fails_leaves_the_buffer_as_it_was(encoded, how):
    buffer = TaggedReplayBuffer(1000, latent_dim=2, keys=KEYS)
    buffer.add(episode(700), "success")
    if encoded:
        buffer.encode(identity())
    before = buffer.transitions.storage[:].clone()

    def stop(done, total):
        raise KeyboardInterrupt

    if how == "second chunk":
        with pytest.raises(RuntimeError, match="out of memory"):
            buffer.encode(failing(1))
    elif how == "size":
        with pytest.raises(ValueError, match="latents of size 1"):
            buffer.encode(TensorDictModule(lambda x: x[:, :1], in_keys=["x"], out_keys=["latent"]))
    else:
        with pytest.raises(KeyboardInterrupt):
            buffer.encode(failing(9), progress=stop)
    assert (buffer.transitions.storage[:] == before).all()
    if encoded:
        rows = buffer.sample(50, observations=True)
        assert torch.equal(rows["latent"], rows[KEYS.observation])
        buffer.add(episode(3), "online")  # with the encoder that it had
    else:
        with pytest.raises(RuntimeError, match="no latents yet"):
            buffer.sample(4)
        buffer.add(episode(3), "online")
        assert (buffer.transitions.storage[:]["loc"] == 0).all()


def test_an_episode_whose_encoding_fails_is_not_stored_in_part():
    buffer = TaggedReplayBuffer(100, latent_dim=2, keys=KEYS)
    buffer.encode(failing(1))
    buffer.add(episode(3), "success")
    with pytest.raises(RuntimeError, match="out of memory"):
        buffer.add(episode(4), "success")
    assert (len(buffer), len(buffer.frames)) == (3, 4)
    rows = buffer.sample(20, observations=True)
    assert torch.equal(rows["latent"], rows[KEYS.observation])


@pytest.mark.parametrize("how", ["list", "lazy stack", "batch"])
def test_many_episodes_in_one_call(how):
    lengths = (3, 3, 3) if how == "batch" else (3, 1, 5)
    rows = [episode(steps, start=10.0 * i) for i, steps in enumerate(lengths)]
    whole = {"list": list, "lazy stack": lambda x: LazyStackedTensorDict.lazy_stack(x, 0), "batch": torch.stack}[how](
        rows
    )
    buffers = [TaggedReplayBuffer(50, latent_dim=2, gamma=0.5, keys=KEYS) for _ in range(3)]
    buffers[0].add(whole, "rand")
    indices = buffers[1].extend(whole)
    for row in rows:
        buffers[2].add(row, "rand")
    assert indices.tolist() == list(range(sum(lengths)))
    assert (buffers[0].transitions.storage[:] == buffers[2].transitions.storage[:]).all()
    assert (buffers[0].frames.storage[:] == buffers[2].frames.storage[:]).all()
    same = buffers[1].transitions.storage[:].exclude("tag") == buffers[2].transitions.storage[:].exclude("tag")
    assert same.all()
    assert (buffers[1].transitions.storage[:]["tag"] == 3).all()  # online, where nothing else is said


def test_the_data_tell_their_tag_to_extend():
    buffer = TaggedReplayBuffer(50, latent_dim=2, keys=KEYS)
    one, other = episode(3), episode(2)
    one["tag"] = torch.full((3, 1), 1, dtype=torch.uint8)
    other.set_non_tensor("tag", "constraint")
    buffer.extend([one, other, episode(4)])
    assert [buffer.count(tags=[tag]) for tag in range(4)] == [0, 3, 2, 4]
    one["tag"][1] = 0
    with pytest.raises(ValueError, match=r"one tag, got \[0, 1\]"):
        buffer.extend(one)
    assert len(buffer) == 9


def test_indices_follow_the_ring():
    buffer = TaggedReplayBuffer(5, latent_dim=2, keys=KEYS)
    assert buffer.extend(episode(4)).tolist() == [0, 1, 2, 3]
    assert buffer.extend(episode(3, start=10)).tolist() == [4, 0, 1]
    rows = buffer.transitions.storage[torch.tensor([4, 0, 1])]
    assert rows[KEYS.action].flatten().tolist() == [10, 11, 12]
    assert (buffer.write_count, len(buffer)) == (7, 5)


def test_selections_and_their_fields_draw_the_same():
    buffer = TaggedReplayBuffer(50, latent_dim=2, keys=KEYS)
    buffer.add([episode(6), episode(7)], "success")
    buffer.add(episode(5, start=20), "online")
    buffer.encode(identity())
    filters = {"tags": ["success", "online"], "without": "after_violation", "steps": 2, "online_fraction": 0.4}
    one, two = (
        torch.manual_seed(1) and buffer.sample(30, *args, members=3, **named)
        for args, named in (((RowSelection(**filters),), {}), ((), filters))
    )
    assert one.shape == (30, 3, 2)
    assert (one == two).all()
    assert buffer.view(RowSelection(**filters)) is buffer.view(**filters)
    assert buffer.count(RowSelection(tags=["online"])) == buffer.count(tags="online") == 5
    assert buffer.count() == 18
    for wrong in ({"selection": RowSelection(), "tags": ["rand"]}, {"share": 0.1}, {"selection": ["rand"]}):
        with pytest.raises(TypeError):
            buffer.sample(3, **wrong)


def test_keys_that_the_buffer_needs_are_refused():
    with pytest.raises(ValueError, match=r"keys \['loc'\] are the buffer's own"):
        TaggedReplayBuffer(5, keys=EpisodeKeys(action="loc"))
    with pytest.raises(ValueError, match=r"keys \['tag'\] are the buffer's own"):
        TaggedReplayBuffer(5, extra_keys=["tag"])


def test_nothing_is_stored_when_one_of_the_episodes_lacks_a_key():
    buffer = TaggedReplayBuffer(50, latent_dim=2, keys=KEYS)
    with pytest.raises(KeyError, match="hit"):
        buffer.add([episode(3), episode(3).exclude(KEYS.constraint)], "success")
    assert len(buffer) == len(buffer.frames) == 0
