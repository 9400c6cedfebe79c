"""Batches drawn ahead: the same for one seed, of the buffer as it is, and going on where a state was taken."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from ls3_torchrl.data import BatchStream, RowSelection, TaggedReplayBuffer
from ls3_torchrl.data import stream as stream_module

READS = TensorDictModule(torch.nn.Linear(4, 1), in_keys=["latent"], out_keys=["anything"])


def episode(first, steps=10):
    """An episode whose observations count up from a number."""
    frames = (first + torch.arange(steps + 1.0)).unsqueeze(-1).expand(-1, 4)
    no = torch.zeros(steps, 1, dtype=torch.bool)
    step = {"pixels": frames[1:], "reward": -torch.ones(steps, 1), "constraint": no, "success": no}
    return TensorDict({"pixels": frames[:-1], "action": torch.zeros(steps, 2), "next": step}, [steps])


class Uncertain(torch.nn.Module):
    """Latents that are the observations, give or take a hundredth."""

    def forward(self, pixels):
        return pixels, torch.full_like(pixels, 0.01)


@pytest.fixture
def buffer():
    filled = TaggedReplayBuffer(capacity=200, latent_dim=4)
    for i, tag in enumerate(("success", "constraint", "rand")):
        filled.add(episode(100.0 * i), tag)
    filled.encode(TensorDictModule(Uncertain(), ["pixels"], ["loc", "scale"]))
    return filled


def stream_of(buffer, size=8, seed=0, **options):
    stream = BatchStream(buffer, size, reads=READS, **options)
    stream.seed(seed)
    return stream


def test_a_seed_gives_one_stream_whatever_else_draws_random_numbers(buffer):
    one, other = stream_of(buffer), stream_of(buffer)
    for _ in range(5):
        first = one()["latent"]
        torch.randn(17)
        buffer.sample(3)
        assert torch.equal(first, other()["latent"])
    assert not torch.equal(stream_of(buffer, seed=1)()["latent"], stream_of(buffer)()["latent"])


def test_drawing_leaves_pytorchs_own_stream_alone(buffer):
    stream, before = stream_of(buffer), torch.get_rng_state()
    stream()
    assert torch.equal(torch.get_rng_state(), before)


def test_latents_are_drawn_around_the_posteriors_of_rows_of_the_selection(buffer):
    rows = stream_of(buffer, 2000, selection=RowSelection(tags=["constraint"]), extra_keys=["loc", "action"])()
    assert sorted(rows.keys()) == ["action", "latent", "loc"]
    assert set(rows["loc"][:, 0].tolist()) == {100.0 + i for i in range(10)}
    noise = (rows["latent"] - rows["loc"]) / 0.01
    assert abs(noise.mean()) < 0.05
    assert abs(noise.std() - 1.0) < 0.05
    counts = rows["loc"][:, 0].unique(return_counts=True)[1]
    assert counts.min() > 130  # 200 of each are expected, give or take 14


def test_members_get_batches_of_their_own_that_are_drawn_alike(buffer):
    rows = stream_of(buffer, 500, members=3, extra_keys=["loc"], selection=RowSelection(online_fraction=0.0))()
    assert rows.shape == (500, 3)
    first, second, third = rows["loc"][..., 0].unbind(1)
    assert not torch.equal(first, second)
    assert not torch.equal(second, third)
    for member in (first, second, third):
        assert len(member.unique()) == 30


def test_every_member_gets_its_share_of_online_rows(buffer):
    buffer.add(episode(900.0), "online")
    rows = stream_of(buffer, 100, members=2, extra_keys=["loc"], selection=RowSelection(online_fraction=0.5))()
    online = (rows["loc"][..., 0] >= 900.0).float().mean(0)
    assert ((online > 0.35) & (online < 0.65)).all()


def test_stretches_are_steps_of_one_episode(buffer):
    rows = stream_of(buffer, 16, members=2, selection=RowSelection(steps=3), extra_keys=["loc"])()
    assert rows.shape == (16, 2, 3)
    start = rows["loc"][..., 0, 0]
    assert torch.equal(rows["loc"][..., 1, 0], start + 1)
    assert torch.equal(rows["loc"][..., 2, 0], start + 2)


def test_what_was_drawn_before_the_buffer_changed_is_left_aside(buffer):
    stream = stream_of(buffer, 1000, extra_keys=["loc"])
    assert stream()["loc"].max() < 300.0
    buffer.add(episode(900.0), "online")
    assert stream()["loc"].max() >= 900.0


def test_an_entry_that_is_asked_for_later_is_there_at_once(buffer):
    stream = stream_of(buffer)
    assert "action" not in stream()
    stream.extra_keys = ("action",)
    assert "action" in stream()


@pytest.mark.parametrize("taken", [0, 1, 5])
def test_a_state_goes_on_with_the_next_batch(buffer, taken):
    stream = stream_of(buffer, 8000)  # four at once
    for _ in range(taken):
        stream()
    other = BatchStream(buffer, 8000, reads=READS)
    other.load_state_dict(stream.state_dict())
    for _ in range(6):
        assert torch.equal(stream()["latent"], other()["latent"])


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda stream: pickle.loads(pickle.dumps(stream))])
def test_copies_go_on_with_the_same_batches(buffer, duplicate):
    stream = stream_of(buffer)
    stream()
    other = duplicate(stream)
    assert other.buffer is not buffer
    for _ in range(3):
        assert torch.equal(stream()["latent"], other()["latent"])


def test_a_change_is_made_to_the_batch_and_not_to_what_is_drawn(buffer):
    def double(rows):
        return rows.set("latent", 2.0 * rows["latent"])

    plain, changed = stream_of(buffer), stream_of(buffer, change=double)
    assert torch.equal(changed()["latent"], 2.0 * plain()["latent"])


def test_without_encoder_or_rows_the_first_batch_says_so(buffer):
    empty = TaggedReplayBuffer(capacity=200, latent_dim=4)
    empty.add(episode(0.0), "success")
    with pytest.raises(RuntimeError, match=r"call buffer\.encode"):
        stream_of(empty)()
    with pytest.raises(RuntimeError, match="online"):
        stream_of(buffer, selection=RowSelection(tags=["online"]))()
    with pytest.raises(KeyError, match="nowhere"):
        stream_of(buffer, extra_keys=["nowhere"])()


def test_a_state_from_the_end_of_what_was_drawn_goes_on(buffer, monkeypatch):
    monkeypatch.setattr(stream_module, "_ROWS", 24)  # three batches of eight
    uncut = stream_of(buffer)
    batches = [uncut()["latent"] for _ in range(7)]
    for taken in range(7):
        stopped = stream_of(buffer)
        for _ in range(taken):
            stopped()
        for other in (stream_of(buffer), copy.deepcopy(stopped)):
            if other.buffer is buffer:
                other.load_state_dict(stopped.state_dict())
            assert all(torch.equal(other()["latent"], batch) for batch in batches[taken:])
