"""States of training: the newest two are kept, a damaged one gives way to the one before, and a full disk is named."""

import errno
import pickle
import shutil
import warnings
import zipfile

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ls3_torchrl.data import DataWarning
from ls3_torchrl.trainers import Checkpoints


class Part:
    """Something with a state."""

    def __init__(self, number=0.0):
        self.state = {"weights": torch.full((40,), number), "counters": {"step": int(number)}, "names": ["a", "b"]}

    def state_dict(self):
        return self.state

    def load_state_dict(self, state_dict):
        self.state = {"weights": state_dict["weights"], "counters": dict(state_dict["counters"])}
        self.state["names"] = list(state_dict["names"])

    @property
    def number(self):
        assert (self.state["weights"] == self.state["counters"]["step"]).all()
        assert self.state["names"] == ["a", "b"]
        return self.state["counters"]["step"]


def saved(folder, *numbers):
    checkpoints = Checkpoints(folder)
    for number in numbers:
        checkpoints.save({"one": Part(float(number)), "two": Part(-float(number))})
    return checkpoints


def loaded(folder):
    parts = {"one": Part(), "two": Part()}
    assert Checkpoints(folder).load(parts)
    assert parts["two"].number == -parts["one"].number
    return parts["one"].number


def test_the_newest_state_is_taken_up_and_the_one_before_is_kept(tmp_path):
    saved(tmp_path, 1, 2, 3, 4)
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".torchrl"] * 2
    assert loaded(tmp_path) == 4
    saved(tmp_path, 5)
    assert loaded(tmp_path) == 5
    assert len(list(tmp_path.iterdir())) == 2


def test_without_a_state_nothing_is_taken_up(tmp_path):
    part = Part(7.0)
    assert not Checkpoints(tmp_path / "new").load({"one": part})
    assert part.number == 7


def test_a_damaged_newest_state_gives_way_to_the_one_before_and_that_is_said(tmp_path):
    saved(tmp_path, 1, 2)
    newest = max(tmp_path.iterdir())
    newest.write_bytes(newest.read_bytes()[:-200])
    with pytest.warns(DataWarning, match=rf"{newest.name} cannot be read.*the one before"):
        assert loaded(tmp_path) == 1
    # It takes no place of a whole one.
    assert not newest.exists()
    saved(tmp_path, 3)
    assert loaded(tmp_path) == 3
    max(tmp_path.glob("*.torchrl")).write_bytes(b"")
    with pytest.warns(DataWarning, match="the one before"):
        assert loaded(tmp_path) == 1
    checkpoints = saved(tmp_path, 4)
    checkpoints.remove()
    assert list(tmp_path.iterdir()) == []


def test_when_no_state_is_whole_nothing_starts_by_itself(tmp_path):
    saved(tmp_path, 1, 2)
    for path in tmp_path.iterdir():
        path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"run-.*cannot be read.*No state is whole.*another folder"):
        loaded(tmp_path)


def test_what_a_killed_save_left_is_removed(tmp_path):
    saved(tmp_path, 1, 2)
    (tmp_path / ".run-000000000003.torchrl.tmp-1").mkdir()
    (tmp_path / ".run-000000000003.torchrl.tmp-2").write_bytes(b"half")
    assert loaded(tmp_path) == 2
    assert all(path.name.startswith("run-") for path in tmp_path.iterdir())


def test_a_finished_run_keeps_no_state(tmp_path):
    checkpoints = saved(tmp_path, 1, 2)
    assert checkpoints.exist()
    checkpoints.remove()
    assert not checkpoints.exist()
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Two whole states, as bytes."""
    folder = tmp_path_factory.mktemp("pair")
    saved(folder, 1, 2)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def damaged(folder, pair, change):
    """What is taken up when the newest state was changed."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    before, newest = pair
    (folder / before).write_bytes(pair[before])
    (folder / newest).write_bytes(change(bytearray(pair[newest])))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return loaded(folder)


@settings(max_examples=600)
@given(where=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_anywhere_is_found_or_changes_nothing(tmp_path_factory, pair, where, bit):
    def flip(content):
        content[int(where * len(content))] ^= 1 << bit
        return content

    assert damaged(tmp_path_factory.getbasetemp() / "flipped", pair, flip) in (1, 2)


@settings(max_examples=400)
@given(cut=st.floats(0, 1), tail=st.binary(max_size=40), at=st.floats(0, 1), middle=st.binary(max_size=40))
@example(cut=0.0, tail=b"", at=0.0, middle=b"")
@example(cut=1.0, tail=b"behind", at=0.0, middle=b"")
def test_a_state_that_was_cut_or_written_over_is_found(tmp_path_factory, pair, cut, tail, at, middle):
    def change(content):
        content = content[: int(cut * len(content))] + tail
        start = int(at * len(content))
        return content[:start] + middle + content[start + len(middle) :]

    assert damaged(tmp_path_factory.getbasetemp() / "cut", pair, change) in (1, 2)


class Evil:
    def __reduce__(self):
        return (pytest.fail, ("code in a file was run",))


def test_no_code_in_a_state_is_run(tmp_path):
    saved(tmp_path, 1, 2)
    newest = max(tmp_path.iterdir())
    with zipfile.ZipFile(newest) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(newest, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, pickle.dumps(Evil(), protocol=2) if name.endswith(".pt") else content)
    assert sum(name.endswith(".pt") for name in entries) == 2
    with pytest.warns(DataWarning, match="cannot be read"):
        assert loaded(tmp_path) == 1


def test_a_full_disk_is_named_and_the_state_before_stays(tmp_path, monkeypatch):
    checkpoints = saved(tmp_path, 1)

    def fail(*args, **kwargs):
        raise RuntimeError("unexpected pos 64 vs 0")  # PyTorch's words for it

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(RuntimeError, match="unexpected pos"):  # there is room: it is something else
        checkpoints.save({"one": Part(2.0), "two": Part(-2.0)})
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=0))
    with pytest.raises(OSError, match="No space left on device: the state could not be saved") as raised:
        checkpoints.save({"one": Part(2.0), "two": Part(-2.0)})
    assert raised.value.errno == errno.ENOSPC
    assert raised.value.filename == str(tmp_path)
    assert loaded(tmp_path) == 1
