"""What became of a sweep's runs: a table on the disk, written anew with every change."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from ls3_recipes.run_files import read_json
from ls3_recipes.sweep.jobs import Job
from ls3_torchrl.files import save_text_atomically

COLUMNS = ("name", "kind", "state", "minutes", "success", "violations", "return", "folder", "error", "arguments")
#: States of a job, in the words of the index.
WAITING, RUNNING, FINISHED, FAILED, CUT_OFF, NOT_BEGUN, NOT_NEEDED = (
    *("waiting", "running", "finished", "failed", "cut off", "not begun", "not needed"),
)


class Index:
    """State and outcome of every job; those that earlier calls named are kept in the table.

    Args:
        path: of the table, in CSV.
        jobs: of the sweep.
    """

    def __init__(self, path: Path, jobs: Iterable[Job]) -> None:
        self.path, self._jobs = path, {job.name: job for job in jobs}
        self.states = dict.fromkeys(self._jobs, WAITING)
        self.errors: dict[str, str] = {}
        self._outcomes: dict[str, dict[str, str]] = {}
        self._earlier = [row for row in _rows_of(path) if row["name"] not in self._jobs]

    def set(self, states: Mapping[str, str], errors: Mapping[str, str] | None = None) -> None:
        """Change the states of some jobs, and write the table."""
        self.states.update(states)
        self.errors.update(errors or {})
        done = [self._jobs[name] for name, state in states.items() if state == FINISHED]
        self._outcomes |= {job.name: outcome_of(job) for job in done}
        text = io.StringIO()
        rows = csv.DictWriter(text, COLUMNS)
        rows.writeheader()
        rows.writerows(self._row(job) for job in self._jobs.values())
        rows.writerows(self._earlier)
        save_text_atomically(text.getvalue(), self.path)

    def _row(self, job: Job) -> dict[str, str]:
        return {
            "name": job.name,
            "kind": job.kind,
            "state": self.states[job.name],
            "folder": str(job.folder.relative_to(self.path.parent)),
            "error": self.errors.get(job.name, ""),
            "arguments": " ".join(job.arguments),
            **self._outcomes.get(job.name, {}),
        }


def _rows_of(path: Path) -> list[dict[str, str]]:
    """What an earlier call has written; jobs that were under way were cut off with it."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, ValueError, csv.Error):
        return []
    if any(set(row) != set(COLUMNS) or None in row.values() for row in rows):
        return []  # damaged, or of another version: the folders of the runs are what counts
    return [row | {"state": CUT_OFF if row["state"] == RUNNING else row["state"]} for row in rows]


def outcome_of(job: Job) -> dict[str, str]:
    """Minutes of a job, and how a run's evaluation went, where its summary tells."""
    out: dict[str, str] = {}
    if job.kind in ("vae", "train"):
        with suppress(OSError, ValueError, KeyError):
            summary = read_json(job.folder / "summary.json")
            out["minutes"] = f"{summary['minutes']:.1f}"
            evaluation = summary["evaluation"]
            out |= {
                "success": f"{evaluation['success_rate']:.2f}",
                "violations": f"{evaluation['violation_rate']:.2f}",
                "return": f"{evaluation['return_mean']:.1f}",
            }
    return out
