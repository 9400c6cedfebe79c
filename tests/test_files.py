"""A file or folder is whole or not there, and damage is told by name."""

import json
import os
import threading
from pathlib import Path

import pytest
import torch

from ls3_torchrl.files import (
    allocate,
    file_manifest,
    new_folder,
    read_json,
    save_atomically,
    save_json_atomically,
    save_text_atomically,
    verify_files,
)


class Unpicklable:
    def __reduce__(self):
        raise RuntimeError("power cut")


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_save_that_fails_leaves_the_old_file(tmp_path):
    path = save_atomically({"weights": torch.ones(3)}, tmp_path / "new" / "file.pt")
    with pytest.raises(RuntimeError, match="power cut"):
        save_atomically({"weights": Unpicklable()}, path)
    assert torch.equal(torch.load(path)["weights"], torch.ones(3))
    save_atomically({"weights": torch.zeros(3)}, path)
    assert torch.equal(torch.load(path)["weights"], torch.zeros(3))
    assert names(path.parent) == ["file.pt"]


def test_json_is_whole_or_not_there_too(tmp_path):
    path = save_json_atomically({"answer": 42}, tmp_path / "new" / "file.json")
    with pytest.raises(TypeError, match="not JSON serializable"):
        save_json_atomically({"answer": object()}, path)
    assert json.loads(path.read_text(encoding="utf-8")) == {"answer": 42}
    assert names(path.parent) == ["file.json"]


def test_text_is_utf_8_whatever_the_machine_speaks(tmp_path):
    path = save_text_atomically("Größe: ≤ 3 m²", tmp_path / "file.yaml")
    assert path.read_bytes().decode("utf-8") == "Größe: ≤ 3 m²"


def test_savers_at_once_do_not_mix(tmp_path):
    path = tmp_path / "file.txt"
    texts = [str(i) * 300_000 for i in range(8)]
    threads = [threading.Thread(target=save_text_atomically, args=(text, path)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.read_text(encoding="utf-8") in texts
    assert names(tmp_path) == ["file.txt"]


@pytest.fixture
def full_disk():
    """No file may be larger than 64 KiB: the system's error is one of those of a full disk."""
    resource, signal = pytest.importorskip("resource"), pytest.importorskip("signal")
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk_is_named_and_nothing_half_written_is_left(tmp_path, full_disk):
    path = save_text_atomically("old", tmp_path / "file")
    for save in (
        lambda: save_atomically({"weights": torch.ones(100_000)}, path),
        lambda: save_text_atomically("new" * 100_000, path),
    ):
        with pytest.raises(OSError, match="could not be written") as raised:
            save()
        assert raised.value.filename == str(path)
    assert path.read_text(encoding="utf-8") == "old"
    assert names(tmp_path) == ["file"]


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="the system cannot")
def test_space_is_taken_before_it_is_written(tmp_path):
    path = tmp_path / "sparse"
    with path.open("wb") as file:
        file.truncate(1 << 20)
    assert path.stat().st_blocks * 512 < 1 << 20
    allocate(path)
    assert path.stat().st_blocks * 512 >= 1 << 20
    assert path.stat().st_size == 1 << 20


def test_a_folder_is_whole_or_not_there(tmp_path):
    with new_folder(tmp_path / "deep" / "data") as inside:
        (inside / "one.txt").write_text("1", encoding="utf-8")
        assert names(tmp_path / "deep") == [inside.name]
        assert inside.name.endswith(".partial")
    assert names(tmp_path / "deep") == ["data"]

    def half():
        with new_folder(tmp_path / "other") as inside:
            (inside / "one.txt").write_text("1", encoding="utf-8")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half()
    assert names(tmp_path) == ["deep"]


def test_a_folder_takes_the_place_of_nothing(tmp_path):
    def make():
        with new_folder(tmp_path / "data") as inside:
            (inside / "mine.txt").write_text("mine", encoding="utf-8")
            (tmp_path / "data").mkdir()  # somebody was faster
            (tmp_path / "data" / "theirs.txt").write_text("theirs", encoding="utf-8")

    with pytest.raises(FileExistsError, match="exists already"):
        make()
    assert names(tmp_path) == ["data"]
    assert names(tmp_path / "data") == ["theirs.txt"]


@pytest.fixture
def folder(tmp_path):
    for name in ("a.bin", "deep/b.bin"):
        path = tmp_path / "folder" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bytes(range(256)) * 20)
    return tmp_path / "folder"


def test_a_manifest_survives_json_and_leaves_out_what_is_half_written(folder):
    manifest = file_manifest(folder)
    assert list(manifest) == ["a.bin", "deep/b.bin"]
    (folder / "deep" / "c.bin.0123.partial").write_bytes(b"half")
    (folder / "d.0123.partial").mkdir()
    (folder / "d.0123.partial" / "d.bin").write_bytes(b"half")
    assert file_manifest(folder) == manifest
    verify_files(folder, json.loads(json.dumps(manifest)))


@pytest.mark.parametrize("damage", ["flip", "swap", "truncate", "extend", "empty"])
def test_damage_is_found_and_named(folder, damage):
    manifest, path = file_manifest(folder), folder / "deep" / "b.bin"
    content = bytearray(path.read_bytes())
    if damage == "flip":
        content[777] ^= 4
    elif damage == "swap":
        content[10], content[11] = content[11], content[10]
    path.write_bytes({"truncate": content[:-1], "extend": content + b"\0", "empty": b""}.get(damage, content))
    with pytest.raises(ValueError, match=r"b\.bin is damaged.*Fetch it again\.") as raised:
        verify_files(folder, manifest, remedy="Fetch it again.")
    assert str(path) in str(raised.value)


def test_a_missing_file_is_named(folder):
    manifest = file_manifest(folder)
    (folder / "a.bin").unlink()
    with pytest.raises(FileNotFoundError, match=r"a\.bin is missing"):
        verify_files(folder, manifest)


@pytest.mark.parametrize("name", ["../folder/a.bin", "/etc/passwd", "deep/../a.bin", "", "c:/x", "deep\\b.bin", "a\0"])
def test_a_manifest_never_leads_out_of_its_folder(folder, name):
    with pytest.raises(ValueError, match="only files below it are read"):
        verify_files(folder, {name: {"size": 1, "crc32": "00000000"}})


@pytest.mark.parametrize("manifest", [None, [], "a.bin", {"a.bin": None}, {"a.bin": {"size": 1}}, {"a.bin": [1, 2]}])
def test_a_manifest_that_is_none_is_refused(folder, manifest):
    with pytest.raises(ValueError, match=r"list of files of .* is damaged"):
        verify_files(folder, manifest)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe{}", b"[1]", b"null", b"3", b'{"a": 1} x', b"[" * 100_000])
def test_json_that_is_damaged_is_named(tmp_path, content):
    path = tmp_path / "file.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"file\.json is damaged.*Take the copy\."):
        read_json(path, remedy="Take the copy.")
    with pytest.raises(FileNotFoundError, match=r"other\.json is missing. Take the copy\."):
        read_json(Path(tmp_path / "other.json"), remedy="Take the copy.")
