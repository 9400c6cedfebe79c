"""From the command line and YAML to settings: Hydra composes, and each command is left what it has."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.arguments import config_dir, name_in, split_arguments
from ls3_recipes.composition import composed, reason
from ls3_recipes.console import command_line
from ls3_recipes.extra import Job
from ls3_recipes.options import build, defaults, require_sections
from ls3_recipes.overrides import CONF, GROUPS, check, choices_of
from ls3_recipes.relevance import prune, refuse_irrelevant, refuse_unread
from ls3_recipes.renamed import RENAMED, on_command_line, rename_overrides, rename_settings
from ls3_recipes.run_files import read_yaml
from ls3_recipes.run_settings import RunSettings
from ls3_recipes.typed import did_you_mean
from ls3_torchrl.exceptions import DivergenceError
from ls3_torchrl.files import is_full

S = TypeVar("S")
_HEADING = "All settings, with the values that these arguments give"


def register(name: str, settings: type) -> None:
    """Make the settings of a command or an algorithm, with their defaults, known to Hydra as ``schema/name``."""
    ConfigStore.instance().store(group="schema", name=name, node=defaults(settings), package="_global_")


for _key, _algorithm in ALGORITHMS.items():
    register(_key, _algorithm.settings_class)


def settings_class_of(overrides: Iterable[str]) -> type[RunSettings]:
    """The settings of the algorithm that arguments of ``ls3 train`` choose.

    Raises:
        ValueError: for an unknown one.
    """
    name = _algorithm_in(overrides)
    if name not in ALGORITHMS:
        raise ValueError(
            f"algorithm must be one of {', '.join(ALGORITHMS)}; got {name!r}{did_you_mean(name, ALGORITHMS) or '.'}"
        )
    return ALGORITHMS[name].settings_class


def _algorithm_in(overrides: Iterable[str]) -> str:
    chosen = [override.partition("=")[2] for override in overrides if override.startswith("algorithm=")]
    return chosen[-1].strip("'\"") if chosen else "ls3"


def _missing(values: Any, where: str = "") -> list[str]:
    """The settings without a value, with their sections."""
    if isinstance(values, Mapping):
        return [
            name for key, value in values.items() for name in _missing(value, f"{where}.{key}" if where else str(key))
        ]
    return [where] if values == MISSING else []


def _named(values: Any) -> dict[str, Any]:
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def settings_from(
    config: DictConfig, settings: type[S], overrides: Sequence[str] = (), renamed: Mapping[str, str] = RENAMED
) -> S:
    """The settings of a composed configuration, former names in users' files included.

    Args:
        config: what Hydra composed.
        settings: their class.
        overrides: the arguments of the command line among them.
        renamed: present names by former ones.

    Raises:
        ValueError: for unknown and bad settings, by their full names, and for arguments that set what nothing reads.
        TypeError: for settings of another type.
    """
    try:
        values = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        values = _named(OmegaConf.to_container(config, resolve=False))
        require_sections(settings, values)
        if missing := _missing(values):
            raise ValueError(f"{missing[0]} must be given: it has no default.") from None
        raise ValueError(f"These settings make no configuration: {reason(error)}") from error
    named = rename_settings(_named(values), renamed, explicit={name_in(override) for override in overrides})
    built = build(settings, prune(named, settings))
    if isinstance(built, RunSettings) and settings_class_of([f"algorithm={built.algorithm}"]) is not settings:
        raise ValueError(
            f"algorithm={built.algorithm} stands in a file, where it chooses nothing. Give it as an argument."
        )
    refuse_unread(overrides, built)
    return built


def settings_of_run(folder: str | Path) -> RunSettings:
    """The settings of a run's folder, former names included.

    The file that the run took its VAE from need not be there any more: its agent has the weights.

    Raises:
        FileNotFoundError: when the folder holds no ``config.yaml``.
        ValueError: for settings that cannot be read.
    """
    path = Path(folder) / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no run: config.yaml is missing. Pass the folder of a run.")
    renamed = rename_settings({"algorithm": "ls3"} | read_yaml(path))
    if renamed["algorithm"] not in [*ALGORITHMS]:  # whatever stands there
        raise ValueError(f"{path}: algorithm must be one of {', '.join(ALGORITHMS)}; got {renamed['algorithm']!r}.")
    vae = renamed.get("vae")
    if isinstance(vae, dict) and isinstance(vae.get("checkpoint"), str) and not Path(vae["checkpoint"]).is_file():
        vae["checkpoint"] = None
    settings = ALGORITHMS[renamed["algorithm"]].settings_class
    try:
        return build(settings, prune(renamed, settings))
    except (ValueError, TypeError) as error:
        raise type(error)(f"{path}: {error} Mend the file, or copy it anew from the run.") from error


def checked_settings(
    command: str,
    settings: type[S],
    overrides: Sequence[str],
    *,
    folder: str | None = None,
    renamed: Mapping[str, str] = RENAMED,
) -> S:
    """What arguments with present names set; everything that they alone can be wrong in is refused.

    Args:
        command: its name, and that of its file in ``conf/``.
        settings: its class of settings.
        overrides: arguments.
        folder: of a user's own files.
        renamed: present names of its settings by former ones.

    Raises:
        ValueError: naming the argument or setting, what is allowed, and what to do.
        TypeError: for settings of another type.
    """
    _check(command, settings, overrides, folder)
    return settings_from(composed(command, overrides, folder), settings, overrides, renamed)


def _check(command: str, settings: type, overrides: Sequence[str], folder: str | None, *, sweeps: bool = False) -> None:
    who = _algorithm_in(overrides) if command == "train" else f"ls3 {command}"
    refuse_irrelevant(overrides, settings, who)
    check(overrides, settings, GROUPS.get(command, ()), folder=folder, sweeps=sweeps)


def compose_settings(command: str, settings: type[S], overrides: Sequence[str] = ()) -> S:
    """What a command's arguments set, without running it.

    Args:
        command: its name, and that of its file in ``conf/``.
        settings: its class of settings.
        overrides: as on the command line.
    """
    return checked_settings(command, settings, rename_overrides(overrides))


def train_settings(*overrides: str) -> RunSettings:
    """What the arguments of ``ls3 train`` set.

    Example:
        >>> train_settings("algorithm=awac", "task=reacher").policy.penalty
        -1.0
    """
    return compose_settings("train", settings_class_of(overrides), overrides)


def run_command(
    command: str,
    settings: type[S],
    job: Job | Callable[[S], object],
    arguments: Sequence[str],
    *,
    help_text: str,
    renamed: Mapping[str, str] = RENAMED,
) -> None:
    """Run a command, or print its help.

    Args:
        command: its name, and that of its file in ``conf/``.
        settings: its class of settings.
        job: what it does with them; a :class:`~ls3_recipes.extra.Job` is imported when they are known to be right.
        arguments: of the command line; Hydra's own options are among them.
        help_text: what stands above the list of settings.
        renamed: present names of its settings by former ones.

    Raises:
        SystemExit: with one line, for settings that cannot be, and for whatever else is refused before the output
            folder is made.
    """
    who = f"ls3 {command}"
    options, overrides = split_arguments(arguments)
    folder = config_dir(options)

    def run(chosen: S) -> None:
        do = job.load() if isinstance(job, Job) else job
        with errors_in_one_line(who, Path(getattr(chosen, "output", None) or "")):
            do(chosen)

    def under_hydra(config: DictConfig) -> None:
        with errors_in_one_line(who):
            chosen = settings_from(config, settings, overrides, renamed)
        run(chosen)

    with command_line(who), on_command_line(who):
        overrides = rename_overrides(overrides, renamed)
        with errors_in_one_line(who):
            if {"-h", "--help"} & set(options):
                _check(command, settings, overrides, folder)
                print(help_of(command, settings, overrides, help_text, folder=folder))
                return
            if not _of_hydra(options):
                chosen = checked_settings(command, settings, overrides, folder=folder, renamed=renamed)
            else:
                _check(command, settings, overrides, folder, sweeps=bool({"-m", "--multirun"} & set(options)))
        if not _of_hydra(options):
            run(chosen)
            return
        sys.argv = [sys.argv[0], *overrides, *options]
        hydra.main(version_base="1.3", config_path=str(CONF), config_name=command)(under_hydra)()


def _of_hydra(options: Sequence[str]) -> bool:
    """Whether there are options that Hydra alone knows, such as ``--cfg`` and ``--multirun``."""
    own = ("--config-dir", "-cd")
    return any(option.startswith("-") and option.partition("=")[0] not in own for option in options)


@contextmanager
def errors_in_one_line(who: str, output: Path | None = None) -> Iterator[None]:
    """End the process with one line for what is wrong with settings, data and files, as long as no output is made.

    After that only for what a user can mend: a full disk, and training that diverges.
    """
    before = output is not None and os.path.lexists(output)
    try:
        yield
    except (ValueError, TypeError, KeyError, OSError, ImportError, DivergenceError) as error:
        notes = getattr(error, "__notes__", [])  # of a run that has begun
        begun = bool(notes) or (output is not None and os.path.lexists(output) and not before)
        full = is_full(error, Path())
        if begun and not full and not isinstance(error, DivergenceError):
            raise
        if os.environ.get("HYDRA_FULL_ERROR") == "1":  # Hydra's own wish for the whole trace
            raise
        said = error.args[0] if isinstance(error, KeyError) and error.args else error
        whole = ". ".join([str(said).rstrip("."), *notes]) if notes else str(said)
        raise SystemExit(f"{who}: {' '.join(whole.split())}") from None


def help_of(
    command: str,
    settings: type,
    overrides: Sequence[str],
    text: str,
    folder: str | None = None,
) -> str:
    """A command's help: what it does, the files that can be chosen, and all its settings as arguments leave them.

    Args:
        command: its name.
        settings: its class of settings.
        overrides: arguments of the command line.
        text: what it does.
        folder: with a user's own files, as ``--config-dir`` gives it.
    """
    values = OmegaConf.to_container(composed(command, overrides, folder), resolve=False)
    shown = prune(rename_settings(_named(values), explicit={name_in(override) for override in overrides}), settings)
    choices = [f"  {group}: {', '.join(choices_of(group, folder))}" for group in GROUPS.get(command, ())]
    parts = [text.strip(), *(["\n".join(["Choices", *choices])] if choices else [])]
    return "\n\n".join([*parts, f"{_HEADING}\n{'-' * len(_HEADING)}\n{OmegaConf.to_yaml(OmegaConf.create(shown))}"])
