"""Memory maps get the disk's space before they are written: a full disk is an error and no SIGBUS."""

import errno
import os

import pytest
import torch
from tensordict import TensorDict

from ls3_torchrl.data import EpisodeKeys, TaggedReplayBuffer
from ls3_torchrl.data.memory_maps import require_free_space
from ls3_torchrl.data.stores import RowStore

reserves = pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="the system has no such call")


def rows(count, size=1000):
    return TensorDict({"deep": {"x": torch.ones(count, size, dtype=torch.uint8)}, "y": torch.ones(count, 1)}, [count])


def taken(folder):
    return sum(path.stat().st_blocks * 512 for path in folder.rglob("*.memmap"))


@reserves
def test_space_is_taken_for_what_is_written_and_not_for_the_whole_room(tmp_path):
    store = RowStore(100_000, folder=tmp_path / "store")
    store.extend(rows(500))
    assert 500 * 1004 <= taken(tmp_path) < 2 * 500 * 1004
    store.extend(rows(1000))
    assert 1500 * 1004 <= taken(tmp_path) < 2 * 1500 * 1004


@reserves
def test_a_disk_that_is_full_is_named_and_what_was_stored_stays(small_disk):
    disk = small_disk(4 * 2**20)
    store = RowStore(100_000, folder=disk / "store")
    store.extend(rows(1000))
    with pytest.raises(OSError, match="no space for 4000 more rows") as raised:
        store.extend(rows(4000))
    assert raised.value.errno == errno.ENOSPC
    assert str(raised.value.filename).startswith(str(disk))
    assert len(store) == store.cursor == 1000
    store.extend(rows(100))
    assert store.storage[:]["deep", "x"].all()


@reserves
def test_a_buffer_on_a_full_disk_stays_as_it_was(small_disk):
    disk = small_disk(2 * 2**20)
    buffer = TaggedReplayBuffer(1000, latent_dim=2, keys=EpisodeKeys(observation="state"), scratch_dir=disk)
    step = {"reward": -torch.ones(50, 1), "state": torch.ones(50, 1000)}
    step |= {key: torch.zeros(50, 1, dtype=torch.bool) for key in ("constraint", "success")}
    episode = TensorDict({"state": torch.ones(50, 1000), "action": torch.zeros(50, 2), "next": step}, [50])
    added = []

    def fill():
        for _ in range(50):
            buffer.add(episode, "online")
            added.append(50)

    with pytest.raises(OSError, match="No space left"):
        fill()
    assert 0 < len(buffer) == sum(added)
    assert len(buffer.sample_frame_transitions(20)) == 20


def test_where_there_is_no_space_for_a_beginning_none_is_made(tmp_path):
    with pytest.raises(OSError, match="No space left on device: 1152921504606846976 bytes are needed") as raised:
        require_free_space(tmp_path, 2**60)
    assert raised.value.errno == errno.ENOSPC
    assert raised.value.filename == str(tmp_path)
