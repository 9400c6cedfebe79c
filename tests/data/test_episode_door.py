"""Episodes that arrive in any shape: stored as they were meant, or refused with nothing stored."""

import warnings

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import LazyStackedTensorDict, TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors.utils import split_trajectories
from torchrl.data import Bounded

from ls3_torchrl.data import (
    DataWarning,
    EpisodeKeys,
    Tag,
    TaggedReplayBuffer,
    check_datasets,
    check_episodes,
    load_episodes,
    save_episodes,
    split_episodes,
)

KEYS = EpisodeKeys(observation="state")
EVERY = ("state", ("next", "state"), "action", ("next", "reward"), ("next", "constraint"), ("next", "success"))


def episode(steps=4, start=0.0, **changes):
    """States that count up, a violation in the middle, the goal at the end."""
    state = start + torch.arange(steps + 1.0).unsqueeze(-1) * torch.ones(2)
    reached = torch.arange(steps).unsqueeze(-1) == steps - 1
    after = {
        "state": state[1:].clone(),
        "reward": reached.float() - 1.0,
        "success": reached,
        "constraint": torch.arange(steps).unsqueeze(-1) == steps // 2,
    }
    action = 0.1 * torch.arange(2.0 * steps).reshape(steps, 2)
    return TensorDict({"state": state[:-1].clone(), "action": action, "next": after}, [steps])


def images(steps=3, dtype=torch.uint8, scale=1.0, size=64):
    data = episode(steps)
    frames = torch.randint(256, (steps + 1, 3, size, size), dtype=torch.uint8)
    frames = frames if dtype == torch.uint8 else (frames.double() * scale).to(dtype)
    data["pixels"], data["next", "pixels"] = frames[:-1], frames[1:]
    return data.exclude("state", ("next", "state"))


def make_buffer(keys=KEYS, **options):
    buffer = TaggedReplayBuffer(100, latent_dim=2, keys=keys, **options)
    buffer.encode(TensorDictModule(torch.nn.Identity(), ["state"], ["latent"]))
    return buffer


def content(buffer):
    return {key: value.clone() for key, value in buffer.transitions.storage[:].items(True, True)} if len(buffer) else {}


def assert_stored(buffer, meant):
    """The rows are those of one episode, whatever it looked like."""
    rows = buffer.transitions.storage[-len(meant) :] if len(meant) < len(buffer) else buffer.transitions.storage[:]
    for key in ("action", ("next", "reward"), ("next", "success"), ("next", "constraint")):
        assert torch.equal(rows[key], meant[key]), key
    assert torch.equal(rows["loc"], meant["state"])
    assert torch.equal(rows["next", "loc"], meant["next", "state"])


# --- what is clear is converted, and said -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "change", "said"),
    [
        (("next", "reward"), lambda x: x.double(), r"'reward'\) from torch.float64 to torch.float32"),
        (("next", "reward"), lambda x: x.long(), r"'reward'\) from torch.int64 to torch.float32"),
        (("next", "success"), lambda x: x.float(), r"'success'\) from torch.float32 of 0 and 1 to bools"),
        (("next", "constraint"), lambda x: x.to(torch.uint8), r"'constraint'\) from torch.uint8 of 0 and 1 to bools"),
        ("action", lambda x: x.double(), "'action' from torch.float64 to torch.float32"),
        ("state", lambda x: x.double(), "'state' from torch.float64 to torch.float32"),
    ],
)
def test_what_is_clear_is_converted_and_said(key, change, said):
    meant, given_ = episode(), episode()
    given_[key] = change(given_[key])
    if key == "state":
        given_["next", "state"] = change(given_["next", "state"])
    buffer = make_buffer()
    with pytest.warns(DataWarning, match=said) as told:
        buffer.add(given_, "success")
    assert len(told) == 1
    assert_stored(buffer, meant)


@pytest.mark.parametrize(
    ("dtype", "scale", "said"),
    [
        (torch.float32, 1 / 255, r"torch.float32 in \[0, 1\]"),
        (torch.float64, 1 / 255, r"in \[0, 1\]"),
    ],
)
def test_images_whose_unit_is_clear_become_bytes(dtype, scale, said):
    torch.manual_seed(0)
    meant = images()
    torch.manual_seed(0)
    given_ = images(dtype=dtype, scale=scale)
    buffer = TaggedReplayBuffer(100, latent_dim=2)
    with pytest.warns(DataWarning, match=said):
        buffer.add(given_, "success")
    stored = buffer.frames.storage[:]["pixels"]
    assert torch.equal(stored, torch.cat([meant["pixels"], meant["next", "pixels"][-1:]]))


def test_tensors_of_any_origin_are_stored_without_graph_and_can_be_gone_on_with():
    weight = torch.ones(1, requires_grad=True)
    meant, buffer = episode(), make_buffer()
    graph = episode()
    for key in ("action", "state", ("next", "state"), ("next", "reward")):
        graph[key] = graph[key] * weight
    buffer.add(graph, "online")
    with torch.inference_mode():
        buffer.add(episode(), "online")
    wide = episode()
    wide["action"] = torch.zeros(1, 2).expand(4, 2)
    buffer.add(wide, "online")
    assert not any(value.requires_grad for value in content(buffer).values())
    assert len(buffer) == 12
    buffer.sample(3)["action"].add_(1.0)
    assert_stored_first = buffer.transitions.storage[:4]
    assert torch.equal(assert_stored_first["action"], meant["action"])


@pytest.mark.parametrize("how", ["list", "tuple", "lazy stack", "behind one another", "padded", "nested"])
def test_episodes_of_different_lengths_arrive_in_any_way(how):
    parts = [episode(2), episode(5, start=9.0), episode(1, start=30.0)]
    for part in parts:
        done = torch.zeros(len(part), 1, dtype=torch.bool)
        done[-1] = True
        part["next", "done"] = part["next", "truncated"] = done
        part["next", "terminated"] = torch.zeros_like(done)
    joined = torch.cat(parts)
    given_ = {
        "list": parts,
        "tuple": tuple(parts),
        "lazy stack": LazyStackedTensorDict.lazy_stack(parts, 0),
        "behind one another": joined,
        "padded": split_trajectories(joined, done_key="done", as_nested=False),
        "nested": [parts[:2], parts[2].unsqueeze(0)],
    }[how]
    buffer = make_buffer()
    buffer.add(given_, "success")
    assert_stored(buffer, joined)
    assert buffer.transitions.storage[:]["steps_left"].flatten().tolist() == [2, 1, 5, 4, 3, 2, 1, 1]


# --- what is not clear is refused, and nothing is stored --------------------------------------------------------

REFUSED = [
    ("next reward is missing", ("next", "reward"), None, KeyError, "needs the keys.*reward"),
    ("a cost above one", ("next", "constraint"), lambda x: 2.0 * x, ValueError, "got 2.0 among 4 values.*cost > 0"),
    ("half a success", ("next", "success"), lambda x: 0.5 * x, ValueError, "got 0.5"),
    ("NaN in labels", ("next", "success"), lambda x: x / 0.0, ValueError, "got (nan|inf)"),
    ("a reward for each of two", ("next", "reward"), lambda x: x.expand(4, 2), ValueError, r"\[T, 1\] with T = 4"),
    ("rewards without last dimension", ("next", "reward"), lambda x: x[:, 0], ValueError, r"\[T, 1\].*got \[4\]"),
    ("successes likewise", ("next", "success"), lambda x: x[:, 0], ValueError, r"got \[4\].*unsqueeze\(-1\)"),
    ("constraints likewise", ("next", "constraint"), lambda x: x[:, 0], ValueError, "episode_from_arrays"),
    ("actions likewise", "action", lambda x: x[:, 0], ValueError, r"shape \[T, A\], got \[4\]"),
    ("NaN in rewards", ("next", "reward"), lambda x: x * torch.nan, ValueError, "not finite"),
    ("infinite actions", "action", lambda x: x + torch.inf, ValueError, "action is not finite"),
    ("actions of two dimensions", "action", lambda x: x.reshape(4, 1, 2), ValueError, r"shape \[T, A\]"),
    ("complex actions", "action", lambda x: x + 1j, TypeError, "real numbers"),
    ("NaN in states", "state", lambda x: x * torch.nan, ValueError, "state is not finite"),
    ("a reward of the goal", ("next", "reward"), lambda x: x + 1.0, ValueError, "1 in the goal.*Subtract 1"),
    ("states of another size", ("next", "state"), lambda x: x[:, :1], ValueError, "must be alike"),
    (
        "a reset in the middle",
        ("next", "state"),
        lambda x: torch.cat([x[:1], x[:1] + 7, x[2:]]),
        ValueError,
        "split it",
    ),
]


@pytest.mark.parametrize(("_", "key", "change", "error", "message"), REFUSED)
def test_what_cannot_be_understood_is_refused_with_all_that_came_with_it(_, key, change, error, message, tmp_path):
    wrong = episode(4, start=20.0)
    if change is None:
        del wrong[key]
    else:
        wrong[key] = change(wrong[key])
    buffer = make_buffer()
    buffer.add(episode(), "success")
    before = content(buffer)
    with pytest.raises(error, match=message):
        buffer.add([episode(3), episode(2), wrong], "online")
    after = content(buffer)
    assert len(buffer) == buffer.write_count == 4
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    for act in (
        lambda: check_episodes([wrong], keys=KEYS),
        lambda: save_episodes({"rand": [episode(), wrong]}, tmp_path / "data", task="x", seed=0, keys=KEYS),
    ):
        with pytest.raises(error, match=message):
            act()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        (lambda: images(dtype=torch.float32, scale=0.7), "must be uint8 images in 0..255, got torch.float32"),
        (lambda: images(dtype=torch.float32, scale=-1.0), "must be uint8 images"),
        (
            lambda: images(dtype=torch.int64, scale=10.0),
            "must be uint8 .* got torch.int64 from 0 to 2550",
        ),
    ],
)
def test_images_in_a_unit_that_is_not_clear_are_refused(given_, message):
    with pytest.raises(TypeError, match=message):
        TaggedReplayBuffer(100, latent_dim=2).add(given_(), "success")


def test_other_episodes_than_the_stored_ones_are_refused_by_both_shapes():
    buffer = make_buffer()
    buffer.add(episode(), "success")
    wide = episode()
    wide["action"] = torch.zeros(4, 3)
    with pytest.raises(ValueError, match=r"'action' has torch.float32 \[3\].*holds torch.float32 \[2\]"):
        buffer.add(wide, "success")
    with pytest.raises(ValueError, match=r"'action' differs among the episodes"):
        buffer.add([episode(), wide], "success")
    assert len(buffer) == 4


def test_an_encoder_that_fails_at_the_second_episode_leaves_nothing_of_the_first():
    class Picky(torch.nn.Module):
        def forward(self, x):
            if (x > 50).any():
                raise RuntimeError("too large for me")
            return x

    buffer = TaggedReplayBuffer(100, latent_dim=2, keys=KEYS)
    buffer.encode(TensorDictModule(Picky(), ["state"], ["latent"]))
    with pytest.raises(RuntimeError, match="too large for me"):
        buffer.add([episode(), episode(start=60.0)], "online")
    assert len(buffer) == len(buffer.frames) == 0


def test_a_batch_of_which_one_is_too_long_is_refused_whole():
    buffer = TaggedReplayBuffer(6, latent_dim=2, keys=KEYS)
    with pytest.raises(ValueError, match="An episode of 7 steps does not fit"):
        buffer.add([episode(3), episode(7)], "online")
    assert len(buffer) == 0


@pytest.mark.parametrize("name", ["done", "is_init"])
def test_saving_rows_of_several_episodes_is_refused_with_the_remedy(tmp_path, name):
    both = torch.cat([episode(2), episode(3, start=9.0)])
    if name == "done":
        both["next", "done"] = torch.tensor([[False], [True], [False], [False], [True]])
    else:
        both["is_init"] = torch.tensor([[True], [False], [True], [False], [False]])
    with pytest.raises(ValueError, match=r"row 0 of 5 steps holds 2 episodes of \[2, 3\] steps.*split_episodes"):
        save_episodes({"rand": [both]}, tmp_path / "data", task="x", seed=0, keys=KEYS)
    folder = save_episodes({"rand": split_episodes(both)}, tmp_path / "data", task="x", seed=0, keys=KEYS)
    assert [len(row) for row in load_episodes(folder, keys=KEYS)[Tag.RAND].unbind(0)] == [2, 3]


# --- anything at all --------------------------------------------------------------------------------------------

VALUES = {
    "double": lambda x: x.double(),
    "half": lambda x: x.half(),
    "long": lambda x: x.long(),
    "byte": lambda x: x.to(torch.uint8),
    "bool": lambda x: x.bool(),
    "minus": lambda x: -x if x.dtype != torch.bool else ~x,
    "plus one": lambda x: x + 1,
    "hundredfold": lambda x: x * 100,
    "nan": lambda x: torch.where(torch.arange(len(x)).reshape(-1, *[1] * (x.ndim - 1)) == 1, torch.nan, x),
    "inf": lambda x: x + torch.inf,
    "zeros": lambda x: torch.zeros_like(x),
    "ones": lambda x: torch.ones_like(x),
}
SHAPES = {
    "squeezed": lambda x: x.squeeze(-1),
    "unsqueezed": lambda x: x.unsqueeze(-1),
    "first": lambda x: x[:, :1],
    "twice": lambda x: torch.cat([x, x], -1),
    "flipped": lambda x: x.flip(0),
    "rolled": lambda x: x.roll(1, 0),
}
WAYS = {
    "alone": lambda e: e,
    "list": lambda e: [e],
    "batched": lambda e: e.unsqueeze(0),
    "lazy": lambda e: LazyStackedTensorDict.lazy_stack([e, e.clone()], 0),
    "twice": lambda e: [e, e.clone()],
    "with a good one": lambda e: [episode(2), e],
    "empty before": lambda e: [e[:0], e],
}


@settings(max_examples=1500)
@given(
    changes=st.lists(
        st.tuples(st.sampled_from(EVERY), st.sampled_from([*VALUES, *SHAPES, "removed", "text"])),
        min_size=1,
        max_size=3,
    ),
    way=st.sampled_from(list(WAYS)),
    steps=st.integers(1, 5),
)
def test_anything_is_stored_as_it_was_meant_or_refused_with_nothing_stored(changes, way, steps):
    given_ = episode(steps)
    for key, change in changes:
        if key not in given_.keys(True):
            continue
        if change == "removed":
            del given_[key]
            continue
        try:
            given_[key] = "text" if change == "text" else (VALUES | SHAPES)[change](given_.get(key))
        except (RuntimeError, TypeError, IndexError, AttributeError):
            return  # no such tensor can be made
    buffer = make_buffer()
    buffer.add(episode(3), "success")
    before = content(buffer)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            buffer.add(WAYS[way](given_), "online")
    except (ValueError, TypeError, KeyError):
        after = content(buffer)
        same = before.keys() == after.keys() and all(torch.equal(before[name], after[name]) for name in before)
        assert same
        assert len(buffer.frames) == 4
        return
    rows = buffer.transitions.storage[:][len(buffer) - steps :]
    meant = {key: given_[key] for key in EVERY}
    for key in ("action", ("next", "reward")):
        assert rows[key].dtype == torch.float32
        assert torch.equal(rows[key], meant[key].float().reshape(steps, -1))
        assert rows[key].isfinite().all()
    for key in (("next", "success"), ("next", "constraint")):
        assert rows[key].dtype == torch.bool
        assert torch.equal(rows[key].float(), meant[key].float().reshape(steps, 1))
    assert torch.equal(rows["loc"], meant["state"].float())


# --- whole sets -------------------------------------------------------------------------------------------------

BOX = Bounded(-1.0, 1.0, shape=(2,))


def test_sets_that_fit_pass_without_a_word():
    check_datasets({Tag.SUCCESS: [episode(3)], "constraint": [episode(4)]}, action_spec=BOX, keys=KEYS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda e: e.set("action", 10 * e["action"]),
            r"success: action lies outside .* in \d of 4 steps.*Convert its unit",
        ),
        (lambda e: e.set("action", torch.zeros(4, 3)), "has 3 actions, where the action spec has 2"),
        (lambda e: e.set(("next", "reward"), torch.zeros(4, 1)), "is 0 in all 3 steps outside of the goal"),
    ],
)
def test_sets_of_another_robot_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        check_datasets({Tag.SUCCESS: [change(episode(4))]}, action_spec=BOX, keys=KEYS)


def test_actions_that_rounding_put_outside_the_box_are_inside():
    data = episode(4)
    data["action"] = torch.full((4, 2), 1.0 + 5e-5)
    check_datasets({Tag.SUCCESS: [data]}, action_spec=BOX, keys=KEYS)


@pytest.mark.parametrize(
    ("tag", "key", "verb"), [("success", "success", "succeeds"), ("constraint", "constraint", "violates")]
)
def test_sets_without_what_they_are_named_after_are_warned_of(tag, key, verb):
    data = episode(4)
    data["next", key] = torch.zeros(4, 1, dtype=torch.bool)
    data["next", "reward"] = -torch.ones(4, 1)
    with pytest.warns(DataWarning, match=rf"No episode of 2 that are tagged {tag} ever {verb}"):
        check_datasets({tag: [data, data.clone()]}, action_spec=BOX, keys=KEYS)


def test_sets_that_differ_are_refused():
    wide = episode(4)
    wide["action"] = torch.zeros(4, 3)
    with pytest.raises(ValueError, match=r"The sets of episodes: 'action' differs"):
        check_datasets({Tag.SUCCESS: [episode(4)], Tag.RAND: [wide]}, keys=KEYS)


# --- what a full buffer forgets ---------------------------------------------------------------------------------


def test_offline_data_that_come_late_are_not_overwritten_without_a_word():
    buffer = TaggedReplayBuffer(10, latent_dim=2, keys=KEYS)
    buffer.add(episode(4), "online")
    buffer.add(episode(4), "success")
    buffer.add(episode(4), "online")  # over online ones
    with pytest.warns(DataWarning, match=r"10 transitions is full.*: 2 of success\. Add offline data first"):
        buffer.add(episode(4), "online")
    buffer.add(episode(4), "online")  # once is enough


def test_offline_data_that_come_first_are_kept():
    buffer = TaggedReplayBuffer(10, latent_dim=2, keys=KEYS)
    buffer.add(episode(4), "success")
    for _ in range(9):
        buffer.add(episode(4), "online")
    assert (len(buffer), buffer.count(tags=["success"])) == (10, 4)


def test_online_data_are_overwritten_without_ado():
    buffer = TaggedReplayBuffer(10, latent_dim=2, keys=KEYS)
    for _ in range(9):
        buffer.add(episode(4), "online")
    assert len(buffer) == 10


@pytest.mark.parametrize("wrong", [{"state": 1}, None, 3, "episode", torch.zeros(3), [torch.zeros(3)]])
def test_what_is_no_tensordict_is_refused_with_the_remedy(wrong):
    with pytest.raises(TypeError, match=r"Episodes must be tensordicts, got .*episode_from_arrays"):
        make_buffer().add(wrong, "success")


@pytest.mark.parametrize("wrong", [lambda x: x.to_sparse(), lambda x: x.to("meta")])
def test_entries_that_are_no_ordinary_tensors_are_refused(wrong):
    data = episode()
    data["next", "reward"] = wrong(data["next", "reward"])
    with pytest.raises(TypeError, match=r"'reward'\) must be an ordinary tensor, got one of torch"):
        make_buffer().add(data, "success")


def test_discounts_that_make_no_labels_are_refused_by_the_buffer():
    with pytest.raises(ValueError, match="gamma must lie in"):
        TaggedReplayBuffer(10, gamma=1.1)
