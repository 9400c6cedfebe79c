"""A run's folder and its logger."""

import json
import platform
from importlib.metadata import version
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchrl.record.loggers import Logger

from ls3_recipes.run_files import read_metrics
from ls3_recipes.run_folder import Lock, RunFolder
from ls3_recipes.run_logger import RunLogger
from ls3_torchrl.data import DataWarning


def test_scalars_go_to_the_table_and_to_tensorboard(tmp_path):
    logger = RunLogger(tmp_path)
    assert isinstance(logger, Logger)
    logger.log_scalar("Value, TD-1/loss_value", 1.0 / 3.0, step=7)
    logger.log_scalar("online/mean_return", -50, step=4)
    rows = read_metrics(tmp_path)  # written at once, not when the run ends
    logger.close()
    assert [{k: v for k, v in row.items() if k != "seconds"} for row in rows] == [
        {"phase": "Value, TD-1", "step": "7", "name": "loss_value", "value": "0.333333"},
        {"phase": "online", "step": "4", "name": "mean_return", "value": "-50"},
    ]
    assert all(0.0 <= float(row["seconds"]) < 60.0 for row in rows)
    board = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert board.Tags()["scalars"] == ["Value, TD-1/loss_value", "online/mean_return"]
    assert board.Scalars("online/mean_return")[0].step == 4


def test_metrics_of_a_dictionary_are_taken_as_every_logger_of_torchrl_takes_them(tmp_path):
    logger = RunLogger(tmp_path)
    logger.log_metrics({"a/x": 1.0, "a/y": 2.0}, step=3)
    logger.close()
    assert [(row["phase"], row["name"]) for row in read_metrics(tmp_path)] == [("a", "x"), ("a", "y")]


def test_a_folder_begins_with_settings_and_versions_and_is_never_reused(tmp_path):
    folder = RunFolder.make(tmp_path / "run", {"seed": 3, "agent": {"hidden": [16]}})
    folder.close()
    assert OmegaConf.load(folder.path / "config.yaml") == {"seed": 3, "agent": {"hidden": [16]}}
    versions = json.loads((folder.path / "versions.json").read_text())
    assert versions["torch"] == version("torch")
    assert versions["python"] == platform.python_version()
    assert folder.agent(7).name == "agent_007.pt"
    with pytest.raises(FileExistsError, match=r"exists already.*output=DIR"):
        RunFolder.make(tmp_path / "run", {})


def test_settings_are_written_whole_or_not_at_all(tmp_path, monkeypatch):
    def fail(self, target):
        raise OSError("no power")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="no power"):
        RunFolder.make(tmp_path / "run", {"seed": 3})
    assert not (tmp_path / "run" / "config.yaml").exists()


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    folder = RunFolder.make(tmp_path / "run", {})
    folder.write_json("summary.json", {"a": 1})
    with pytest.raises(TypeError):
        folder.write_json("summary.json", {"a": object()})
    folder.close()
    assert json.loads((folder.path / "summary.json").read_text()) == {"a": 1}


def test_a_table_that_is_gone_on_with_loses_what_came_after_the_state_and_no_byte_before(tmp_path):
    logger = RunLogger(tmp_path)
    logger.log_scalar("a/x", 1.0, step=1)
    state = logger.state_dict()
    kept = (tmp_path / "metrics.csv").read_bytes()
    logger.log_scalar("a/x", 2.0, step=2)
    logger.close()
    with (tmp_path / "metrics.csv").open("ab") as file:
        file.write(b"0.1,a,3,x")  # cut off in the middle of a line
    again = RunLogger(tmp_path)
    again.load_state_dict(state)
    assert (tmp_path / "metrics.csv").read_bytes() == kept
    again.log_scalar("a/x", 3.0, step=2)
    again.close()
    assert [(row["step"], row["value"]) for row in read_metrics(tmp_path)] == [("1", "1"), ("2", "3")]
    board = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [event.value for event in board.Scalars("a/x")] == [1.0, 3.0]


def test_rows_that_are_gone_are_said(tmp_path):
    logger = RunLogger(tmp_path)
    for step in range(3):
        logger.log_scalar("a/x", 1.0, step=step)
    state = logger.state_dict()
    logger.close()
    lines = (tmp_path / "metrics.csv").read_bytes().splitlines(keepends=True)
    (tmp_path / "metrics.csv").write_bytes(b"".join(lines[:2]))
    again = RunLogger(tmp_path)
    with pytest.warns(DataWarning, match="has 1 rows, where 3 were written; the others are lost"):
        again.load_state_dict(state)
    again.close()


def test_a_lock_that_was_released_and_removed_in_between_is_taken_anew(tmp_path):
    first = Lock(tmp_path / "lock")
    with pytest.raises(FileExistsError, match="Another process is writing"):
        Lock(tmp_path / "lock")
    first.release()
    second = Lock(tmp_path / "lock")
    (tmp_path / "lock").unlink()
    third = Lock(tmp_path / "lock")  # another file: the old one says nothing
    assert (tmp_path / "lock").exists()
    for lock in (second, third):
        lock.release()
