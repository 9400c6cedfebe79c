"""A file is whole or not there."""

import json

import pytest
import torch

from ls3_torchrl.files import save_atomically, save_json_atomically


class Unpicklable:
    def __reduce__(self):
        raise RuntimeError("power cut")


def test_a_save_that_fails_leaves_the_old_file(tmp_path):
    path = save_atomically({"weights": torch.ones(3)}, tmp_path / "new" / "file.pt")
    with pytest.raises(RuntimeError, match="power cut"):
        save_atomically({"weights": Unpicklable()}, path)
    assert torch.equal(torch.load(path)["weights"], torch.ones(3))
    save_atomically({"weights": torch.zeros(3)}, path)
    assert torch.equal(torch.load(path)["weights"], torch.zeros(3))
    assert [file.name for file in path.parent.iterdir()] == ["file.pt"]


def test_json_is_whole_or_not_there_too(tmp_path):
    path = save_json_atomically({"answer": 42}, tmp_path / "new" / "file.json")
    with pytest.raises(TypeError, match="not JSON serializable"):
        save_json_atomically({"answer": object()}, path)
    assert json.loads(path.read_text()) == {"answer": 42}
    assert [file.name for file in path.parent.iterdir()] == ["file.json"]
