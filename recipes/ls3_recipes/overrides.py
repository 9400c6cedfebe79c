"""Arguments of the command line, checked before Hydra sees them: syntax, names, choices and what is given twice."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from ls3_recipes.options import defaults, leaves, unknown
from ls3_recipes.renamed import REMOVED, removed
from ls3_recipes.run_files import read_yaml
from ls3_recipes.typed import did_you_mean

CONF = Path(__file__).parent / "conf"
#: Folders of ``conf/`` whose files can be chosen, by command.
GROUPS = {
    "train": ("algorithm", "task", "preset", "tuned", "comparison"),
    "collect": ("task",),
    "sweep": ("sweep", "hydra/launcher"),
}


def parse(overrides: Iterable[str]) -> list[Override]:
    """Arguments as Hydra reads them.

    Raises:
        ValueError: for one that cannot be read, with how it would be written.

    Example:
        >>> parse(["planner.horizon"])
        Traceback (most recent call last):
        ...
        ValueError: 'planner.horizon' is no setting: write KEY=VALUE, such as planner.horizon=VALUE.
    """
    parser, out = OverridesParser.create(), []
    for override in overrides:
        key, equals, value = override.partition("=")
        if not key.lstrip("+~").strip() or not (equals or key.startswith("~")):
            example = f", such as {key}=VALUE" if key.strip() else ""
            raise ValueError(f"{override!r} is no setting: write KEY=VALUE{example}.")
        try:
            out.append(parser.parse_override(override))
        except HydraException:
            quoted = value.replace("\\", "\\\\").replace("'", "\\'")
            raise ValueError(
                f"{override}: the value of {key} cannot be read. Close brackets and quotes; put a text with special "
                f"characters in quotes, and those in the shell's: \"{key}='{quoted}'\"."
            ) from None
    return out


def check(
    overrides: Iterable[str], settings: type, groups: Sequence[str], *, folder: str | None = None, sweeps: bool = False
) -> None:
    """Refuse arguments that set nothing, or not what they seem to.

    Args:
        overrides: the arguments, with present names.
        settings: of the command.
        groups: folders of ``conf/`` whose files can be chosen.
        folder: of a user's own files.
        sweeps: whether several values of a setting mean several runs.

    Raises:
        ValueError: naming the argument, and the nearest that there is.
    """
    seen: dict[str, str] = {}
    overrides = [*overrides]
    for override in parse(overrides):
        name, line = override.get_key_element().lstrip("+~"), str(override.input_line)
        if name.startswith("hydra.launcher.") and "hydra/launcher" in groups:
            _check_launcher(name.removeprefix("hydra.launcher."), overrides)
        if name.startswith(("hydra.", "hydra/")) and name not in groups:
            continue
        if name in seen and seen[name] != line:
            raise ValueError(f"{name} is given twice: {seen[name]} and {line}. Leave one out.")
        seen[name] = line
        if override.is_sweep_override() and not sweeps:
            raise ValueError(
                f"{line}: one run has one value of {name}. Write a list as {name}=[A,B], a text with a comma in quotes "
                "within quotes, or start a run for each value."
            )
        if name in groups:
            _check_choice(name, override.value(), folder)
        elif "@" not in name:
            _check_name(name, settings)


def _check_choice(group: str, value: Any, folder: str | None) -> None:
    if isinstance(value, Mapping | list):
        raise ValueError(f"{group} is chosen by name, got {value}: write {group}=NAME, or {group}.KEY=VALUE.")
    choices = choices_of(group, folder)
    if value is not None and str(value) not in choices:
        nearest = did_you_mean(str(value), choices)
        raise ValueError(f"{group} must be one of {', '.join(choices)}; got {str(value)!r}{nearest or '.'}")


def _check_launcher(name: str, overrides: Iterable[str]) -> None:
    """Refuse a setting that the chosen launcher of this project lacks."""
    given = [value for key, _, value in (o.partition("=") for o in overrides) if key == "hydra/launcher"]
    path = CONF / "hydra" / "launcher" / f"{given[-1] if given else 'local'}.yaml"
    known = [*read_yaml(path)] if path.is_file() else []
    if known and name.partition(".")[0] not in known:
        raise ValueError(unknown(name, known, "hydra.launcher", [f"hydra.launcher.{key}" for key in known]))


def _check_name(name: str, settings: type) -> None:
    """Refuse a name that the settings lack."""
    node: Any = defaults(settings)
    path = name.split(".")
    for depth, key in enumerate(path):
        where = ".".join(path[:depth])
        if not isinstance(node, Mapping):
            raise ValueError(f"{where} is one setting, not a section: {name} is none. Write {where}=VALUE.")
        if name in REMOVED:
            raise ValueError(removed(name))
        if key not in node:
            raise ValueError(unknown(".".join(path[depth:]), list(node), where, leaves(settings)))
        node = node[key]


def choices_of(group: str, folder: str | None = None) -> list[str]:
    """The files of a group in ``conf/``, and in a user's own folder."""
    roots = [CONF / group, *([Path(folder) / group] if folder else [])]
    found = [path.relative_to(root).with_suffix("") for root in roots for path in root.rglob("*.y*ml")]
    return sorted({str(path) for path in found})
