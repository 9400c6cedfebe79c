import json
import pickle
import shutil

import pytest
import torch
from tensordict import LazyStackedTensorDict, NonTensorData, TensorDict

from ls3_torchrl.data import EpisodeKeys, Tag, check_episodes, load_episodes, save_episodes


def episodes(n=2, t=3):
    flags = {k: torch.rand(n, t, 1) > 0.5 for k in ("constraint", "success")}
    frames = torch.randint(256, (n, t + 1, 3, 64, 64), dtype=torch.uint8)
    return TensorDict(
        {
            "pixels": frames[:, :-1],
            "action": torch.randn(n, t, 2),
            "next": {"pixels": frames[:, 1:], "reward": torch.randn(n, t, 1), **flags},
        },
        [n, t],
    )


def test_round_trip_is_exact(tmp_path):
    torch.manual_seed(0)
    written = {Tag.SUCCESS: episodes(2, 3), Tag.CONSTRAINT: episodes(1, 4)}
    folder = save_episodes(written, tmp_path / "demos", task="navigation", seed=5)
    read = load_episodes(folder, task="navigation")
    assert list(read) == [Tag.SUCCESS, Tag.CONSTRAINT]
    for tag, there in written.items():
        assert read[tag].batch_size == there.batch_size
        assert (read[tag] == there).all()
        assert read[tag]["pixels"].dtype == torch.uint8
    description = json.loads((folder / "episodes.json").read_text())
    assert description["seed"] == 5
    assert description["version"] == 3
    assert description["episodes"] == {"success": [3, 3], "constraint": [4]}


def test_an_existing_folder_is_never_written_into(tmp_path):
    with pytest.raises(FileExistsError, match="exists already"):
        save_episodes({Tag.RAND: episodes()}, tmp_path, task="navigation", seed=0)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_when_one_set_is_faulty(tmp_path):
    faulty = episodes()
    faulty["action"][0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="constraint: action is not finite"):
        save_episodes({Tag.SUCCESS: episodes(), Tag.CONSTRAINT: faulty}, tmp_path / "demos", task="x", seed=0)
    assert not (tmp_path / "demos").exists()


def test_a_folder_without_description_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no episodes.*ls3 collect"):
        load_episodes(tmp_path)


def test_episodes_of_another_task_are_refused(tmp_path):
    folder = save_episodes({Tag.RAND: episodes(1, 1)}, tmp_path / "demos", task="navigation", seed=0)
    with pytest.raises(ValueError, match="'navigation', but 'reacher' is wanted"):
        load_episodes(folder, task="reacher")


@pytest.mark.parametrize(("key", "value"), [("version", 99), ("format", "other")])
def test_another_format_or_version_is_refused(tmp_path, key, value):
    folder = save_episodes({Tag.RAND: episodes(1, 1)}, tmp_path / "demos", task="navigation", seed=0)
    path = folder / "episodes.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(ValueError, match=f"{value}.*Collect again"):
        load_episodes(folder)


@pytest.mark.parametrize(
    "key", ["pixels", "action", *(("next", k) for k in ("pixels", "reward", "constraint", "success"))]
)
def test_a_missing_key_is_named(key):
    with pytest.raises(KeyError, match=key if isinstance(key, str) else key[1]):
        check_episodes(episodes().exclude(key))


def test_one_dimension_is_not_a_set_of_episodes():
    with pytest.raises(ValueError, match=r"demos must have batch size \[N, T\], got \[3\]"):
        check_episodes(episodes()[0], name="demos")


@pytest.mark.parametrize("key", ["pixels", ("next", "pixels")])
def test_images_must_be_bytes_of_the_right_size(key):
    both = ("pixels", ("next", "pixels"))
    floats = episodes()
    floats[key] = floats[key] / 255.0
    with pytest.raises(ValueError, match="must be alike"):
        check_episodes(floats)
    for each in both:
        floats[each] = floats[each] / (1.0 if each == key else 255.0)
    with pytest.raises(TypeError, match=r"must be uint8 in 0..255, got torch.float32 in \[0, 1\].*255 \* images"):
        check_episodes(floats)
    small = episodes()
    for each in both:
        small[each] = small[each][..., :32, :32]
    with pytest.raises(ValueError, match=r"\[N, T, C, 64, 64\], got \[2, 3, 3, 32, 32\]"):
        check_episodes(small)


@pytest.mark.parametrize("key", ["action", ("next", "reward")])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_numbers_must_be_finite(key, bad):
    faulty = episodes()
    faulty[key][1, 2] = bad
    with pytest.raises(ValueError, match="is not finite"):
        check_episodes(faulty)


def followed(n=3, t=4, flags=False):
    """Episodes whose next entries are the entries of the following step, as an environment makes them."""
    state, flag = torch.randn(n, t + 1, 5), torch.rand(n, t + 1, 1) > 0.5
    data = episodes(n, t)
    for key, value in ((("agent", "state"), state), ("flag", flag)):
        data[key] = value[:, :-1]
        data["next", *((key,) if isinstance(key, str) else key)] = value[:, 1:]
    return data


def keys_of(tensordict):
    return set(tensordict.keys(include_nested=True, leaves_only=True))


def assert_same_bits(one, other):
    assert keys_of(one) == keys_of(other)
    for key in keys_of(one):
        assert one[key].dtype == other[key].dtype
        assert one[key].shape == other[key].shape
        bits = [value[key].contiguous().view(torch.uint8) for value in (one, other)]
        assert torch.equal(*bits), key


def size(folder):
    return sum(file.stat().st_size for file in folder.rglob("*.memmap"))


def test_what_follows_itself_is_stored_once_and_comes_back_bit_by_bit(tmp_path):
    torch.manual_seed(0)
    written = followed(3, 4)
    folder = save_episodes({Tag.RAND: written}, tmp_path / "demos", task="mine", seed=0)
    states, steps = 3 * 64 * 64 + 5 * 4 + 1, 2 * 4 + 4 + 1 + 1
    assert size(folder) == 3 * (5 * states + 4 * steps)
    read = load_episodes(folder)[Tag.RAND]
    assert read.batch_size == (3, 4)
    assert_same_bits(read, written)
    # One memory map behind both names.
    for key in ("pixels", ("agent", "state"), "flag"):
        twin = ("next", *((key,) if isinstance(key, str) else key))
        assert read[key].untyped_storage().data_ptr() == read[twin].untyped_storage().data_ptr()
        assert read[key][:, 1:].data_ptr() == read[twin].data_ptr()


@pytest.mark.parametrize("odd", ["minus zero", "nan", "reset", "dtype", "shape"])
def test_what_does_not_follow_itself_is_stored_as_it_is(tmp_path, odd):
    torch.manual_seed(0)
    written = followed(2, 3)
    state, after = written["agent", "state"].clone(), written["next", "agent", "state"].clone()
    state[1, 2], after[1, 1] = 0.0, 0.0
    if odd == "minus zero":
        after[1, 1] = -0.0
    elif odd == "nan":
        state[1, 2] = after[1, 1] = torch.nan
    elif odd == "reset":
        after[1, 1, 0] = 1.0
    elif odd == "dtype":
        after = after.double()
    else:
        after = after[..., :4]
    written["agent", "state"], written["next", "agent", "state"] = state, after
    folder = save_episodes({Tag.RAND: written}, tmp_path / "demos", task="mine", seed=0)
    assert_same_bits(load_episodes(folder)[Tag.RAND], written)
    once = odd == "nan"  # which is bit by bit what follows it
    assert (folder / "rand" / "states" / "agent" / "state.memmap").exists() == once
    assert (folder / "rand" / "steps" / "next" / "agent" / "state.memmap").exists() != once


@pytest.mark.parametrize("how", ["list", "lazy stack"])
def test_episodes_of_different_lengths_come_back_as_they_were(tmp_path, how):
    torch.manual_seed(0)
    rows = [followed(1, steps)[0] for steps in (2, 5, 1, 3)]
    written = rows if how == "list" else LazyStackedTensorDict.lazy_stack(rows, 0)
    folder = save_episodes({Tag.RAND: written}, tmp_path / "demos", task="mine", seed=0)
    read = load_episodes(folder)[Tag.RAND]
    assert len(read) == 4
    for row, there in zip(read.unbind(0), rows, strict=True):
        assert_same_bits(row, there)
    assert size(folder / "rand" / "states") == (11 + 4) * (3 * 64 * 64 + 5 * 4 + 1)
    # Writing into what was loaded changes no file.
    read[1]["pixels"][2] = 7
    assert_same_bits(load_episodes(folder)[Tag.RAND][1], rows[1])


def test_a_list_of_episodes_of_one_length_is_read_as_a_batch(tmp_path):
    rows = followed(2, 3)
    folder = save_episodes({Tag.RAND: list(rows.unbind(0))}, tmp_path / "demos", task="mine", seed=0)
    assert_same_bits(load_episodes(folder)[Tag.RAND], rows)


def test_version_1_is_still_read(tmp_path):
    torch.manual_seed(0)
    written = followed(2, 3)
    written.contiguous().memmap(str(tmp_path / "rand"))
    content = {"format": "ls3_torchrl.episodes", "version": 1, "task": "x", "seed": 0, "episodes": {"rand": [2, 3]}}
    (tmp_path / "episodes.json").write_text(json.dumps(content))
    read = load_episodes(tmp_path, task="x")
    assert_same_bits(read[Tag.RAND], written)
    # And written anew it is smaller.
    folder = save_episodes(read, tmp_path / "new", task="x", seed=0)
    assert_same_bits(load_episodes(folder)[Tag.RAND], written)
    assert size(folder) < 0.7 * size(tmp_path / "rand")


class Bomb:
    def __reduce__(self):
        return (exec, ("raise SystemExit('a pickle was run')",))


@pytest.mark.parametrize("version", [1, 2, 3])
def test_no_pickle_of_a_folder_is_run(tmp_path, version):
    data = followed(1, 2)
    folder = save_episodes({Tag.RAND: data}, tmp_path / "demos", task="x", seed=0)
    if version == 1:
        shutil.rmtree(folder / "rand")
        data.contiguous().memmap(str(folder / "rand"))
    if version < 3:
        content = json.loads((folder / "episodes.json").read_text()) | {"version": version}
        content["episodes"] = {"rand": [1, 2] if version == 1 else [2]}
        del content["files"], content["checksum"]
        (folder / "episodes.json").write_text(json.dumps(content))
    # Someone puts an entry into the folder whose value is a pickle.
    TensorDict({"extra": NonTensorData("x")}).memmap(str(tmp_path / "odd"))
    shutil.copytree(tmp_path / "odd" / "extra", folder / "rand" / "extra")
    (folder / "rand" / "extra" / "other.pickle").write_bytes(pickle.dumps({"data": Bomb()}))
    meta, odd = (json.loads((path / "meta.json").read_text()) for path in (folder / "rand", tmp_path / "odd"))
    (folder / "rand" / "meta.json").write_text(json.dumps(meta | {"extra": odd["extra"]}))
    with pytest.raises(ValueError, match="is not an array" if version < 3 else r"meta\.json is damaged"):
        load_episodes(folder)


def test_only_tensors_are_saved(tmp_path):
    data = followed(1, 2)
    data["name"] = NonTensorData("reach", batch_size=[1, 2])
    with pytest.raises(TypeError, match=r"rand: .*name.* is not a tensor.*exclude"):
        save_episodes({Tag.RAND: data}, tmp_path / "demos", task="x", seed=0)
    assert not (tmp_path / "demos").exists()


def test_episodes_with_different_keys_are_refused(tmp_path):
    one, other = followed(1, 2)[0], followed(1, 3)[0].exclude(("agent", "state"))
    with pytest.raises(ValueError, match=r"same keys.*'agent', 'state'"):
        save_episodes({Tag.RAND: [one, other]}, tmp_path / "demos", task="x", seed=0)
    with pytest.raises(ValueError, match="rand holds no episode"):
        save_episodes({Tag.RAND: []}, tmp_path / "demos", task="x", seed=0)
    assert not (tmp_path / "demos").exists()


KEYS = EpisodeKeys(("agent", "state"), ("agent", "action"), ("next", "agent", "cost"), ("next", "hit"), "reached")


def own(n=2, t=3):
    data = followed(n, t)
    for name in ("action", "reward", "constraint", "success"):
        data.rename_key_(getattr(EpisodeKeys(), name), getattr(KEYS, name))
    return data.exclude("pixels", ("next", "pixels"))


def test_own_nested_keys_and_states_are_saved_and_checked(tmp_path):
    written = own()
    with pytest.raises(KeyError, match="pixels"):
        check_episodes(written)
    folder = save_episodes({Tag.SUCCESS: written}, tmp_path / "demos", task="x", seed=0, keys=KEYS)
    assert_same_bits(load_episodes(folder, keys=KEYS)[Tag.SUCCESS], written)
    with pytest.raises(KeyError, match="pixels"):
        load_episodes(folder)


@pytest.mark.parametrize("key", [("agent", "state"), ("next", "agent", "state")])
def test_own_observations_must_be_finite_and_alike(key):
    faulty = own()
    faulty[key][0, 1, 2] = torch.nan
    with pytest.raises(ValueError, match="is not finite: 1 of"):
        check_episodes(faulty, keys=KEYS)
    for change in (lambda value: value.double(), lambda value: value[..., :3]):
        odd = own()
        odd[key] = change(odd[key])
        with pytest.raises(ValueError, match="must be alike"):
            check_episodes(odd, keys=KEYS)


def test_each_episode_of_a_list_is_checked():
    good, bad = followed(1, 2)[0], followed(1, 3)[0]
    bad["action"][1] = torch.inf
    check_episodes([good, good])
    with pytest.raises(ValueError, match="action is not finite"):
        check_episodes([good, bad])
    with pytest.raises(ValueError, match=r"each episode of a list must have batch size \[T\], got \[2, 2\]"):
        check_episodes([good, followed(2, 2)])


def test_a_tag_may_be_its_name(tmp_path):
    folder = save_episodes({"rand": episodes(1, 2)}, tmp_path / "demos", task="navigation", seed=0)
    assert list(load_episodes(folder)) == [Tag.RAND]
    with pytest.raises(ValueError, match="Unknown tag 'random'"):
        save_episodes({"random": episodes(1, 2)}, tmp_path / "others", task="navigation", seed=0)
