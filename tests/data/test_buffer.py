import numpy as np
import pytest
import torch
from tensordict import TensorDict

from ls3_torchrl.data import EpisodeKeys, Tag, TaggedReplayBuffer
from ls3_torchrl.modules import PixelEncoder

D = 4
SCALE = 0.5

# Rings are to wrap round here, whatever is in them.
pytestmark = pytest.mark.filterwarnings("ignore:A buffer of .* is full:ls3_torchrl.data.DataWarning")


def reading_encoder(factor=1.0):
    """An encoder whose loc[0] is ``factor`` times an image's grey value in 0…255, and scale is SCALE."""
    encoder = PixelEncoder(latent_dim=D)
    with torch.no_grad():
        for name, parameter in encoder.named_parameters():
            parameter.zero_()
            if "convolutions" in name and name.endswith("weight"):  # each layer averages what it sees
                parameter.fill_(1 / parameter[0].numel())
            elif "head.weight" in name:
                parameter[0].fill_(255.0 * factor / parameter.shape[1])
            elif "head.bias" in name:
                parameter[D:].fill_(float(torch.tensor(SCALE).log()))
    return encoder


class Camera:
    """Makes episodes of frames numbered on and on: frame k is an image of grey value k, its action is (k, −k)."""

    def __init__(self):
        self.frame = 0

    def shoot(self, steps, success=()):
        number = torch.arange(self.frame, self.frame + steps + 1)
        self.frame += steps + 1
        images = number.to(torch.uint8).reshape(-1, 1, 1, 1).expand(-1, 3, 64, 64).contiguous()
        done = torch.zeros(steps, 1, dtype=torch.bool)
        done[list(success)] = True
        return TensorDict(
            {
                "pixels": images[:-1],
                "action": torch.stack([number[:-1], -number[:-1]], -1).float(),
                "next": {
                    "pixels": images[1:],
                    "reward": done.float() - 1,
                    "constraint": number[:-1, None] % 3 == 0,
                    "success": done,
                },
            },
            [steps],
        )


def assert_rows_show_their_frames(buffer, numbers, factor=1.0):
    """Exactly the transitions of the frames ``numbers`` are stored, each with the posteriors of its two images."""
    rows = buffer.transitions.storage[:]
    number = rows["action"][:, 0]
    assert sorted(number.int().tolist()) == sorted(numbers)
    torch.testing.assert_close(rows["loc"][:, 0], factor * number, atol=1e-2, rtol=0)
    torch.testing.assert_close(rows["next", "loc"][:, 0], factor * (number + 1), atol=1e-2, rtol=0)
    for scale in (rows["scale"], rows["next", "scale"]):
        torch.testing.assert_close(scale, torch.full_like(scale, SCALE), atol=1e-3, rtol=0)


@pytest.fixture(params=["memory", "memmap"])
def scratch(request, tmp_path):
    return None if request.param == "memory" else tmp_path / "scratch"


def test_labels_and_tags_are_right_by_hand(scratch):
    camera = Camera()
    buffer = TaggedReplayBuffer(20, latent_dim=D, gamma=0.5, scratch_dir=scratch)
    buffer.add(camera.shoot(3, success=[1]), "success")
    buffer.add(camera.shoot(2), Tag.CONSTRAINT)
    rows = buffer.transitions.storage[:]
    assert len(buffer) == 5
    assert rows["tag"].flatten().tolist() == [0, 0, 0, 2, 2]
    assert rows["in_success"].flatten().tolist() == [True, True, False, False, False]
    assert rows["timed_out"].flatten().tolist() == [False, False, False, True, True]
    assert rows["after_violation"].flatten().tolist() == [False, True, True, False, False]
    assert rows["reward_to_go"].flatten().tolist() == [-1.25, -0.5, -1.0, -1.5, -1.0]
    assert rows["next", "success"].flatten().tolist() == [False, True, False, False, False]
    assert rows["next", "reward"].flatten().tolist() == [-1.0, 0.0, -1.0, -1.0, -1.0]
    assert rows["next", "constraint"].flatten().tolist() == [True, False, False, False, False]
    assert [buffer.count(tags=[tag]) for tag in Tag] == [3, 0, 2, 0]
    assert buffer.count() == 5
    assert scratch is None or any((scratch / "frames").iterdir())


def test_a_success_tail_keeps_the_labels_and_leaves_the_idle_end_out(scratch):
    camera = Camera()
    kept, whole = (
        TaggedReplayBuffer(20, latent_dim=D, gamma=0.5, scratch_dir=scratch and scratch / name, success_tail=tail)
        for name, tail in (("kept", 2), ("whole", None))
    )
    episode = camera.shoot(8, success=[3, 4, 5, 6, 7])
    for buffer in (kept, whole):
        buffer.add(episode, "success")
        buffer.add(camera.shoot(2), "constraint")
    assert (len(kept), len(whole)) == (5 + 2, 8 + 2)
    for key in ("reward_to_go", "in_success", "timed_out", "after_violation", "action", ("next", "success")):
        assert torch.equal(kept.transitions.storage[:][key][:5], whole.transitions.storage[:][key][:5]), key
    # Stretches end with what was kept, and every row finds its own frames.
    assert kept.transitions.storage[:]["steps_left"].flatten().tolist() == [5, 4, 3, 2, 1, 2, 1]
    kept.encode(reading_encoder())
    rows = kept.transitions.storage[:5]
    torch.testing.assert_close(rows["next", "loc"][:, 0] - rows["loc"][:, 0], torch.ones(5), atol=1e-2, rtol=0)
    with pytest.raises(ValueError, match="success_tail must be at least 1"):
        TaggedReplayBuffer(20, success_tail=0)


def test_extra_keys_are_kept_and_asked_for():
    camera = Camera()
    buffer = TaggedReplayBuffer(20, latent_dim=D, extra_keys=["wish", ("next", "cost")])
    episode = camera.shoot(3)
    with pytest.raises(KeyError, match="wish"):
        buffer.add(episode, "success")
    episode["wish"], episode["next", "cost"] = 2 * episode["action"], episode["action"][:, :1] + 1
    buffer.add(episode, "success")
    buffer.encode(reading_encoder())
    rows = buffer.sample(30)
    assert torch.equal(rows["wish"], 2 * rows["action"])
    assert torch.equal(rows["next", "cost"], rows["action"][:, :1] + 1)


@pytest.mark.parametrize("encoded", [True, False])
def test_pixels_come_with_their_rows_and_need_no_encoder(scratch, encoded):
    camera = Camera()
    buffer = TaggedReplayBuffer(10, latent_dim=D, frame_capacity=13, scratch_dir=scratch)
    for _ in range(5):  # overwrites
        buffer.add(camera.shoot(4), "online")
    if encoded:
        buffer.encode(reading_encoder())
    else:
        with pytest.raises(RuntimeError, match="no latents yet"):
            buffer.sample(4)
    rows = buffer.sample(40, observations=True, members=2)
    assert rows["pixels"].shape == (40, 2, 3, 64, 64)
    assert torch.equal(rows["pixels"][..., 0, 0, 0].float(), rows["action"][..., 0])
    assert torch.equal(rows["next", "pixels"][..., 0, 0, 0].float(), rows["action"][..., 0] + 1)
    assert (rows["loc"][..., 0] > 0).any() == encoded


def test_frames_match_rows_when_encoded_at_the_end(scratch):
    camera = Camera()
    buffer = TaggedReplayBuffer(20, latent_dim=D, scratch_dir=scratch)
    buffer.add(camera.shoot(3), "success")
    buffer.add(camera.shoot(4), "rand")
    buffer.encode(reading_encoder())
    # Frames 3 and 8 end their episodes: they start no transition.
    assert_rows_show_their_frames(buffer, [0, 1, 2, 4, 5, 6, 7])


def test_frames_match_rows_of_episodes_added_after_encoding(scratch):
    camera = Camera()
    buffer = TaggedReplayBuffer(20, latent_dim=D, scratch_dir=scratch)
    buffer.encode(reading_encoder())  # nothing there yet
    buffer.add(camera.shoot(3), "success")
    assert_rows_show_their_frames(buffer, [0, 1, 2])


def test_both_rings_wrap_round_and_keep_images_labels_and_tags_together(scratch):
    camera = Camera()
    buffer = TaggedReplayBuffer(10, latent_dim=D, gamma=0.5, frame_capacity=14, scratch_dir=scratch)
    buffer.add(camera.shoot(4), "online")  # frames 0 to 4
    buffer.add(camera.shoot(4, success=[3]), "rand")  # 5 to 9
    buffer.encode(reading_encoder())
    buffer.add(camera.shoot(4, success=[0]), "online")  # 10 to 14: both stores write over their oldest
    left = [2, 3, 5, 6, 7, 8, 10, 11, 12, 13]
    assert len(buffer) == 10
    assert len(buffer.frames) == 14
    assert_rows_show_their_frames(buffer, left)
    # A better encoder later must find each row's images again, in the ring as it lies now.
    buffer.encode(reading_encoder(factor=2.0))
    assert_rows_show_their_frames(buffer, left, factor=2.0)
    rows = buffer.transitions.storage[:]
    by_frame = dict(zip(rows["action"][:, 0].int().tolist(), range(10), strict=True))
    order = [by_frame[number] for number in left]
    assert rows["tag"].flatten()[order].tolist() == [3, 3, 1, 1, 1, 1, 3, 3, 3, 3]
    assert rows["in_success"].flatten()[order].tolist() == [False] * 2 + [True] * 5 + [False] * 3
    expected = [-1.5, -1.0, -1.75, -1.5, -1.0, 0.0, -0.875, -1.75, -1.5, -1.0]
    assert rows["reward_to_go"].flatten()[order].tolist() == expected
    assert [buffer.count(tags=[tag]) for tag in Tag] == [0, 4, 0, 6]
    shown = buffer.frames.storage[:]["pixels"][:, 0, 0, 0]
    assert sorted(shown.tolist()) == list(range(1, 15))


def test_offline_data_stay_while_online_episodes_come_and_go(scratch):
    camera = Camera()
    buffer = TaggedReplayBuffer(12, latent_dim=D, scratch_dir=scratch)
    buffer.add(camera.shoot(2, success=[1]), "success")  # frames 0 to 2
    buffer.encode(reading_encoder())
    buffer.add(camera.shoot(3), "constraint")  # 3 to 6
    for round_ in range(30):
        buffer.add(camera.shoot(3), "online")
        newest = [camera.frame - 4 * age + step for age in range(min(round_ + 1, 3)) for step in (-4, -3, -2)]
        # Seven transitions of online episodes: the last two whole, and one of the episode before.
        assert_rows_show_their_frames(buffer, [0, 1, 3, 4, 5, *sorted(newest)[-7:]])
    assert [buffer.count(tags=[tag]) for tag in Tag] == [2, 0, 3, 7]
    pairs = buffer.sample(200, steps=2)["action"][..., 0]
    assert torch.equal(pairs[:, 1], pairs[:, 0] + 1)
    assert {0, 3, 4} < set(pairs[:, 0].int().tolist())
    # Those that begin before a violation, which follows frames 0, 3, 6, …, are left out over the ring's end as well.
    safe = buffer.sample(200, steps=2, without="after_violation")["action"][..., 0].int()
    assert not any(buffer.transitions.storage[:]["after_violation"][rows_of(buffer, safe.flatten())])


def rows_of(buffer, numbers):
    where = {int(number): row for row, number in enumerate(buffer.transitions.storage[:]["action"][:, 0])}
    return [where[number] for number in numbers.tolist()]


@pytest.mark.parametrize("way", ["state_dict", "dumps"])
def test_what_is_kept_is_kept_by_a_restored_buffer_too(tmp_path, scratch, way):
    camera = Camera()
    buffer, other = (TaggedReplayBuffer(12, latent_dim=D, scratch_dir=scratch and scratch / name) for name in "ab")
    buffer.add(camera.shoot(5), "success")
    for _ in range(5):
        buffer.add(camera.shoot(3), "online")
    if way == "dumps":
        buffer.dumps(tmp_path / "saved")
        other.loads(tmp_path / "saved")
    else:
        other.load_state_dict(buffer.state_dict())
    for _ in range(4):
        episode = camera.shoot(3)
        for each in (buffer, other):
            each.add(episode, "online")
    for each in (buffer, other):
        each.encode(reading_encoder())
        assert each.count(tags=["success"]) == 5
    assert (buffer.transitions.storage[:] == other.transitions.storage[:]).all()
    assert (buffer.frames.storage[:] == other.frames.storage[:]).all()


@pytest.mark.parametrize("way", ["state_dict", "dumps"])
def test_a_buffer_with_content_takes_over_what_was_saved(tmp_path, scratch, way):
    camera = Camera()
    buffer, other = (TaggedReplayBuffer(20, latent_dim=D, scratch_dir=scratch and scratch / name) for name in "ab")
    buffer.add(camera.shoot(5), "success")
    other.add(camera.shoot(9), "online")
    if way == "dumps":
        buffer.dumps(tmp_path / "saved")
        other.loads(tmp_path / "saved")
    else:
        other.load_state_dict(buffer.state_dict())
    assert (other.frames.storage[:] == buffer.frames.storage[:]).all()
    assert other.count(tags=["success"]) == len(other) == 5


def test_offline_data_that_cannot_all_be_kept_are_refused_whole():
    camera = Camera()
    buffer = TaggedReplayBuffer(10, latent_dim=D)
    with pytest.raises(ValueError, match=r"have 12 transitions.*room for 10\. Raise capacity"):
        buffer.add(torch.stack([camera.shoot(4) for _ in range(3)]), "success")
    assert len(buffer) == 0
    buffer.add(camera.shoot(8), "success")
    with pytest.raises(ValueError, match=r"3 steps does not fit.*of which 8 and 9 hold offline data.*Raise capacity"):
        buffer.add(camera.shoot(3), "online")
    assert len(buffer) == 8
    buffer.add(camera.shoot(2), "success")
    with pytest.raises(ValueError, match="1 steps does not fit"):
        buffer.add(camera.shoot(1), "online")


def test_frames_of_offline_data_need_room_too():
    camera = Camera()
    buffer = TaggedReplayBuffer(10, latent_dim=D, frame_capacity=10)
    with pytest.raises(ValueError, match=r"of which 6 and 8 hold offline data.*Raise frame_capacity"):
        buffer.add([camera.shoot(3), camera.shoot(3), camera.shoot(3)], "success")
    assert len(buffer) == len(buffer.frames) == 0


def test_short_offline_episodes_leave_room_for_frames_of_online_ones():
    camera = Camera()
    buffer = TaggedReplayBuffer(100, latent_dim=D)
    for _ in range(60):
        buffer.add(camera.shoot(1), "success")  # two frames for each transition
    for steps in (1, 2, 1, 40, 1, 39, 7, 40):
        buffer.add(camera.shoot(steps), "online")
        assert len(buffer.sample_frame_transitions(50)) == 50
    buffer.encode(reading_encoder())
    assert buffer.count(tags=["success"]) == 60
    assert buffer.count(tags=["online"]) == 40
    assert buffer.frame_capacity <= 200


def test_many_rounds_of_the_ring_stay_consistent():
    camera = Camera()
    buffer = TaggedReplayBuffer(9, latent_dim=D, frame_capacity=13)
    for i, steps in enumerate([5, 3, 7, 2, 6, 4, 8, 5]):
        buffer.add(camera.shoot(steps), "online")
        if i == 3:
            buffer.encode(reading_encoder())
    # The last nine transitions: the last five of the camera, and four of the eight before.
    last = camera.frame - 6
    assert_rows_show_their_frames(buffer, [*range(last - 5, last - 1), *range(last, last + 5)])


def test_a_batch_of_episodes_is_stored_one_after_another():
    camera = Camera()
    buffer = TaggedReplayBuffer(20, latent_dim=D, gamma=0.5)
    buffer.add(torch.stack([camera.shoot(3), camera.shoot(3, success=[2])]), "success")
    buffer.encode(reading_encoder())
    assert_rows_show_their_frames(buffer, [0, 1, 2, 4, 5, 6])
    # Labels stop at the end: the second episode's success is not the first one's.
    assert buffer.transitions.storage[:]["in_success"].flatten().tolist() == [False] * 3 + [True] * 3


def test_overwritten_frames_are_refused_at_encoding_not_mixed_up():
    camera = Camera()
    buffer = TaggedReplayBuffer(10, latent_dim=D, frame_capacity=10)
    for _ in range(3):
        buffer.add(camera.shoot(4), "online")
    with pytest.raises(RuntimeError, match=r"older than number 5 were overwritten.*need frame 2.*frame_capacity"):
        buffer.encode(reading_encoder())


def test_latents_are_drawn_anew_from_the_posterior_at_each_use():
    torch.manual_seed(0)
    camera = Camera()
    buffer = TaggedReplayBuffer(20, latent_dim=D)
    buffer.add(camera.shoot(1), "success")  # one row: every draw is of frames 0 and 1
    buffer.encode(reading_encoder())
    batch = buffer.sample(4000)
    for group in (batch, batch["next"]):
        noise = (group["latent"] - group["loc"]) / SCALE
        # 16,000 standard normals: mean 0 ± 0.008, deviation 1 ± 0.006.
        assert noise.mean().abs() < 0.04
        assert (noise.std() - 1).abs() < 0.03
    here, there = ((group["latent"] - group["loc"]).flatten() for group in (batch, batch["next"]))
    assert torch.corrcoef(torch.stack([here, there]))[0, 1].abs() < 0.04
    assert "latent" not in set(buffer.transitions.storage[:].keys())  # drawn, never stored


def test_members_get_batches_of_their_own():
    torch.manual_seed(0)
    camera = Camera()
    buffer = TaggedReplayBuffer(20, latent_dim=D)
    buffer.add(camera.shoot(8), "success")
    buffer.encode(reading_encoder())
    batch = buffer.sample(6400, members=2)
    assert batch.batch_size == (6400, 2)
    assert batch["latent"].shape == (6400, 2, D)
    assert batch["next", "latent"].shape == (6400, 2, D)
    assert batch["tag"].shape == (6400, 2, 1)
    # Independence: each of the 8 × 8 pairs of rows is due 100 of the draws, give or take 10.
    pair = batch["action"][:, 0, 0].long() * 8 + batch["action"][:, 1, 0].long()
    assert (torch.bincount(pair, minlength=64) - 100).abs().max() < 50
    # Rows and latents still belong together.
    assert (batch["latent"][..., 0] - batch["action"][..., 0]).abs().max() < 7 * SCALE


def test_sample_honours_tags_added_before_and_after_a_view_was_made():
    camera = Camera()
    buffer = TaggedReplayBuffer(40, latent_dim=D)
    buffer.encode(reading_encoder())
    buffer.add(camera.shoot(2), "success")
    assert set(buffer.sample(64, tags=["success"])["tag"].flatten().tolist()) == {0}
    buffer.add(camera.shoot(2), "online")
    buffer.add(camera.shoot(2), "success")
    frames = buffer.sample(500, tags=["success"])["action"][:, 0]
    assert set(frames.int().tolist()) == {0, 1, 6, 7}
    assert set(buffer.sample(500)["tag"].flatten().tolist()) == {0, 3}


@pytest.mark.parametrize("how", [{}, {"members": 2}, {"steps": 2}, {"without": "after_violation"}])
def test_online_rows_have_their_share_of_every_kind_of_batch(how):
    torch.manual_seed(0)
    camera = Camera()
    buffer = TaggedReplayBuffer(200, latent_dim=D)
    buffer.encode(reading_encoder())
    for _ in range(30):  # a frame in three violates, and what comes after it is frozen
        buffer.add(camera.shoot(3), "success")
    buffer.add(camera.shoot(5), "online")
    batch = buffer.sample(400, online_fraction=0.5, **how)
    assert batch.batch_size[0] == 400
    assert (batch["tag"] == int(Tag.ONLINE)).float().mean() == 0.5
    assert (buffer.sample(400, **how)["tag"] == int(Tag.ONLINE)).float().mean() < 0.25
    # What is asked of rows holds for both parts.
    if "without" in how:
        assert buffer.transitions.storage[:]["after_violation"].any()
        assert not batch["after_violation"].any()
    if "steps" in how:
        number = batch["action"][..., 0]
        assert (number[:, 1] == number[:, 0] + 1).all()


def test_sample_without_rows_of_the_tag_names_it():
    buffer = TaggedReplayBuffer(20, latent_dim=D)
    buffer.add(Camera().shoot(2), "success")
    buffer.encode(reading_encoder())
    with pytest.raises(RuntimeError, match="no data tagged 'constraint'"):
        buffer.sample(4, tags=["constraint"])


def test_sample_before_encoding_says_what_to_do():
    buffer = TaggedReplayBuffer(20, latent_dim=D)
    buffer.add(Camera().shoot(2), "success")
    with pytest.raises(RuntimeError, match=r"call buffer\.encode"):
        buffer.sample(4)


def test_pixels_are_sampled_uniformly_from_all_frames_last_ones_included(scratch):
    torch.manual_seed(0)
    buffer = TaggedReplayBuffer(20, latent_dim=D, scratch_dir=scratch)
    with pytest.raises(RuntimeError, match="no frames yet"):
        buffer.sample_frames(4)
    buffer.add(Camera().shoot(3), "success")
    pixels = buffer.sample_frames(400)["pixels"]
    assert pixels.dtype == torch.uint8
    assert pixels.shape == (400, 3, 64, 64)
    assert (torch.bincount(pixels[:, 0, 0, 0].long(), minlength=4) - 100).abs().max() < 45


def test_pixel_transitions_join_both_images_to_their_action_after_the_ring_wrapped(scratch):
    torch.manual_seed(0)
    camera = Camera()
    buffer = TaggedReplayBuffer(10, latent_dim=D, frame_capacity=13, scratch_dir=scratch)
    for tag in ("online", "constraint", "success"):
        buffer.add(camera.shoot(4), tag)
    batch = buffer.sample_frame_transitions(400)  # no encoder yet
    number = batch["action"][:, 0].int()
    assert set(number.tolist()) == {2, 3, 5, 6, 7, 8, 10, 11, 12, 13}
    assert torch.equal(batch["pixels"][:, 0, 0, 0].int(), number)
    assert torch.equal(batch["next", "pixels"][:, 2, 5, 7].int(), number + 1)
    assert set(buffer.sample_frame_transitions(200, tags=["success"])["action"][:, 0].tolist()) == {10, 11, 12, 13}


def test_stretches_follow_one_episode_over_the_rings_end(scratch):
    torch.manual_seed(0)
    camera = Camera()
    buffer = TaggedReplayBuffer(10, latent_dim=D, scratch_dir=scratch)
    for tag in ("online", "constraint", "success"):
        buffer.add(camera.shoot(4), tag)
    # Left of frames 0-3, 5-8, 10-13: transitions 2, 3, 5-8, 10-13, of which the last lie at the ring's start.
    pixels = buffer.sample_frame_transitions(200, steps=3)
    number = pixels["action"][..., 0].int()
    assert set(number[:, 0].tolist()) == {5, 6, 10, 11}
    assert torch.equal(number, number[:, :1] + torch.arange(3))
    assert torch.equal(pixels["pixels"][:, 0, 0, 0].int(), number[:, 0])
    assert torch.equal(pixels["next", "pixels"][:, 0, 0, 0].int(), number[:, -1] + 1)
    buffer.encode(reading_encoder())
    rows = buffer.sample(100, members=2, steps=2, without="after_violation")
    assert rows.shape == (100, 2, 2)
    number = rows["action"][..., 0]
    # Frames 3, 6, 9 and 12 lead to violations, after which an episode is frozen.
    assert set(number[..., 0].int().flatten().tolist()) == {5, 10, 11}
    assert torch.equal(number[..., 1], number[..., 0] + 1)
    torch.testing.assert_close(rows["loc"][..., 0], number, atol=1e-2, rtol=0)
    torch.testing.assert_close(rows["next", "loc"][..., 0], number + 1, atol=1e-2, rtol=0)


def test_pixel_transitions_whose_images_are_gone_are_refused():
    camera = Camera()
    buffer = TaggedReplayBuffer(10, latent_dim=D, frame_capacity=10)
    for _ in range(3):
        buffer.add(camera.shoot(4), "online")
    with pytest.raises(RuntimeError, match=r"older than number 5 were overwritten.*frame_capacity"):
        buffer.sample_frame_transitions(200)


@pytest.mark.parametrize(("key", "what"), [("action", "action"), (("next", "reward"), "reward")])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_numbers_that_are_not_finite_never_get_in(key, what, bad):
    episode = Camera().shoot(3)
    episode[key][1, 0] = bad
    buffer = TaggedReplayBuffer(20, latent_dim=D)
    with pytest.raises(ValueError, match=f"{what}.* is not finite: 1 of"):
        buffer.add(episode, "success")
    assert len(buffer) == len(buffer.frames) == 0


def test_missing_keys_wrong_shapes_and_unknown_tags_are_refused():
    episode = Camera().shoot(3)
    buffer = TaggedReplayBuffer(20, latent_dim=D)
    with pytest.raises(KeyError, match="constraint"):
        buffer.add(episode.exclude(("next", "constraint")), "success")
    with pytest.raises(ValueError, match=r"\[T\] or \[N, T\], got \[1, 1, 3\]"):
        buffer.add(episode[None, None], "success")
    with pytest.raises(ValueError, match="Unknown tag"):
        buffer.add(episode, "demos")
    assert len(buffer) == 0


@pytest.mark.parametrize("sizes", [{"capacity": 3}, {"capacity": 20, "frame_capacity": 4}])
def test_an_episode_longer_than_the_buffer_is_refused(sizes):
    with pytest.raises(ValueError, match="4 steps does not fit"):
        TaggedReplayBuffer(latent_dim=D, **sizes).add(Camera().shoot(4), "online")


@pytest.mark.parametrize(
    "sizes", [{"capacity": 0}, {"capacity": 5, "frame_capacity": 1}, {"capacity": 5, "latent_dim": 0}]
)
def test_impossible_sizes_are_refused(sizes):
    with pytest.raises(ValueError, match="must be at least"):
        TaggedReplayBuffer(**sizes)


def test_an_encoder_of_another_size_is_refused():
    buffer = TaggedReplayBuffer(20, latent_dim=D)
    buffer.add(Camera().shoot(2), "success")
    with pytest.raises(ValueError, match=r"latents of size 6.*latent_dim=4"):
        buffer.encode(PixelEncoder(latent_dim=6))


def test_the_default_pixel_store_keeps_all_frames_of_the_stored_rows():
    # Short episodes have many frames that start no transition; 16 steps are what the default allows for.
    camera = Camera()
    buffer = TaggedReplayBuffer(96, latent_dim=D)
    for _ in range(8):
        buffer.add(camera.shoot(16), "online")
    buffer.encode(reading_encoder())
    assert_rows_show_their_frames(buffer, [i for i in range(34, 136) if i % 17 != 16])


def test_encoding_reports_its_progress():
    buffer = TaggedReplayBuffer(20, latent_dim=D)
    buffer.add(Camera().shoot(5), "success")
    calls = []
    buffer.encode(reading_encoder(), progress=lambda done, total: calls.append((done, total)))
    assert calls[-1] == (6, 6)


def test_the_mean_frame_is_that_of_all_frames_in_unit_floats(scratch):
    buffer = TaggedReplayBuffer(20, latent_dim=D, scratch_dir=scratch)
    buffer.add(Camera().shoot(9), "success")  # grey values 0 to 9
    torch.manual_seed(0)
    mean = buffer.mean_frame(frames=20_000)
    assert mean.shape == (3, 64, 64)
    torch.testing.assert_close(mean, torch.full_like(mean, 4.5 / 255), atol=0.1 / 255, rtol=0)


@pytest.mark.parametrize("encoded", [True, False])
def test_a_buffer_full_of_short_episodes_still_has_their_frames(scratch, encoded):
    camera = Camera()
    buffer = TaggedReplayBuffer(90, latent_dim=D, scratch_dir=scratch)
    if encoded:
        buffer.encode(reading_encoder())
    room = buffer.frame_capacity
    for _ in range(120):
        buffer.add(camera.shoot(1), "online")
        camera.frame %= 250  # grey values are bytes
    assert buffer.frame_capacity > room
    buffer.encode(reading_encoder())
    rows = buffer.transitions.storage[:]
    assert len(rows) == 90
    torch.testing.assert_close(rows["loc"][:, 0], rows["action"][:, 0], atol=1e-2, rtol=0)
    torch.testing.assert_close(rows["next", "loc"][:, 0], rows["action"][:, 0] + 1, atol=1e-2, rtol=0)
    batch = buffer.sample_frame_transitions(50)
    assert torch.equal(batch["pixels"][:, 0, 0, 0].float(), batch["action"][:, 0])


def test_a_scratch_folder_never_costs_what_was_saved(tmp_path):
    camera = Camera()
    buffer = TaggedReplayBuffer(20, latent_dim=D)
    buffer.add(camera.shoot(3), "success")
    buffer.dumps(tmp_path / "saved")
    other = TaggedReplayBuffer(20, latent_dim=D, scratch_dir=tmp_path / "saved")
    with pytest.raises(FileExistsError, match="not a replay buffer's to remove"):
        other.add(camera.shoot(2), "success")
    with pytest.raises(FileExistsError):
        other.loads(tmp_path / "saved")
    again = TaggedReplayBuffer(20, latent_dim=D)
    again.loads(tmp_path / "saved")
    assert len(again) == 3
    # Nor a memory map of the user's own, which TensorDict marks alike.
    TensorDict({"x": torch.ones(2)}, [2]).memmap(str(tmp_path / "mine" / "frames"))
    with pytest.raises(FileExistsError):
        TaggedReplayBuffer(20, latent_dim=D, scratch_dir=tmp_path / "mine").add(camera.shoot(2), "success")
    assert TensorDict.load_memmap(str(tmp_path / "mine" / "frames"))["x"].sum() == 2


@pytest.mark.parametrize("changes", [{"observation": ("latent", "x")}, {"reward": ("next", "loc", "r")}])
def test_keys_above_or_below_the_buffers_own_are_refused(changes):
    with pytest.raises(ValueError, match="are the buffer's own"):
        TaggedReplayBuffer(20, keys=EpisodeKeys(**changes))


def test_a_buffer_made_with_numbers_of_numpy_can_be_saved(tmp_path):
    numbers = {"latent_dim": np.int64(D), "gamma": np.float32(0.5), "success_tail": np.int64(2)}
    buffer = TaggedReplayBuffer(np.int64(20), **numbers)
    buffer.add(Camera().shoot(3), "success")
    buffer.dumps(tmp_path / "saved")
    again = TaggedReplayBuffer(20, latent_dim=D, gamma=0.5, success_tail=2)
    again.loads(tmp_path / "saved")
    assert len(again) == 3
