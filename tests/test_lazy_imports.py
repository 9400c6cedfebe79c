"""Help, refusals and the packages themselves import nothing heavy; whatever is asked for is there all the same."""

import dataclasses
import importlib
import inspect
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import pytest

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.command_settings import EvaluateSettings
from ls3_recipes.commands import COMMANDS
from ls3_torchrl.data import TaggedReplayBuffer
from ls3_torchrl.options.agent import AgentArchitecture
from ls3_torchrl.options.buffer import BufferOptions
from ls3_torchrl.options.planner import CEMOptions, ControlOptions
from ls3_torchrl.planners import CrossEntropyMethod, LS3Planner

ROOT = Path(__file__).parents[1]
HEAVY = {"torch", "torchrl", "tensordict", "mujoco", "mujoco_warp", "dm_control", "cv2", "matplotlib", "tensorboard"}


def fresh(code, *arguments, cwd):
    """What a new interpreter prints."""
    path = os.pathsep.join(str(ROOT / part) for part in ("", "envs", "recipes"))
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"} | {"PYTHONPATH": path}
    command = [sys.executable, "-c", code, *arguments]
    run = subprocess.run(command, env=environment, cwd=cwd, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return run.stdout


def heavy_after(code, *arguments, cwd):
    """The heavy packages that code has imported, and what it had printed before."""
    out = fresh(f"import sys\n{code}\nprint('\\0', *{HEAVY} & set(sys.modules))", *arguments, cwd=cwd)
    printed, _, imported = out.rpartition("\0")
    return set(imported.split()), printed


COMMAND = """
from ls3_recipes.commands import main
try:
    main(sys.argv[1:])
except SystemExit as stopped:
    print(stopped.code)
"""


@pytest.mark.parametrize("name", COMMANDS)
def test_help_imports_nothing_heavy(name, tmp_path):
    imported, printed = heavy_after(COMMAND, name, "--help", cwd=tmp_path)
    assert f"ls3 {name}" in printed
    # The gallery asks matplotlib which kinds of files it writes.
    assert imported <= ({"matplotlib"} if name == "gallery" else set())


@pytest.mark.parametrize("door", ["ls3", "bc", "sacfd", "awac"])
def test_the_doors_help_imports_nothing_heavy(door, tmp_path):
    file = str(ROOT / "recipes" / f"{door}.py")
    code = f"import runpy\nsys.argv = ['{door}', '--help']\nrunpy.run_path({file!r}, run_name='__main__')"
    imported, printed = heavy_after(code, cwd=tmp_path)
    assert "All settings" in printed
    assert imported == set()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "task=navigaton"], "ls3 train: task must be one of"),
        (["train", "planner.horizn=3"], "ls3 train: planner has no setting horizn"),
        (["train", "seed=abc"], "ls3 train: seed must be a whole number"),
        (["train", "device=tpu"], "ls3 train: device must be auto"),
        (["train", "planner.num_elites=0"], "ls3 train: planner.num_elites must lie"),
        (["train", "algorithm=awac", "policy.temperature=0"], "ls3 train: policy.temperature must be"),
        (["train", "resume=nowhere"], "ls3 train: nowhere holds no run"),
        (["collect", "task=nowhere"], "ls3 collect: task must be one of"),
        (["evaluate", "run=a", "episodes=0"], "ls3 evaluate: episodes must be at least 1"),
        (["evaluate", "run=nowhere"], "ls3 evaluate: nowhere holds no run"),
        (["report"], "ls3 report: No runs"),
        (["report", "run=a"], "ls3 report: The run has no setting run"),
        (["benchmark", "device=tpu"], "ls3 benchmark: device must be auto"),
    ],
)
def test_a_refusal_imports_nothing_heavy(arguments, message, tmp_path):
    imported, printed = heavy_after(COMMAND, *arguments, cwd=tmp_path)
    assert printed.startswith(message)
    assert imported == set()


@pytest.mark.parametrize(
    "module",
    [
        *("ls3_torchrl", "ls3_torchrl.exceptions", "ls3_torchrl.files", "ls3_envs"),
        *(f"ls3_torchrl.options.{part}" for part in ("agent", "buffer", "planner", "training")),
    ],
)
def test_what_says_what_there_is_imports_nothing_heavy(module, tmp_path):
    assert heavy_after(f"import {module}", cwd=tmp_path)[0] == set()


@pytest.mark.parametrize("name", ["ls3_torchrl", "ls3_envs"])
def test_every_name_is_there_and_listed(name, tmp_path):
    package = importlib.import_module(name)
    listed = dir(package)
    assert set(package.__all__) <= set(listed)
    assert all(getattr(package, each) is not None for each in listed if each not in ("__file__", "__cached__"))
    # The first to ask finds them, as a star import does.
    code = f"from {name} import *\nfrom {name} import {', '.join(package.__all__)}\nprint(*sorted(globals()))"
    assert set(package.__all__) <= set(fresh(code, cwd=tmp_path).split())
    with pytest.raises(AttributeError, match=f"module '{name}' has no attribute 'nothing'"):
        _ = package.nothing


def test_parts_are_attributes_of_a_package_that_alone_was_imported(tmp_path):
    code = "import ls3_torchrl, ls3_envs\nprint(ls3_torchrl.data, ls3_torchrl.trainers.LS3Options, ls3_envs.base)"
    assert "LS3Options" in fresh(code, cwd=tmp_path)


def test_what_is_imported_late_is_known_to_type_checkers():
    for name in ("ls3_torchrl", "ls3_envs"):
        package = importlib.import_module(name)
        source = inspect.getsource(package).partition("if TYPE_CHECKING:")[2].partition("\n\n")[0]
        late = {each for each in package.__all__ if each not in vars(package)}
        assert all(each in source for each in late)


def arguments_of(call):
    """What a constructor takes: types and defaults by name."""
    parameters, hints = inspect.signature(call).parameters, get_type_hints(call.__init__)
    return {name: (hints[name], parameter.default) for name, parameter in parameters.items() if name in hints}


@pytest.mark.parametrize(
    ("options", "constructor"),
    [(ControlOptions, LS3Planner), (CEMOptions, CrossEntropyMethod), (BufferOptions, TaggedReplayBuffer)],
)
def test_options_are_the_arguments_of_what_they_are_for(options, constructor):
    known, hints = arguments_of(constructor), get_type_hints(options)
    for field in dataclasses.fields(options):
        default = inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default
        assert (field.name, known[field.name]) == (field.name, (hints[field.name], default))


def test_no_argument_of_planner_and_optimiser_is_left_out():
    for options, constructor in ((ControlOptions, LS3Planner), (CEMOptions, CrossEntropyMethod)):
        parameters = inspect.signature(constructor).parameters.values()
        own = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and not p.name.endswith("_key")]
        assert own == [field.name for field in dataclasses.fields(options)]


def test_options_and_settings_can_be_pickled():
    for made in (ControlOptions(horizon=3), AgentArchitecture(2), EvaluateSettings(run="a", output="b").device):
        assert pickle.loads(pickle.dumps(made)) == made


def test_rows_of_algorithms_name_classes_of_that_key():
    assert {key: row.load().key for key, row in ALGORITHMS.items()} == {key: key for key in ALGORITHMS}
