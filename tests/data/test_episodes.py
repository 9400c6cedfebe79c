import numpy as np
import pytest
import torch
from tensordict import LazyStackedTensorDict, TensorDict

from ls3_torchrl.data import EpisodeKeys, episode_from_arrays, split_episodes, steps_into_violation

T = 4
KEYS = EpisodeKeys(("agent", "state"), ("agent", "action"), ("next", "r"), ("next", "flags", "hit"), ("next", "there"))


def arrays(kind="numpy", **changes):
    rng = np.random.default_rng(0)
    values = {
        "observations": rng.normal(size=(T + 1, 3)),
        "actions": rng.normal(size=(T, 2)),
        "rewards": -np.ones(T),
        "constraints": np.array([0, 0, 1, 0]),
        "successes": np.array([False, False, False, True]),
    } | changes
    return values if kind == "numpy" else {name: torch.as_tensor(value) for name, value in values.items()}


@pytest.mark.parametrize("kind", ["numpy", "torch"])
@pytest.mark.parametrize("keys", [None, KEYS])
def test_arrays_become_an_episode_with_types_and_shapes_that_fit(kind, keys):
    episode = episode_from_arrays(**arrays(kind), keys=keys)
    keys, source = keys or EpisodeKeys(), arrays()
    assert episode.batch_size == (T,)
    for key, value in ((keys.observation, source["observations"][:-1]), (keys.action, source["actions"])):
        assert episode[key].dtype == torch.float32
        np.testing.assert_array_equal(episode[key].numpy(), value.astype(np.float32))
    np.testing.assert_array_equal(episode[keys.next_observation], source["observations"][1:].astype(np.float32))
    assert episode[keys.reward].dtype == torch.float32
    assert episode[keys.reward].tolist() == [[-1.0]] * T
    assert episode[keys.constraint].tolist() == [[False], [False], [True], [False]]
    assert episode[keys.success].tolist() == [[False], [False], [False], [True]]


def test_images_stay_bytes_and_columns_and_whole_numbers_are_taken():
    pixels = np.random.default_rng(0).integers(0, 256, (T + 1, 3, 64, 64), dtype=np.uint8)
    episode = episode_from_arrays(
        **arrays(observations=pixels, rewards=-np.ones((T, 1), dtype=np.int64), successes=torch.zeros(T, 1))
    )
    assert episode["pixels"].dtype == torch.uint8
    assert torch.equal(episode["next", "pixels"][:-1], episode["pixels"][1:])
    assert episode["next", "reward"].dtype == torch.float32
    assert episode["next", "success"].dtype == torch.bool


def test_lists_of_arrays_as_they_come_from_a_loop_are_taken():
    source = arrays()
    lists = {name: list(value) for name, value in source.items()}
    assert (episode_from_arrays(**lists) == episode_from_arrays(**source)).all()


def test_an_episode_does_not_change_with_its_arrays():
    source = arrays()
    episode = episode_from_arrays(**source)
    before = episode.clone()
    for value in source.values():
        value[:] = 0
    assert (episode == before).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": np.zeros(T)}, r"'action': actions must have shape \[T, A\].*got \[4\].*\[T, 1\]"),
        ({"actions": np.zeros((0, 2))}, r"at least one step, got \[0, 2\]"),
        ({"observations": np.zeros((T, 3))}, r"'pixels'.*\[T \+ 1, ...\] with T = 4.*got \[4, 3\].*Append"),
        ({"observations": np.zeros(T + 1)}, r"got \[5\].*single numbers as \[T \+ 1, 1\]"),
        ({"rewards": np.zeros(T + 1)}, r"\('next', 'reward'\).*with T = 4.*got \[5\]. Give one value for each step"),
        ({"rewards": np.zeros((T, 2))}, r"got \[4, 2\]"),
        ({"constraints": np.zeros(T - 1)}, r"\('next', 'constraint'\).*got \[3\]"),
        ({"constraints": np.array([0, 2.0, 0, 0])}, r"\('next', 'constraint'\) must hold bools, or 0 and 1; got 2.0"),
        ({"successes": np.array([0, np.nan, 0, 0])}, r"\('next', 'success'\) must hold bools.*got nan"),
    ],
)
def test_what_does_not_fit_is_refused_by_key_shape_and_remedy(changes, message):
    with pytest.raises(ValueError, match=message):
        episode_from_arrays(**arrays(**changes))


def numbered(*lengths, done=True):
    """Rows with numbers, of episodes of the lengths behind one another."""
    count = sum(lengths)
    row = TensorDict({"number": torch.arange(count).unsqueeze(-1), "next": {}}, [count])
    if done:
        ends = torch.zeros(count, 1, dtype=torch.bool)
        ends[torch.tensor(lengths).cumsum(0) - 1] = True
        row["next", "done"] = ends
    return row


def numbers(episodes):
    return [episode["number"].flatten().tolist() for episode in episodes]


def test_episodes_behind_one_another_are_taken_apart_where_they_are_done():
    assert numbers(split_episodes(numbered(2, 1, 3))) == [[0, 1], [2], [3, 4, 5]]


@pytest.mark.parametrize("key", ["terminated", "truncated"])
def test_each_of_torchrls_flags_ends_an_episode(key):
    row = numbered(2, 2)
    ends = row["next", "done"].clone()
    row["next", "done"] = torch.zeros_like(ends)
    row["next", key] = ends
    assert numbers(split_episodes(row)) == [[0, 1], [2, 3]]


def test_a_change_of_the_collectors_trajectory_ends_an_episode():
    row = numbered(5, done=False)
    row["collector", "traj_ids"] = torch.tensor([4, 4, 7, 7, 7])
    assert numbers(split_episodes(row)) == [[0, 1], [2, 3, 4]]


@pytest.mark.parametrize("done", [True, False])
def test_whole_rows_stay_as_they_are(done):
    row = numbered(3, done=done)
    assert split_episodes(row)[0] is row
    both = torch.stack([row, row.clone()])
    assert [len(episode) for episode in split_episodes(both)] == [3, 3]


def test_lists_and_lazy_stacks_of_different_lengths_are_taken():
    rows = [numbered(2), numbered(3, 1), numbered(1)]
    expected = [[0, 1], [0, 1, 2], [3], [0]]
    assert numbers(split_episodes(rows)) == expected
    assert numbers(split_episodes(LazyStackedTensorDict.lazy_stack(rows, 0))) == expected
    assert numbers(split_episodes((torch.stack([rows[0], rows[0]]), rows[2]))) == [[0, 1], [0, 1], [0]]


def test_a_lazy_stack_of_single_steps_is_an_episode():
    steps = LazyStackedTensorDict.lazy_stack(list(numbered(3).unbind(0)), 0)
    assert numbers(split_episodes(steps)) == [[0, 1, 2]]
    worlds = LazyStackedTensorDict.lazy_stack(list(torch.stack([numbered(3), numbered(2, 1)]).unbind(1)), 1)
    assert numbers(split_episodes(worlds)) == [[0, 1, 2], [0, 1], [2]]


@pytest.mark.parametrize("key", ["mask", ("collector", "mask")])
def test_padding_is_left_out(key):
    row = torch.cat([numbered(2), 0 * numbered(3)])
    row[key] = torch.tensor([True, True, False, False, False])
    assert numbers(split_episodes(torch.stack([row, row]))) == [[0, 1], [0, 1]]


def test_an_episode_that_its_row_cuts_off_is_refused():
    with pytest.raises(ValueError, match=r"Steps 2 to 4 of a row of 5 belong.*trajs_per_batch=1"):
        split_episodes(numbered(2, 4)[:5])


def test_other_batch_sizes_are_refused():
    with pytest.raises(ValueError, match=r"\[T\] or \[N, T\], got \[1, 1, 3\]"):
        split_episodes(numbered(3)[None, None])


def test_of_every_violating_episode_the_step_into_its_first_violation_is_found():
    episodes = torch.stack([numbered(4)] * 3)
    constraint = torch.tensor([[0, 1, 0, 1], [0, 0, 0, 0], [0, 0, 0, 1]]).bool()
    episodes["next", "constraint"] = constraint[..., None]
    found = steps_into_violation(episodes)
    assert numbers([found]) == [[1, 3]]
    with pytest.raises(ValueError, match="None of the episodes violates"):
        steps_into_violation(episodes[1])
    with pytest.raises(KeyError):
        steps_into_violation(episodes, KEYS)
