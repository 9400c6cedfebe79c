"""From the command line and YAML to settings: Hydra composes, and each command is left what it has."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.arguments import config_dir, name_in, split_arguments
from ls3_recipes.options import build, defaults
from ls3_recipes.renamed import RENAMED, on_command_line, rename_overrides, rename_settings
from ls3_recipes.run_settings import RunSettings

CONF = Path(__file__).parent / "conf"
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
    chosen = [override.partition("=")[2] for override in overrides if override.startswith("algorithm=")]
    name = chosen[-1] if chosen else "ls3"
    if name not in ALGORITHMS:
        raise ValueError(f"algorithm must be one of {', '.join(ALGORITHMS)}; got {name!r}.")
    return ALGORITHMS[name].settings_class


def _known_anywhere() -> dict[str, Any]:
    """The settings of all algorithms together: what a preset or a task may hold."""
    known: dict[str, Any] = {}
    for algorithm in ALGORITHMS.values():
        known = _union(known, defaults(algorithm.settings_class))
    return known


def _union(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(one)
    for key, value in other.items():
        both = isinstance(value, Mapping) and isinstance(out.get(key), Mapping)
        out[key] = _union(out[key], value) if both else value
    return out


def prune(values: Mapping[str, Any], settings: type) -> dict[str, Any]:
    """Leave out what only other algorithms have: a preset and a task bring the settings of all of them.

    What nobody has is refused: here, or when the settings are built.

    Raises:
        ValueError: for a setting that nobody has, in a section that only others have.
    """
    return _prune(values, defaults(settings), _known_anywhere())


def _prune(
    values: Mapping[str, Any], own: Mapping[str, Any], known: Mapping[str, Any], where: str = ""
) -> dict[str, Any]:
    out = {}
    for key, value in values.items():
        if key not in own and key in known:
            _refuse_unknown(value, known[key], where + key)
            continue
        nested = isinstance(value, Mapping) and isinstance(own.get(key), Mapping)
        out[key] = _prune(value, own[key], known.get(key, {}), f"{where}{key}.") if nested else value
    return out


def _refuse_unknown(value: Any, known: Any, where: str) -> None:
    """Refuse what nobody has, in a section that is left out."""
    if isinstance(value, Mapping) and isinstance(known, Mapping):
        for key, inner in value.items():
            if key not in known:
                raise ValueError(f"{where} has no setting {key}. It has: {', '.join(known)}.")
            _refuse_unknown(inner, known[key], f"{where}.{key}")


def refuse_irrelevant(overrides: Iterable[str], settings: type, who: str) -> None:
    """Refuse arguments of the command line that set what only other algorithms have.

    Raises:
        ValueError: naming the setting, and what there is instead.
    """
    known = _known_anywhere()
    for override in overrides:
        own: Any = defaults(settings)
        elsewhere: Any = known
        path = name_in(override).split(".")
        for depth, key in enumerate(path):
            if not isinstance(own, Mapping) or "@" in key:
                break
            if key not in own and isinstance(elsewhere, Mapping) and key in elsewhere:
                missing, section = ".".join(path[: depth + 1]), ".".join(path[:depth])
                its = f"Its {section} has" if section else "It has"
                raise ValueError(f"{override}: {who} has no {missing}. {its}: {', '.join(own)}.")
            own = own.get(key)
            elsewhere = elsewhere.get(key) if isinstance(elsewhere, Mapping) else None


def _named(values: Any) -> dict[str, Any]:
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def refuse_unread(overrides: Iterable[str], settings: Any) -> None:
    """Refuse arguments of the command line that set what nothing reads, with the other settings as they are.

    Raises:
        ValueError: naming the setting that would make them matter.
    """
    unread = settings.unread if isinstance(settings, RunSettings) else {}
    for override in overrides:
        name = name_in(override)
        for section, remedy in unread.items():
            if f"{name}.".startswith(f"{section}."):
                raise ValueError(f"{override}: {section} only matters with {remedy}. Add that, or leave {name} out.")


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
    """
    values = OmegaConf.to_container(config, resolve=True)
    named = rename_settings(_named(values), renamed, explicit={name_in(override) for override in overrides})
    built = build(settings, prune(named, settings))
    refuse_unread(overrides, built)
    return built


def settings_of_run(folder: str | Path) -> RunSettings:
    """The settings of a run's folder, former names included.

    Raises:
        FileNotFoundError: when the folder holds no ``config.yaml``.
        ValueError: for settings that cannot be read.
    """
    path = Path(folder) / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"{folder} is no run folder: config.yaml is missing. Pass run=DIR of a finished run.")
    values = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    renamed = rename_settings({"algorithm": "ls3"} | _named(values))
    if renamed["algorithm"] not in ALGORITHMS:
        raise ValueError(f"{path}: algorithm must be one of {', '.join(ALGORITHMS)}; got {renamed['algorithm']!r}.")
    settings = ALGORITHMS[renamed["algorithm"]].settings_class
    return build(settings, prune(renamed, settings))


def compose_settings(command: str, settings: type[S], overrides: Sequence[str] = ()) -> S:
    """What a command's arguments set, without running it.

    Args:
        command: its name, and that of its file in ``conf/``.
        settings: its class of settings.
        overrides: as on the command line.
    """
    overrides = rename_overrides(overrides)
    refuse_irrelevant(overrides, settings, _who(command, overrides))
    # A command that asks for another one's settings has Hydra already.
    with nullcontext() if GlobalHydra().is_initialized() else initialize_config_dir(str(CONF), version_base="1.3"):
        return settings_from(compose(command, overrides), settings, overrides)


def train_settings(*overrides: str) -> RunSettings:
    """What the arguments of ``ls3 train`` set.

    Example:
        >>> train_settings("algorithm=awac", "task=reacher").policy.penalty
        -1.0
    """
    return compose_settings("train", settings_class_of(overrides), overrides)


def _who(command: str, overrides: Iterable[str]) -> str:
    """What a command's settings are settings of, in the words of an error."""
    if command != "train":
        return f"ls3 {command}"
    return next((o.partition("=")[2] for o in overrides if o.startswith("algorithm=")), "ls3")


def run_command(
    command: str,
    settings: type[S],
    job: Callable[[S], object],
    arguments: Sequence[str],
    *,
    help_text: str,
    groups: Sequence[str] = (),
    renamed: Mapping[str, str] = RENAMED,
) -> None:
    """Run a command under Hydra, or print its help.

    Args:
        command: its name, and that of its file in ``conf/``.
        settings: its class of settings.
        job: what it does with them.
        arguments: of the command line; Hydra's own options are among them.
        help_text: what stands above the list of settings.
        groups: folders of ``conf/`` whose files can be chosen.
        renamed: present names of its settings by former ones.

    Raises:
        SystemExit: with one line, for settings that cannot be, and for whatever else is refused before the output
            folder is made.
    """
    who = f"ls3 {command}"
    options, overrides = split_arguments(arguments)

    def under_hydra(config: DictConfig) -> None:
        with _errors_in_one_line(who):
            chosen = settings_from(config, settings, overrides, renamed)
        with _errors_in_one_line(who, Path(getattr(chosen, "output", ""))):
            job(chosen)

    with on_command_line(who):
        overrides = rename_overrides(overrides, renamed)
        with _errors_in_one_line(who):
            refuse_irrelevant(overrides, settings, _who(command, overrides))
            if {"-h", "--help"} & set(options):
                print(help_of(command, settings, overrides, help_text, groups, folder=config_dir(options)))
                return
        sys.argv = [sys.argv[0], *overrides, *options]
        hydra.main(version_base="1.3", config_path=str(CONF), config_name=command)(under_hydra)()


@contextmanager
def _errors_in_one_line(who: str, output: Path | None = None) -> Iterator[None]:
    """End the process with one line for what is wrong with settings, data and files, as long as no output is made."""
    before = output is not None and output.exists()
    try:
        yield
    except (ValueError, TypeError, FileNotFoundError, FileExistsError, HydraException) as error:
        begun = output is not None and output.exists() and not before
        if begun or os.environ.get("HYDRA_FULL_ERROR") == "1":  # Hydra's own wish for the whole trace
            raise
        raise SystemExit(f"{who}: {' '.join(str(error).split())}") from None


def help_of(
    command: str,
    settings: type,
    overrides: Sequence[str],
    text: str,
    groups: Sequence[str] = (),
    folder: str | None = None,
) -> str:
    """A command's help: what it does, the files that can be chosen, and all its settings as arguments leave them.

    Args:
        command: its name.
        settings: its class of settings.
        overrides: arguments of the command line.
        text: what it does.
        groups: folders of ``conf/`` whose files can be chosen.
        folder: with a user's own files, as ``--config-dir`` gives it.
    """
    searched = [f"hydra.searchpath=[file://{Path(folder).absolute()}]"] if folder else []
    with initialize_config_dir(str(CONF), version_base="1.3"):
        values = OmegaConf.to_container(compose(command, [*overrides, *searched]), resolve=False)
    shown = prune(rename_settings(_named(values), explicit={name_in(override) for override in overrides}), settings)
    choices = [f"  {group}: {', '.join(choices_of(group))}" for group in groups]
    parts = [text.strip(), *(["\n".join(["Choices", *choices])] if choices else [])]
    return "\n\n".join([*parts, f"{_HEADING}\n{'-' * len(_HEADING)}\n{OmegaConf.to_yaml(OmegaConf.create(shown))}"])


def choices_of(group: str) -> list[str]:
    """The files of a group in ``conf/``."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))
