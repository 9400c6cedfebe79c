"""``ls3 sweep``: many runs, and a report of them."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from ls3_recipes.arguments import config_dir, name_in, split_arguments
from ls3_recipes.command_settings import SweepSettings
from ls3_recipes.configuration import register, run_command
from ls3_recipes.extra import Job
from ls3_recipes.options import leaves
from ls3_recipes.overrides import choices_of
from ls3_recipes.sweep import JobsFailedError

register("sweep", SweepSettings)
sweep = Job("ls3 sweep", "ls3_recipes.sweep.sweep:sweep")
#: What is the sweep's own; all else is an argument of its runs.
_OWN = (*leaves(SweepSettings), "sweep")


def help_text() -> str:
    """What ``ls3 sweep --help`` begins with."""
    return f"""
Carry out many runs, and report them: a figure of the paper, or settings of your own.

  ls3 sweep [{"|".join(choices_of("sweep"))}] [output=DIR] [KEY=A,B,... of ls3 train]
            [hydra/launcher={"|".join(choices_of("hydra/launcher"))}] [hydra.launcher.KEY=VALUE]

Every combination of the values is a run; several values are written A,B or range(3). What is finished is skipped and
what was cut off goes on when the same command is given again. Runs of one seed share demonstrations and VAE, where
they differ in nothing that these depend on. One run that fails costs the others nothing, and is listed at the end.

In DIR: runs/, jobs.csv (state and outcome of each), logs/, shared/, report/. Watch it: tensorboard --logdir DIR/runs

Examples
  ls3 sweep figure1 seed=0,1,2 output=runs/figure1
  ls3 sweep figure3 task=navigation hydra.launcher.workers=2
  ls3 sweep figure1 'seed=range(10)' hydra/launcher=ray
  ls3 sweep planner.horizon=3,5,8 seed=0,1 online.updates=10
"""


def divided(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """Arguments of the sweep itself, and those of its runs; a word without a value is the sweep's name.

    Example:
        >>> divided(["figure1", "seed=0,1", "output=here", "hydra.launcher.workers=1"])
        (['sweep=figure1', 'output=here', 'hydra.launcher.workers=1'], ['seed=0,1'])
    """
    given = [*overrides]
    for i, override in enumerate(given):
        if "=" not in override and not override.startswith(("+", "~")):
            given[i] = f"sweep={override}"
    own = [override for override in given if name_in(override) in _OWN or name_in(override).startswith("hydra")]
    return own, [override for override in given if override not in own]


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    options, overrides = split_arguments(sys.argv[1:] if arguments is None else arguments)
    if {"-m", "--multirun"} & set(options):
        raise SystemExit("ls3 sweep: several values of a setting are several runs as they are. Leave --multirun out.")
    own, of_runs = divided(overrides)
    files = config_dir(options)

    def carry_out(settings: SweepSettings) -> None:
        try:
            sweep(settings, of_runs, files)
        except JobsFailedError as error:
            raise SystemExit(f"ls3 sweep: {error}") from None

    run_command("sweep", SweepSettings, carry_out, [*own, *options], help_text=help_text())
