"""The command ``ls3``: its commands, its help, and what it says when it cannot go on."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import ls3_envs
from ls3_recipes import commands
from ls3_recipes.commands import COMMANDS, main

RECIPES = Path(__file__).parents[3] / "recipes"


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_the_commands_are_listed(capsys, arguments):
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert all(f"  {name} " in printed for name in COMMANDS)


def test_an_unknown_command_is_refused_with_those_that_exist(capsys):
    assert main(["trian"]) == 2
    assert f"no command 'trian'. It has: {', '.join(COMMANDS)}." in capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_a_file_with_an_entry_point_and_a_door(name):
    assert callable(importlib.import_module(f"ls3_recipes.commands.{name}").main)
    doors = ["ls3", "bc", "sacfd", "awac"] if name == "train" else [name]
    for door in doors:
        source = (RECIPES / f"{door}.py").read_text()
        assert f"from ls3_recipes.commands.{name} import main" in source
        assert len(source.splitlines()) < 10
    assert {path.stem for path in Path(commands.__file__).parent.glob("[a-z]*.py")} == set(COMMANDS)


@pytest.mark.parametrize("backend", ["osmesa", "nonsense"])
def test_a_backend_of_opengl_that_does_not_work_keeps_no_command_from_starting(backend):
    command = [sys.executable, "-m", "ls3_recipes", "train", "seed=abc"]
    where = os.pathsep.join(str(RECIPES.parent / part) for part in ("", "envs", "recipes"))
    environment = os.environ | {"MUJOCO_GL": backend, "PYTHONPATH": where}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert run.stderr.strip().splitlines()[-1] == "ls3 train: seed must be a whole number, got 'abc'."
    assert run.returncode == 1


@pytest.mark.parametrize("missing", ["hydra", "mujoco", "matplotlib.pyplot"])
def test_without_the_extra_the_remedy_is_named(monkeypatch, missing):
    def fail(name):
        raise ModuleNotFoundError(f"No module named {missing!r}", name=missing)

    monkeypatch.setattr(commands, "import_module", fail)
    with pytest.raises(SystemExit, match=rf"^ls3 train needs {missing}: pip install 'ls3-torchrl\[recipes\]'\.$"):
        main(["train"])


def test_a_module_that_is_missing_for_another_reason_is_no_matter_of_extras(monkeypatch):
    def fail(name):
        raise ModuleNotFoundError("No module named 'ls3_recipes.gone'", name="ls3_recipes.gone")

    monkeypatch.setattr(commands, "import_module", fail)
    with pytest.raises(ModuleNotFoundError, match="gone"):
        main(["train"])


def test_choosing_a_command_imports_only_what_it_needs():
    code = (
        "import sys; from ls3_recipes.commands import main; main(['--help']); "
        "heavy = {'torch', 'torchrl', 'hydra', 'matplotlib', 'mujoco'} & set(sys.modules); "
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "gallery"])
def test_help_says_what_can_be_set_and_runs_nothing(name, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert main([name, "--help"]) == 0
    printed = capsys.readouterr().out
    assert f"ls3 {name} " in printed
    assert "All settings, with the values that these arguments give" in printed
    assert "output:" in printed
    assert list(tmp_path.iterdir()) == []


def test_help_for_an_algorithm_shows_choices_and_its_own_settings_with_the_arguments_values(capsys):
    main(["train", "algorithm=sacfd", "preset=paper", "policy.alpha=0.5", "--help"])
    printed = capsys.readouterr().out
    for word in (*ls3_envs.DOMAINS, "cpu", "paper", "smoke", "alpha: 0.5", "ls3 train", "output="):
        assert word in printed
    assert "planner:" not in printed
    main(["train", "preset=paper", "--help"])
    assert "num_candidates: 1000" in capsys.readouterr().out


def test_the_gallerys_help(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["gallery", "--help"])
    assert stopped.value.code == 0
    assert all(domain in capsys.readouterr().out for domain in ["FILE.png"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "algorithm=sacfd", "planner.horizon=9"], "ls3 train: planner.horizon=9: sacfd has no planner."),
        (["train", "algorithm=dqn"], "ls3 train: algorithm must be one of"),
        (["train", "preset=smoke", "vae.steps=0"], "ls3 train: vae.steps must be at least 1, got 0."),
        (["train", "planner=foo"], "ls3 train: planner is a section, got 'foo': set planner.KEY=VALUE."),
        (["train", "preset=smoke", "planner.num_elites=99"], "ls3 train: planner.num_elites must lie"),
        (["train", "preset=smoke", "agent.latent_dim=0"], "ls3 train: agent.latent_dim must be at least 1"),
        (["train", "preset=smoke", "buffer.success_tail=0"], "ls3 train: buffer.success_tail must be at least 1"),
        (["train", "preset=smoke", "data=nowhere"], "ls3 train: "),
        (["evaluate", "run=nowhere"], "ls3 evaluate: nowhere holds no run"),
        (["report", "runs=nowhere"], "ls3 report: nowhere "),
        (["train", "preset=fast", "--help"], "ls3 train: preset must be one of cpu, paper, smoke; got 'fast'."),
        (["collect", "planner.horizon=9"], "ls3 collect: planner.horizon=9: ls3 collect has no planner."),
    ],
)
def test_settings_that_cannot_be_end_the_command_with_one_line(monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ls3"])
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert str(stopped.value).startswith(message)
    assert "\n" not in str(stopped.value)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def own_preset(tmp_path, monkeypatch):
    """A user's preset with a former name, and no work done."""
    (tmp_path / "cd" / "preset").mkdir(parents=True)
    preset = "# @package _global_\npreset: mine\nonline: {share: 0.2, updates: 7}\n"
    (tmp_path / "cd" / "preset" / "mine.yaml").write_text(preset)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ls3"])
    chosen = []
    monkeypatch.setattr(importlib.import_module("ls3_recipes.commands.train"), "run_experiment", chosen.append)
    return chosen


@pytest.mark.parametrize(
    ("arguments", "fraction"), [([], 0.2), (["online.fraction=0.3"], 0.3), (["online.share=0.4"], 0.4)]
)
def test_former_names_in_a_users_files_are_read_and_told_in_one_line(own_preset, capfd, arguments, fraction):
    main(["train", "task=reacher", "--config-dir", "cd", "preset=mine", *arguments])
    assert [(settings.online.fraction, settings.online.updates) for settings in own_preset] == [(fraction, 7)]
    assert set(capfd.readouterr().err.splitlines()) == {"ls3 train: online.share is now online.fraction"}


@pytest.mark.parametrize("option", [["--config-dir", "cd"], ["--config-dir=cd"], ["-cd", "cd"]])
def test_help_shows_a_users_files(own_preset, capsys, option):
    main(["train", *option, "preset=mine", "--help"])
    printed = capsys.readouterr().out
    assert "updates: 7" in printed
    assert "fraction: 0.2" in printed
    assert own_preset == []


def test_errors_after_the_folder_was_made_keep_their_trace(own_preset, monkeypatch, tmp_path):
    def fail(settings):
        Path(settings.output).mkdir()
        raise ValueError("late")

    train = importlib.import_module("ls3_recipes.commands.train")
    monkeypatch.setattr(train, "run_experiment", fail)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    with pytest.raises(ValueError, match="late"):
        main(["train", "output=made"])


@pytest.mark.slow
@pytest.mark.parametrize("door", [["-m", "ls3_recipes", "train", "algorithm=bc"], [str(RECIPES / "bc.py")]])
def test_a_run_from_another_folder_leaves_its_folder_there_and_nothing_else(tmp_path, door):
    arguments = ["preset=smoke", "online.updates=0", "vae.steps=1", "task.horizon=4", "pictures=false", "output=mine"]
    subprocess.run([sys.executable, *door, *arguments], cwd=tmp_path, check=True, capture_output=True)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    assert (tmp_path / "mine" / "summary.json").is_file()
