"""What a process of a sweep does: one job, which ends when the process that started it does."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ls3_recipes.configuration import checked_settings, errors_in_one_line, settings_class_of
from ls3_recipes.console import command_line
from ls3_recipes.extra import Job
from ls3_recipes.run_files import is_finished
from ls3_recipes.run_folder import Lock
from ls3_recipes.run_settings import RunSettings

collect = Job("ls3 sweep", "ls3_recipes.offline_data:collect_for_run")
train_vae = Job("ls3 sweep", "ls3_recipes.protocol:train_vae")
run_experiment = Job("ls3 sweep", "ls3_recipes.protocol:run_experiment")
roll_out = Job("ls3 sweep", "ls3_recipes.rollouts:roll_out")
#: Seconds between two looks at whether another process has left a folder.
_PATIENCE = 1.0
_PR_SET_PDEATHSIG = 1


def main(arguments: Sequence[str] | None = None) -> None:
    """Do one job.

    Args:
        arguments: the number of the process that started this one; ``data``, ``vae``, ``train`` or ``rollouts``; the
            folder that it goes to; a user's folder of files, or nothing; arguments of ``ls3 train``, or for
            ``rollouts`` a number of episodes.
    """
    parent, kind, folder, files, *rest = [*(sys.argv[1:] if arguments is None else arguments)]
    _end_with(int(parent))
    with command_line("ls3 sweep"), errors_in_one_line("ls3 sweep", Path(folder)):
        if kind == "rollouts":
            roll_out(folder, int(rest[0]))
            return
        settings = replace(_settings(rest, files or None), output=folder)
        if kind == "data":
            collect(settings)
            return
        wait_until_free(Path(folder))
        if not is_finished(folder):
            (train_vae if kind == "vae" else run_experiment)(settings)


def _settings(overrides: Sequence[str], files: str | None) -> RunSettings:
    return checked_settings("train", settings_class_of(overrides), overrides, folder=files)


def wait_until_free(folder: Path) -> None:
    """Wait as long as another process writes to a folder: one that was told to stop, or that does this very work."""
    told = False
    while folder.is_dir():
        try:
            Lock(folder / "lock").release()
        except FileExistsError:
            if not told:
                print(f"Waiting for another process that is writing to {folder}.", flush=True)
            told = True
            time.sleep(_PATIENCE)
        else:
            return


def _end_with(parent: int) -> None:
    """Have the system send SIGTERM when the parent ends, however it ends; on Linux alone."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:  # it has ended before
            raise SystemExit("ls3 sweep: the process that started this one has ended.")


if __name__ == "__main__":
    main()
