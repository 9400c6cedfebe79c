"""Damaged files of episodes and buffers: what is read is what was written, or an error names the file."""

import json
import shutil

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from ls3_torchrl.data import EpisodeKeys, Tag, TaggedReplayBuffer, load_episodes, save_episodes
from ls3_torchrl.files import new_folder

KEYS = EpisodeKeys(observation="state")


def episode(steps, seed):
    generator = torch.Generator().manual_seed(seed)
    state = torch.randn(steps + 1, 2, generator=generator)
    reached = torch.arange(steps).unsqueeze(-1) == steps - 1
    after = {"state": state[1:], "reward": reached.float() - 1.0, "success": reached, "constraint": ~reached}
    kind = torch.randn(steps, 2, generator=generator).bfloat16()  # a dtype that NumPy lacks
    entries = {"state": state[:-1], "action": torch.randn(steps, 1, generator=generator), "kind": kind, "next": after}
    return TensorDict(entries, [steps])


EPISODES = [episode(3, 0), episode(5, 1), episode(2, 2)]


def save_dataset(folder):
    return save_episodes({Tag.SUCCESS: EPISODES, Tag.RAND: EPISODES[:1]}, folder, task="x", seed=0, keys=KEYS)


def read_dataset(folder):
    read = load_episodes(folder, task="x", keys=KEYS)
    rows = [*read[Tag.SUCCESS].unbind(0), *read[Tag.RAND].unbind(0)]
    expected = [*EPISODES, EPISODES[0]]
    return len(rows) == len(expected) and all(same(a, b) for a, b in zip(rows, expected, strict=True))


def same(one, other):
    keys = set(one.keys(True, True))
    return keys == set(other.keys(True, True)) and all(
        one[key].dtype == other[key].dtype and torch.equal(one[key], other[key]) for key in keys
    )


def make_buffer():
    return TaggedReplayBuffer(50, latent_dim=2, keys=KEYS)


def filled():
    buffer = make_buffer()
    buffer.encode(TensorDictModule(torch.nn.Identity(), ["state"], ["latent"]))
    buffer.add(EPISODES, "success")
    return buffer


def save_buffer(folder):
    filled().dumps(folder)
    return folder


def read_buffer(folder):
    buffer, expected = make_buffer(), filled()
    buffer.add(EPISODES[:1], "rand")
    try:
        buffer.loads(folder)
    except (ValueError, OSError):
        assert len(buffer) == 3  # what was there stays
        raise
    pairs = ((buffer.transitions, expected.transitions), (buffer.frames, expected.frames))
    return all(len(a) == len(b) and a.cursor == b.cursor and (a.storage[:] == b.storage[:]).all() for a, b in pairs)


KINDS = {"dataset": (save_dataset, read_dataset), "buffer": (save_buffer, read_buffer)}


@pytest.fixture(scope="module", params=list(KINDS))
def kind(request, tmp_path_factory):
    save, read = KINDS[request.param]
    folder = save(tmp_path_factory.mktemp("whole") / "data")
    assert read(folder)
    return folder, read, tmp_path_factory.mktemp("damaged")


def files_of(folder):
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def check(folder, read):
    """Right content or one error that names a file; and nothing on the disk is changed by looking at it."""
    before = files_of(folder)
    try:
        return read(folder)
    except (ValueError, FileNotFoundError) as error:
        return str(folder) in str(error)
    finally:
        assert files_of(folder) == before


def damaged_copy(kind, change):
    whole, read, room = kind
    folder = room / "data"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(whole, folder)
    change(folder)
    return check(folder, read)


@settings(max_examples=500)
@given(which=st.floats(0, 1, exclude_max=True), where=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_in_any_file_is_found_or_changes_nothing(kind, which, where, bit):
    def flip(folder):
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        file = files[int(which * len(files))]
        content = bytearray(file.read_bytes())
        content[int(where * len(content))] ^= 1 << bit
        file.write_bytes(content)

    assert damaged_copy(kind, flip)


@settings(max_examples=300)
@given(
    which=st.floats(0, 1, exclude_max=True),
    how=st.sampled_from(["cut", "longer", "empty", "removed", "swapped", "folder", "pickle", "text"]),
    where=st.floats(0, 1),
)
def test_a_file_that_is_not_what_was_written_is_found(kind, which, how, where):
    def damage(folder):
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        file = files[int(which * len(files))]
        content = file.read_bytes()
        if how in ("removed", "folder"):
            file.unlink()
            if how == "folder":
                file.mkdir()
        elif how == "swapped":
            other = files[int(where * (len(files) - 1))]
            file.write_bytes(other.read_bytes())
            other.write_bytes(content)
        else:
            new = {
                "cut": content[: int(where * len(content))],
                "longer": content + content,
                "empty": b"",
                "pickle": b"cos\nsystem\n(S'touch /tmp/was_run'\ntR.",
                "text": "ümläut".encode("latin-1"),
            }[how]
            file.write_bytes(new)

    assert damaged_copy(kind, damage)


LEAVES = st.sampled_from([None, 0, -1, 3, 10**12, 2.5, "x", "../../x", [], {}, True, [1, 2], "float64"])


@settings(max_examples=300)
@given(path=st.lists(st.floats(0, 1, exclude_max=True), min_size=1, max_size=4), value=LEAVES, drop=st.booleans())
def test_a_description_that_was_edited_is_refused(kind, path, value, drop):
    def edit(folder):
        files = sorted(folder.rglob("*.json"))
        file = files[int(path[0] * len(files))]
        content = json.loads(file.read_text())
        node = content
        for step in path:
            names = list(node) if isinstance(node, dict) else range(len(node))
            if not names:
                break
            name = names[int(step * len(names))]
            if isinstance(node[name], (dict, list)) and step != path[-1]:
                node = node[name]
                continue
            if drop:
                del node[name]
            else:
                node[name] = value
            break
        file.write_text(json.dumps(content))

    assert damaged_copy(kind, edit)


def test_counts_that_were_edited_to_the_same_sum_are_refused(tmp_path):
    folder = save_dataset(tmp_path / "data")
    path = folder / "episodes.json"
    description = json.loads(path.read_text())
    description["episodes"]["success"] = [5, 3, 2]
    path.write_text(json.dumps(description))
    with pytest.raises(ValueError, match=r"episodes\.json does not match its checksum.*edited by hand"):
        load_episodes(folder, keys=KEYS)


def test_a_name_that_leads_out_of_the_folder_is_not_followed(tmp_path, monkeypatch):
    from ls3_torchrl.data import arrays

    folder = save_dataset(tmp_path / "data")
    np.save(tmp_path / "secret.npy", np.zeros(3))
    path = folder / "episodes.json"
    description = json.loads(path.read_text())
    for name in ("../secret.npy", str(tmp_path / "secret.npy")):
        description["entries"]["success"][0]["file"] = name
        path.write_text(json.dumps(arrays.with_checksum({k: v for k, v in description.items() if k != "checksum"})))
        with pytest.raises(ValueError, match="names a file outside of itself"):
            load_episodes(folder, keys=KEYS)


# --- writing ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("save", [save_dataset, save_buffer])
@pytest.mark.parametrize("fails_at", range(6))
def test_a_full_disk_is_named_and_leaves_what_was_there(tmp_path, monkeypatch, save, fails_at):
    import pathlib

    target = tmp_path / "data"
    if save is save_buffer:
        save(target)
    before, calls = files_of(tmp_path), []
    opened = pathlib.Path.open

    class Full:
        def __init__(self, file):
            self.file = file

        def __enter__(self):
            self.file.__enter__()
            return self

        def __exit__(self, *error):
            return self.file.__exit__(*error)

        def __getattr__(self, name):
            return getattr(self.file, name)

        def write(self, content):
            calls.append(None)
            if len(calls) > fails_at:
                raise OSError(28, "No space left on device")
            return self.file.write(content)

    def opening(path, mode="r", *args, **kwargs):
        file = opened(path, mode, *args, **kwargs)
        return Full(file) if "w" in mode else file

    monkeypatch.setattr(pathlib.Path, "open", opening)
    with pytest.raises(OSError, match="No space left on device; it could not be written") as caught:
        save(target)
    assert str(tmp_path) in caught.value.filename
    monkeypatch.setattr(pathlib.Path, "open", opened)
    assert files_of(tmp_path) == before


def test_a_folder_takes_its_place_whole_or_not_at_all(tmp_path):
    def break_off():
        with new_folder(tmp_path / "data") as new:
            (new / "one.txt").write_text("1")
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        break_off()
    assert list(tmp_path.iterdir()) == []
    with new_folder(tmp_path / "data") as new:
        (new / "one.txt").write_text("1")
    with pytest.raises(FileExistsError, match="exists already"), new_folder(tmp_path / "data") as new:
        (new / "one.txt").write_text("2")
    assert (tmp_path / "data" / "one.txt").read_text() == "1"
    with new_folder(tmp_path / "data", replace=True) as new:
        (new / "two.txt").write_text("2")
    assert [file.name for file in (tmp_path / "data").iterdir()] == ["two.txt"]
    assert [folder.name for folder in tmp_path.iterdir()] == ["data"]
