"""Which runs a sweep consists of: every arm, with every combination of the values that its settings are given."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import blake2b

from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import HydraException

from ls3_envs.registry import domain
from ls3_recipes.arguments import name_in
from ls3_recipes.configuration import checked_settings, settings_class_of
from ls3_recipes.options import as_dict
from ls3_recipes.overrides import parse
from ls3_recipes.renamed import rename_overrides
from ls3_recipes.report.reading import GIVEN, PLACES, flat
from ls3_recipes.run_settings import RunSettings

#: What separates the parts of a run's name from what file systems may not have.
_UNUSUAL = re.compile(r"[^\w.=,+-]+")
#: Settings that every name has, the first by its value alone.
_ALWAYS = ("algorithm", "task")
#: Bytes of what is special of a run in its name; more are told by a digest.
_LONGEST = 120
#: Settings of a run that a sweep decides.
_OF_THE_SWEEP = ("output", "resume")


@dataclass(frozen=True)
class PlannedRun:
    """One run of a sweep.

    Args:
        name: of its folder.
        overrides: arguments of ``ls3 train`` that make it.
        settings: what they make.
    """

    name: str
    overrides: tuple[str, ...]
    settings: RunSettings


def planned_runs(
    arms: Iterable[Sequence[str]], settings: Sequence[str], given: Sequence[str], *, folder: str | None = None
) -> list[PlannedRun]:
    """All runs of a sweep, those of the first seed first.

    Args:
        arms: arguments of ``ls3 train`` for each; several values of one setting (``A,B``, ``range(3)``) are as many
            runs.
        settings: arguments for all arms, where an arm has no others.
        given: on the command line, in place of those.
        folder: of a user's own files.

    Raises:
        ValueError: for arguments that no run can have, before anything is begun; for two runs that would be alike.

    Example:
        >>> runs = planned_runs([["algorithm=ls3"], ["algorithm=sacfd", "recovery=true"]], ["seed=0,1"], [])
        >>> [run.name for run in runs][:3]
        ['ls3-navigation-seed0', 'sacfd-navigation-recovery=true-seed0', 'ls3-navigation-seed1']
    """
    runs: dict[str, PlannedRun] = {}
    for arm in arms:
        of_arm = [argument for argument in _replaced([*arm], given) if argument not in given]
        merged = _replaced(_replaced([*settings], arm), given)
        for overrides, shown in _combinations(merged, {name_in(argument) for argument in of_arm}):
            class_ = settings_class_of(overrides)
            made = checked_settings("train", class_, overrides, folder=folder)
            _require_horizon(made)
            name = _name_of(made, shown)
            if name in runs and set(runs[name].overrides) != set(overrides):
                raise ValueError(
                    f"Two runs of the sweep would both be called {name}: {' '.join(runs[name].overrides)} and "
                    f"{' '.join(overrides)}. Give the setting that tells them apart several values, or name it in the "
                    "arms."
                )
            runs.setdefault(name, PlannedRun(name, overrides, made))
    _require_different(runs.values())
    return sorted(runs.values(), key=lambda run: run.settings.seed)


def _require_different(runs: Iterable[PlannedRun]) -> None:
    """Refuse runs that differ in nothing but where they lie and what they are computed on."""
    seen: dict[str, PlannedRun] = {}
    for run in runs:
        settings = flat(as_dict(run.settings))
        what = repr({name: value for name, value in settings.items() if name not in PLACES or name in GIVEN})
        other = seen.setdefault(what, run)
        if other is not run:
            raise ValueError(
                f"Two runs of the sweep would do the same: {' '.join(other.overrides)} and {' '.join(run.overrides)}. "
                "Leave one out."
            )


def _require_horizon(settings: RunSettings) -> None:
    """Refuse plans and losses longer than an episode, where its length is known without making the domain."""
    steps = settings.task.horizon or domain(settings.task.name).default_horizon()
    if steps is not None:
        settings.require_horizon(steps)


def _replaced(arguments: Sequence[str], by: Sequence[str]) -> list[str]:
    """Arguments in which others take the place of those of the same name."""
    names = {name_in(argument) for argument in by}
    return [*(argument for argument in rename_overrides(arguments) if name_in(argument) not in names), *by]


def _combinations(
    arguments: Sequence[str], of_arm: set[str]
) -> Iterable[tuple[tuple[str, ...], list[tuple[str, str]]]]:
    """Every choice of one value for each argument, and those that tell the run from others."""
    parsed = parse(arguments)
    choices = [_values(override) for override in parsed]
    shown = [
        len(values) > 1 or name_in(str(override.input_line)) in of_arm
        for override, values in zip(parsed, choices, strict=True)
    ]
    for values in itertools.product(*choices):
        named = [tuple(value.partition("=")[::2]) for value, show in zip(values, shown, strict=True) if show]
        yield values, [(name, value) for name, value in named]


def _values(override: Override) -> list[str]:
    """An argument as Hydra reads it, once for each of its values."""
    if override.get_key_element().lstrip("+~").startswith("hydra"):
        raise ValueError(f"{override.input_line}: where a sweep is carried out is an argument of ls3 sweep itself.")
    if override.get_key_element().lstrip("+~") in _OF_THE_SWEEP:
        raise ValueError(f"{override.input_line}: the sweep itself says where its runs go. Leave it out of the arms.")
    if not override.is_sweep_override():
        return [str(override.input_line)]
    key = override.get_key_element()
    try:
        if values := [f"{key}={value}" for value in override.sweep_string_iterator()]:
            return values
        wrong = "there is no value in it"
    except HydraException as error:
        wrong = "glob() is not known here" if override.value_type is ValueType.GLOB_CHOICE_SWEEP else str(error)
    raise ValueError(
        f"{override.input_line}: {wrong}. Write the values of {key} as A,B or range(FROM,TO) or choice(A,B)."
    )


def _name_of(settings: RunSettings, shown: Sequence[tuple[str, str]]) -> str:
    """A folder's name: algorithm, task, what is special, seed."""
    special = [
        f"{name.lstrip('+~').rpartition('.')[2]}={value}" for name, value in shown if name not in (*_ALWAYS, "seed")
    ]
    begin, middle, end = f"{settings.algorithm}-{settings.task.name}", "-".join(special), f"seed{settings.seed}"
    if len(middle.encode()) > _LONGEST:  # a whole name of more than 255 bytes is no file's
        digest = blake2b(middle.encode(), digest_size=4).hexdigest()
        middle = f"{middle.encode()[:_LONGEST].decode(errors='ignore')}-{digest}"
    return _UNUSUAL.sub("_", "-".join(part for part in (begin, middle, end) if part))
