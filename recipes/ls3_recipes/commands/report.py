"""``ls3 report``: several finished runs in one picture and one table."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ls3_recipes.command_settings import ReportSettings
from ls3_recipes.configuration import register, run_command
from ls3_recipes.extra import Job

HELP = """
Compare finished runs: success, violations and return against online episodes, mean and standard error over seeds.

  ls3 report "runs=[DIR,DIR,...]" [output=DIR]

All runs must be of one task, with the same number of online episodes.

Examples
  ls3 report "runs=[runs/ls3-0,runs/ls3-1,runs/awac-0,runs/awac-1]" output=runs/report
"""


register("report", ReportSettings)
report = Job("ls3 report", "ls3_recipes.comparison:report")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    arguments = sys.argv[1:] if arguments is None else arguments
    run_command("report", ReportSettings, report, arguments, help_text=HELP)
