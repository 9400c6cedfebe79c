"""What Hydra makes of YAML files and arguments, and what it says when it cannot."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException

from ls3_recipes.arguments import name_in
from ls3_recipes.overrides import CONF, GROUPS, parse
from ls3_recipes.run_files import read_yaml

#: How lines begin that say something to developers of Hydra and OmegaConf alone.
_NOISE = ("Config search path", "provider=", "full_key:", "object_type=")
#: What tells Hydra that a file's settings have their full names.
_GLOBAL = re.compile(r"\A(\s*#.*\n)*\s*#\s*@package\s+_global_\s*$", re.MULTILINE)


def composed(command: str, overrides: Sequence[str], folder: str | None = None) -> DictConfig:
    """What Hydra makes of a command's file and arguments.

    Args:
        command: its name, and that of its file in ``conf/``.
        overrides: arguments, with present names.
        folder: of a user's own files.

    Raises:
        ValueError: for files and arguments that it cannot make anything of.
    """
    # Hydra takes what is called like a folder of files for a choice of one, though the command has none.
    folders = {path.name for path in CONF.iterdir() if path.is_dir()} - {*GROUPS.get(command, ())}
    own = [override for override in overrides if name_in(override) in folders]
    known, searched = [override for override in overrides if override not in own], []
    if folder is not None:
        if not folder or not Path(folder).is_dir():
            raise ValueError(f"--config-dir must name a folder with YAML files; there is none at {folder!r}.")
        searched = [f"hydra.searchpath=['file://{Path(folder).absolute()}']"]
    try:
        # A command that asks for another one's settings may have Hydra already.
        with nullcontext() if GlobalHydra().is_initialized() else initialize_config_dir(str(CONF), version_base="1.3"):
            config = compose(command, [*known, *searched], return_hydra_config=True)
        if folder is not None:
            _require_global(Path(folder), config["hydra"]["runtime"]["choices"])
        HydraConfig.instance().set_config(config)  # for those that a user's file refers to
        with open_dict(config):
            if "hydra/launcher" in GROUPS.get(command, ()):
                config["launcher"] = config["hydra"]["launcher"]
            del config["hydra"]
            for override in parse(own):
                config[override.key_or_group] = override.value()
    except (HydraException, OmegaConfBaseException, yaml.YAMLError, UnicodeDecodeError) as error:
        unread = yaml.YAMLError, UnicodeDecodeError
        if isinstance(error, unread) or isinstance(error.__cause__, unread):
            for path in sorted(Path(folder).rglob("*.y*ml")) if folder else ():
                read_yaml(path)  # names the file, where it is one of these
        raise ValueError(f"These settings make no configuration: {reason(error)}") from error
    return config


def _require_global(folder: Path, choices: Mapping[str, Any]) -> None:
    """Refuse a user's file whose settings Hydra would put below its group's name."""
    for group, choice in choices.items():
        path = folder / group / f"{choice}.yaml"
        if path.is_file() and not _GLOBAL.search(path.read_text(encoding="utf-8-sig")):
            raise ValueError(f"{path} must begin with the line '# @package _global_'. Add it, at the very top.")


def reason(error: Exception) -> str:
    """What Hydra or OmegaConf say, on one line and without what only its own users know."""
    lines = [line.strip() for line in str(error.__cause__ or error).splitlines()]
    return " ".join(line for line in lines if line and not line.startswith(_NOISE))
