import gymnasium
import minari
import numpy as np
import pytest
import torch
from minari.data_collector import EpisodeBuffer
from torchrl.data import Bounded

from ls3_torchrl.data import (
    DataWarning,
    EpisodeKeys,
    Tag,
    TaggedReplayBuffer,
    check_datasets,
    episode_from_arrays,
    load_minari,
    save_minari,
)

pytestmark = pytest.mark.usefixtures("root")
SPEC = Bounded(-1.0, 1.0, shape=(2,))


@pytest.fixture
def root(tmp_path, monkeypatch):
    """A folder for Minari's datasets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def episode(steps, *, violates=False, succeeds=True, state=False, keys=None):
    rng = np.random.default_rng(steps)
    reached = np.arange(steps) == (steps - 1 if succeeds else steps)
    hit = np.arange(steps) == (steps // 2 if violates else steps)
    pixels = rng.integers(0, 256, (steps + 1, 3, 64, 64), dtype=np.uint8)
    made = episode_from_arrays(pixels, rng.uniform(-1, 1, (steps, 2)), reached - 1.0, hit, reached, keys=keys)
    if state:
        values = torch.tensor(rng.normal(size=(steps + 1, 4)), dtype=torch.float32)
        made["arm", "state"], made["next", "arm", "state"] = values[:-1], values[1:]
    return made


def data(**options):
    return {
        Tag.SUCCESS: [episode(5, **options), episode(3, **options)],
        Tag.CONSTRAINT: [episode(4, violates=True, succeeds=False, **options)],
        Tag.ONLINE: [episode(1, **options)],
    }


def assert_same_bits(written, read):
    """All that was written is there again, with shapes, types and bits."""
    for key in written.keys(True, True):
        assert written[key].dtype == read[key].dtype
        assert written[key].shape == read[key].shape
        assert torch.equal(*(each[key].contiguous().view(torch.uint8) for each in (written, read))), key


def assert_all_same(written, read):
    assert list(read) == sorted(written)
    for tag, rows in written.items():
        assert len(rows) == len(read[tag])
        for row, other in zip(rows, read[tag].unbind(0), strict=True):
            assert_same_bits(row, other)


def test_what_is_written_comes_back_bit_by_bit_with_its_tags():
    save_minari(data(), "mine/robot-v0", author="me")
    read = load_minari("mine/robot-v0")
    assert_all_same(data(), read)
    assert read[Tag.SUCCESS].batch_size[0] == 2


@pytest.mark.parametrize("data_format", ["arrow", "parquet"])
def test_minaris_other_formats_keep_the_bits_too(data_format):
    save_minari(data(), "mine/robot-v0", data_format=data_format)
    assert_all_same(data(), load_minari("mine/robot-v0"))


def test_tuples_of_observations_are_named_by_their_numbers():
    both = (np.full((5, 48, 64, 3), 7, dtype=np.uint8), np.zeros((5, 2), dtype=np.float32))
    space = gymnasium.spaces.Tuple([BOX(0, 255, (48, 64, 3), np.uint8), BOX(-1, 1, (2,))])
    dataset = foreign(observations=both, space=space)
    keys = EpisodeKeys(observation="state")
    assert load_minari(dataset, **LABELS)[Tag.CONSTRAINT]["pixels"].eq(7).all()
    read = load_minari(dataset, observation=("observations", "1"), keys=keys, **LABELS)
    assert read[Tag.CONSTRAINT]["state"].shape == (1, 4, 2)


def test_states_beside_images_and_own_keys_come_back_too():
    keys = EpisodeKeys(("camera", "image"), ("arm", "action"), ("next", "r"), ("next", "hit"), ("next", "there"))
    written = data(state=True, keys=keys)
    save_minari(written, "mine/robot-v3", keys=keys, extra_keys=[("arm", "state")], action_spec=SPEC)
    read = load_minari("mine/robot-v3", keys=keys, extra={("arm", "state"): ("observations", "arm", "state")})
    assert_all_same(written, read)


def test_how_episodes_end_comes_back():
    ending, cut = episode(4), episode(4)
    for made, terminates in ((ending, True), (cut, False)):
        last = torch.arange(4).unsqueeze(-1) == 3
        made["next", "done"] = last
        made["next", "terminated"], made["next", "truncated"] = last & terminates, last & (not terminates)
    save_minari({Tag.SUCCESS: [ending, cut]}, "mine/robot-v0")
    assert_all_same({Tag.SUCCESS: [ending, cut]}, load_minari("mine/robot-v0"))


def test_minaris_own_reader_finds_what_its_users_expect():
    save_minari(data(), "mine/robot-v0", action_spec=SPEC, description="three kinds")
    read = minari.load_dataset("mine/robot-v0")
    assert (read.total_episodes, read.total_steps) == (4, 13)
    assert read.observation_space == gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert read.action_space == gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    for one in read.iterate_episodes():
        assert len(one.observations) == len(one) + 1
        assert all(frame in read.observation_space for frame in one.observations)
        assert all(action in read.action_space for action in one.actions)
        assert one.infos["constraint"].dtype == one.infos["success"].dtype == bool
        assert len(one.infos["success"]) == len(one) + 1
        assert not one.infos["success"][0]
        assert one.truncations[-1]
    read.set_seed(0)
    assert len(read.sample_episodes(3)) == 3
    violating = read.filter_episodes(lambda one: one.infos["constraint"].any())
    assert violating.total_episodes == 1
    (metadata,) = read.storage.get_episode_metadata([2])
    assert metadata["tag"] == "constraint"


def test_without_a_spec_actions_have_no_bounds_and_nested_observations_are_dictionaries():
    made = save_minari(data(state=True), "mine/robot-v0", extra_keys=[("arm", "state")])
    assert not made.action_space.is_bounded()
    assert made.observation_space["arm"]["state"].shape == (4,)
    assert all(frame in made.observation_space["pixels"] for frame in made[0].observations["pixels"])


def test_it_is_what_the_buffer_takes():
    save_minari(data(), "mine/robot-v0")
    read = load_minari("mine/robot-v0")
    check_datasets(read, action_spec=SPEC)
    buffer = TaggedReplayBuffer(100, latent_dim=4)
    for tag, episodes in read.items():
        buffer.add(episodes, tag)
    assert len(buffer) == 13


def test_a_subset_of_the_episodes_a_dataset_and_a_folder_are_taken(root):
    made = save_minari(data(), "mine/robot-v0")
    assert [len(row) for row in load_minari(made, episodes=[1])[Tag.SUCCESS].unbind(0)] == [3]
    longest = made.filter_episodes(lambda one: len(one) == 5)
    assert load_minari(longest)[Tag.SUCCESS].shape == (1, 5)
    assert_all_same(data(), load_minari(root / "mine" / "robot-v0"))
    with pytest.raises(ValueError, match="has no episode 9: its 4 are 0 to 3"):
        load_minari(made, episodes=[0, 9])
    with pytest.raises(ValueError, match=r"has no episode\. Give another one"):
        load_minari(made, episodes=[])


def foreign(
    name="foreign/push-v0", *, observations=None, space=None, action=None, action_space=None, infos=None, **more
):
    """A dataset that another project has made: floats of 64 bits, costs, wide images with their channels last."""
    steps = 4
    frames = np.arange(steps + 1, dtype=np.uint8)[:, None, None, None] * np.full((48, 96, 3), 10, dtype=np.uint8)
    cost = np.array([0.0, 0.0, 2.5, 0.0, 0.0])
    one = {
        "observations": frames if observations is None else observations,
        "actions": np.full((steps, 2), 0.25) if action is None else action,
        "rewards": [0.1, 0.2, 0.3, 1.0],
        "terminations": [False, False, False, True],
        "truncations": [False] * steps,
        "infos": {"cost": cost, "task": {"distance": np.array([9.0, 5.0, 3.0, 1.0, 0.1])}} if infos is None else infos,
    } | more
    with pytest.warns(UserWarning, match=r"is set to None|env_spec is None"):
        return minari.create_dataset_from_buffers(
            name,
            [EpisodeBuffer(**one)],
            observation_space=space or gymnasium.spaces.Box(0, 255, frames.shape[1:], np.uint8),
            action_space=action_space or gymnasium.spaces.Box(-1, 1, (2,), np.float64),
            jpeg_encoding=False,
        )


def reached(one):
    return one.infos["task"]["distance"] < 1.0


LABELS = {"success": reached, "reward": lambda one: reached(one) - 1.0, "constraint": lambda one: one.infos["cost"] > 0}


def test_labels_of_foreign_data_come_from_functions_of_their_infos():
    read = load_minari(foreign(), **LABELS, extra={"distance": "distance"})
    (row,) = read[Tag.CONSTRAINT].unbind(0)
    assert row["pixels"].shape == (4, 3, 64, 64)
    assert row["next", "pixels"][:, 0, 0, 0].tolist() == [10, 20, 30, 40]
    # Infos are of states: the second one tells what the first step led to.
    assert row["next", "constraint"].flatten().tolist() == [False, True, False, False]
    assert row["next", "success"].flatten().tolist() == [False, False, False, True]
    assert row["next", "reward"].flatten().tolist() == [-1, -1, -1, 0]
    assert row["next", "distance"].tolist() == [5.0, 3.0, 1.0, 0.1]
    assert row["next", "terminated"].flatten().tolist() == [False, False, False, True]
    assert row["action"].dtype == torch.float32


def test_entries_by_name_answers_for_all_steps_and_tags():
    dataset = foreign(infos={"cost": np.array([0.0, 0, 1, 0, 0]), "unsafe": np.array([False] * 4)})
    common = {"success": "terminations", "reward": lambda one: one.terminations - 1.0}
    by_name = load_minari(dataset, constraint=("infos", "cost"), **common)
    assert by_name[Tag.CONSTRAINT]["next", "constraint"].flatten().tolist() == [False, True, False, False]
    assert list(load_minari(dataset, constraint="unsafe", **common)) == [Tag.SUCCESS]
    assert list(load_minari(dataset, constraint=False, **common)) == [Tag.SUCCESS]
    assert list(load_minari(dataset, constraint=False, tag="online", **common)) == [Tag.ONLINE]
    assert list(load_minari(dataset, constraint=False, tag=lambda one: "rand", **common)) == [Tag.RAND]


def test_recorded_rewards_of_another_kind_are_kept_and_warned_of():
    with pytest.warns(DataWarning, match=r"recorded rewards, from 0.1 to 1 .*Give reward= a function"):
        read = load_minari(foreign(), constraint=False, success=reached)
    np.testing.assert_allclose(read[Tag.SUCCESS]["next", "reward"].flatten(), [0.1, 0.2, 0.3, 1.0])


@pytest.mark.parametrize(
    ("rewards", "message"), [([0, 0, 0, 1.0], "is 1 in the goal and 0 elsewhere"), ([0, 0, 0, 5.0], "is 0 in all 3")]
)
def test_rewards_that_mark_the_goal_otherwise_are_refused(rewards, message):
    with pytest.raises(ValueError, match=f"Episode 0 of Minari's foreign/push-v0.*{message}"):
        load_minari(foreign(rewards=rewards), constraint=False, success=reached)


CAMERAS = {
    "front": np.full((5, 48, 64, 3), 7, dtype=np.uint8),
    "depth": np.zeros((5, 48, 64, 1), dtype=np.float32),
    "proprio": np.zeros((5, 6)),
}
BOX = gymnasium.spaces.Box


def space_of(observations):
    kinds = {np.uint8: (0, 255), np.float32: (-np.inf, np.inf), np.float64: (-np.inf, np.inf)}
    return gymnasium.spaces.Dict(
        {k: BOX(*kinds[v.dtype.type], v.shape[1:], v.dtype.type) for k, v in observations.items()}
    )


def test_the_only_image_of_several_observations_is_found_and_of_several_images_one_is_named():
    read = load_minari(foreign(observations=CAMERAS, space=space_of(CAMERAS)), **LABELS)
    assert read[Tag.CONSTRAINT]["pixels"].eq(7).all()
    two = CAMERAS | {"wrist": np.full((5, 32, 32), 9, dtype=np.uint8)}
    dataset = foreign("foreign/two-v0", observations=two, space=space_of(two))
    with pytest.raises(KeyError, match=r"has 2 images among its 4 observations. Say with observation="):
        load_minari(dataset, **LABELS)
    grey = load_minari(dataset, observation="wrist", **LABELS)[Tag.CONSTRAINT]["pixels"]
    assert grey.shape == (1, 4, 3, 64, 64)
    assert grey.eq(9).all()
    state = load_minari(dataset, observation="proprio", keys=EpisodeKeys(observation="state"), **LABELS)
    assert state[Tag.CONSTRAINT]["state"].shape == (1, 4, 6)
    with pytest.raises(TypeError, match=r"uint8 in 0..255, got float32.*Name another entry"):
        load_minari(dataset, observation="depth", **LABELS)
    raw = load_minari(dataset, observation="depth", size=None, keys=EpisodeKeys(observation="depth"), **LABELS)
    assert raw[Tag.CONSTRAINT]["depth"].shape == (1, 4, 48, 64, 1)


def test_channels_first_are_said_and_not_guessed():
    frames = np.full((5, 3, 48, 64), 7, dtype=np.uint8)
    dataset = foreign(observations=frames, space=BOX(0, 255, (3, 48, 64), np.uint8))
    with pytest.raises(ValueError, match="give channels='first'"):
        load_minari(dataset, **LABELS)
    assert load_minari(dataset, channels="first", **LABELS)[Tag.CONSTRAINT]["pixels"].shape == (1, 4, 3, 64, 64)


def test_minaris_lossy_images_are_read():
    frames = np.full((5, 48, 64, 3), 100, dtype=np.uint8)
    with pytest.warns(UserWarning, match=r"is set to None|env_spec is None"):
        dataset = minari.create_dataset_from_buffers(
            "foreign/lossy-v0",
            [EpisodeBuffer(None, None, None, frames, np.zeros((4, 2)), [-1.0] * 4, [False] * 4, [False] * 4, {})],
            observation_space=BOX(0, 255, (48, 64, 3), np.uint8),
            action_space=BOX(-1, 1, (2,), np.float64),
        )
    read = load_minari(dataset, success=False, constraint=False)[Tag.RAND]
    assert (read["pixels"].int() - 100).abs().max() < 3
    assert ("next", "done") not in read.keys(True)  # it does not say how it ends


def test_discrete_actions_are_refused_until_a_function_makes_others():
    space = gymnasium.spaces.Discrete(3)
    dataset = foreign(action=np.array([0, 1, 2, 1]), action_space=space)
    with pytest.raises(ValueError, match=r"actions of Discrete\(3\), but LS³ plans continuous ones"):
        load_minari(dataset, **LABELS)
    read = load_minari(dataset, action=lambda one: one.actions[:, None] - 1.0, **LABELS)
    assert read[Tag.CONSTRAINT]["action"].flatten().tolist() == [-1, 0, 1, 0]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"success": None}, KeyError, r"does not say what its success is.*success=False where it never is.*'cost'"),
        ({"constraint": None}, KeyError, "Give constraint= the name of one"),
        ({"constraint": "costs"}, KeyError, "has no entry 'costs' for constraint"),
        ({"constraint": "cost"}, ValueError, r"must hold bools, or 0 and 1; got 2.5.*cost > 0"),
        ({"success": lambda one: one.rewards[:2] > 0}, ValueError, r"each of the 4 steps.*5 states, got shape \[2\]"),
        ({"success": lambda one: True}, ValueError, r"got shape \[\]"),
        ({"action": lambda one: one.actions * np.nan}, ValueError, "action is not finite: 8 of 8"),
        ({"action": lambda one: one.actions[:, 0]}, ValueError, r"must have shape \[T, A\].*got \[4\]"),
        ({"observation": "cost"}, ValueError, r"Episode 0 .*observations must have shape"),
        ({"observation": lambda one: one.observations[:-1]}, ValueError, "steps need 5 observations, got 4"),
        ({"success": lambda one: ["no"] * 4}, TypeError, "success must be numbers or bools, got <U2"),
        ({"success": lambda one: None}, ValueError, r"^Episode 0 of Minari's foreign/push-v0: success must have one"),
        ({"extra": {"action": "rewards"}}, ValueError, r"extra= must name keys of its own.*got 'action'"),
        ({"extra": {("next", "cost"): "cost"}}, ValueError, r"got \('next', 'cost'\)"),
        ({"tag": "good"}, ValueError, "Unknown tag 'good'"),
        ({"fit": "pad"}, ValueError, "fit must be one of"),
    ],
)
def test_what_cannot_be_understood_is_refused_by_episode_and_remedy(options, error, message):
    with pytest.raises(error, match=message):
        load_minari(foreign(), **(LABELS | options))


def test_a_function_that_fails_is_named():
    with pytest.raises(KeyError) as refused:
        load_minari(foreign(), **(LABELS | {"success": lambda one: one.infos["win"]}))
    assert "function success= for Episode 0 of Minari's foreign/push-v0" in refused.value.__notes__[0]


def test_datasets_that_are_not_there_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="mine/nothing-v0 not found locally"):
        load_minari("mine/nothing-v0")
    with pytest.raises(FileNotFoundError, match="holds no Minari dataset"):
        load_minari(tmp_path)
    with pytest.raises(TypeError, match="got int"):
        load_minari(3)


def test_nothing_is_overwritten_and_nothing_half_is_left(root, monkeypatch):
    save_minari(data(), "mine/robot-v0")
    with pytest.raises(FileExistsError, match=r"exists already.*minari.delete_dataset\('mine/robot-v0'\)"):
        save_minari(data(), "mine/robot-v0")
    with pytest.raises(ValueError, match="got an empty mapping"):
        save_minari({}, "mine/robot-v1")

    def full(*_, **__):
        raise OSError("No space left on device")

    monkeypatch.setattr("minari.dataset._storages.hdf5_storage.HDF5Storage.update_episodes", full)
    with pytest.raises(OSError, match="No space"):
        save_minari(data(), "mine/robot-v1")
    assert not (root / "mine" / "robot-v1").exists()
    assert (root / "mine" / "robot-v0").exists()


@pytest.mark.parametrize("name", ["robot", "mine/robot", "my robot-v0", "../robot-v0", "", 3])
def test_ids_without_a_version_are_refused(name):
    with pytest.raises(ValueError, match=r"such as 'mine/robot-v0'; got"):
        save_minari(data(), name)


def test_what_minari_has_no_room_for_is_refused():
    anew = episode(5)
    anew["next", "pixels"] = 255 - anew["next", "pixels"]
    with pytest.raises(ValueError, match=r"success: .*taken anew. Minari keeps T \+ 1"):
        save_minari({Tag.SUCCESS: [anew]}, "mine/robot-v0")
    with pytest.raises(KeyError, match="'force' must be there before and after"):
        save_minari(data(), "mine/robot-v0", extra_keys=["force"])
    wide = episode(3)
    wide["action"] = torch.zeros(3, 3)
    with pytest.raises(ValueError, match="one kind of observations and actions"):
        save_minari({Tag.SUCCESS: [episode(3)], Tag.RAND: [wide]}, "mine/robot-v0")
    with pytest.raises(ValueError, match="lies outside of what can be carried out"):
        save_minari(data(), "mine/robot-v0", action_spec=Bounded(-0.1, 0.1, shape=(2,)))
