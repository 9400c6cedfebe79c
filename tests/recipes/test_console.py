"""What the terminal is told: lines about data, question marks for what it lacks, and nothing of TorchRL's own."""

import io
import logging
import sys
import warnings

import pytest

from ls3_recipes.console import command_line
from ls3_torchrl.data import DataWarning


def warn_twice():
    with command_line("ls3 train"):
        warnings.warn("No episode ever\n  succeeds.", DataWarning, stacklevel=1)
        warnings.warn("something else", UserWarning, stacklevel=1)


def test_what_is_said_of_data_is_a_line_and_other_warnings_stay_as_they_are(capsys):
    with pytest.warns(UserWarning, match="something else"):
        warn_twice()
    assert "ls3 train: No episode ever succeeds." in capsys.readouterr().err.splitlines()
    with pytest.raises(DataWarning):  # as before
        warnings.warn("again", DataWarning, stacklevel=1)


def test_torchrl_says_nothing_below_a_warning_whenever_it_is_imported(monkeypatch):
    logger = logging.getLogger("torchrl")
    before = logger.level
    told = []
    monkeypatch.setattr(logger, "handlers", [])
    monkeypatch.setattr(logger, "callHandlers", lambda record: told.append(record.getMessage()))
    with command_line("ls3 train"):
        logger.setLevel(logging.INFO)  # as TorchRL does
        logger.info("which backend was found")
        logger.warning("what is wrong")
    logger.info("afterwards")
    logger.setLevel(before)
    assert told == ["what is wrong", "afterwards"]


@pytest.mark.parametrize(
    ("encoding", "shown"),
    [("ascii", b"LS? 1 ? 2"), ("gbk", "LS? 1 ± 2".encode("gbk")), ("utf-8", "LS³ 1 ± 2".encode())],
)
def test_characters_that_a_terminal_lacks_become_question_marks(monkeypatch, encoding, shown):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding=encoding))
    with command_line("ls3 report"):
        print("LS³ 1 ± 2", end="", flush=True)
    assert raw.getvalue() == shown
