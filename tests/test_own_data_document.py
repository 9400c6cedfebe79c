"""The document on own data does what it says: its Python runs as it stands."""

import shutil
import warnings
from pathlib import Path

import documents
from PIL import Image

from ls3_torchrl.data import Tag

ROOT = Path(__file__).parents[1]


def test_the_document_on_own_data_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    run = tmp_path / "recordings" / "run_1"
    run.mkdir(parents=True)
    for t in range(21):
        Image.new("RGB", (320, 240), (10 * t, 0, 0)).save(run / f"img_{t}.png")
    shutil.copytree(ROOT / "tests" / "data" / "lerobot_v3", tmp_path / "recordings" / "push")
    with warnings.catch_warnings():
        # What Minari itself says of a dataset without an author.
        warnings.filterwarnings("ignore", message=".*is set to None|env_spec is None")
        names = documents.run("own_data.md")
    assert list(names["foreign"]) == [Tag.CONSTRAINT]
    assert list(names["robot"]) == [Tag.SUCCESS, Tag.CONSTRAINT]
    assert len(names["buffer"]) == 20 + 20 + 8 + 7
    assert names["episode"]["pixels"][:, 0, 0, 0].tolist() == list(range(0, 200, 10))
