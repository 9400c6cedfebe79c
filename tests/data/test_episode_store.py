import pytest
import torch
from tensordict import TensorDict

from ls3_torchrl.data.episode_store import EpisodeStore


class Camera:
    """Writes episodes of frames numbered on and on; a transition's action is the number of its first frame."""

    def __init__(self, store):
        self.store, self.frame = store, 0

    def shoot(self, *lengths):
        for steps in lengths:
            number = torch.arange(self.frame, self.frame + steps + 1).unsqueeze(-1)
            self.frame += steps + 1
            frames = TensorDict({"state": number.clone()}, [steps + 1])
            self.store.write(frames, TensorDict({"action": number[:-1].clone()}, [steps]))


def assert_transitions_find_their_frames(store, count):
    rows = store.transitions.storage[:]
    before, after = (store.frames.storage[slot]["state"] for slot in store.slots(rows["frame"]))
    assert torch.equal(before, rows["action"])
    assert torch.equal(after, rows["action"] + 1)
    assert len(rows) == count


@pytest.fixture(params=["memory", "memmap"])
def scratch(request, tmp_path):
    return None if request.param == "memory" else tmp_path / "scratch"


@pytest.mark.parametrize("steps", [1, 2, 3, 7])
def test_short_episodes_keep_all_their_frames(scratch, steps):
    store = EpisodeStore(300, scratch_dir=scratch)
    camera = Camera(store)
    for _ in range(2 * 300 // steps + 1):
        camera.shoot(steps)
        if camera.frame % 5 == 0:
            assert_transitions_find_their_frames(store, len(store.transitions))
    assert_transitions_find_their_frames(store, 300)
    assert store.frame_capacity <= 600


def test_lengths_that_vary_at_random_keep_their_frames_too():
    torch.manual_seed(0)
    store = EpisodeStore(100)
    camera = Camera(store)
    for steps in torch.randint(1, 101, (40,)).tolist() + [1] * 300 + [100] + torch.randint(1, 6, (100,)).tolist():
        camera.shoot(steps)
        assert_transitions_find_their_frames(store, min(len(store.transitions), 100))
    assert store.frame_capacity <= max(200, 100 + 100 // 16 + 64)


def test_no_room_is_made_where_episodes_are_long_enough():
    store = EpisodeStore(320)
    camera = Camera(store)
    camera.shoot(*[16] * 60)
    assert store.frame_capacity == len(store.frames) == 320 + 20 + 64
    assert_transitions_find_their_frames(store, 320)


def test_a_room_that_was_asked_for_does_not_grow():
    store = EpisodeStore(10, frame_capacity=13)
    Camera(store).shoot(*[2] * 9)
    assert store.frame_capacity == 13
    with pytest.raises(RuntimeError, match=r"older than number 14 were overwritten.*need frame 12.*frame_capacity"):
        store.slots(store.transitions.storage[:]["frame"])


@pytest.mark.parametrize("way", ["state_dict", "dumps"])
def test_a_store_that_has_grown_is_restored(tmp_path, way, scratch):
    store, other = EpisodeStore(200, scratch_dir=scratch), EpisodeStore(200, scratch_dir=scratch and scratch / "other")
    camera = Camera(store)
    camera.shoot(*[1] * 450)
    if way == "dumps":
        store.dumps(tmp_path / "dump", {"by": "test"})
        assert EpisodeStore.description(tmp_path / "dump")["by"] == "test"
        other.loads(tmp_path / "dump")
    else:
        other.load_state_dict(store.state_dict())
    assert other.frame_capacity == store.frame_capacity > 200 + 200 // 16 + 64
    for each in (store, other):
        on = Camera(each)
        on.frame = camera.frame
        on.shoot(*[1] * 30)
        assert_transitions_find_their_frames(each, 200)
    for one, two in ((store.frames, other.frames), (store.transitions, other.transitions)):
        assert (one.storage[:] == two.storage[:]).all()


def test_the_scratch_dir_is_no_place_to_save_to(tmp_path):
    store = EpisodeStore(20, scratch_dir=tmp_path)
    Camera(store).shoot(3)
    with pytest.raises(ValueError, match="is the buffer's scratch_dir"):
        store.dumps(tmp_path, {})


def test_a_folder_that_was_not_written_to_its_end_is_refused(tmp_path):
    store = EpisodeStore(20)
    Camera(store).shoot(3)
    store.dumps(tmp_path / "dump", {})
    (tmp_path / "dump" / "buffer.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"holds no saved buffer: buffer\.json is missing"):
        store.loads(tmp_path / "dump")
