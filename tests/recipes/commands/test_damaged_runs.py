"""Files of a run that are damaged, moved or in the way: one clear line that names the file, from every command."""

import json
import os
import shutil
import subprocess
import sys

import pytest
import torch

from ls3_recipes.commands import main
from ls3_recipes.configuration import settings_of_run, train_settings
from ls3_recipes.protocol import run_experiment


@pytest.fixture
def run(run_folder, tmp_path, monkeypatch):
    """A copy of the run, to be damaged, and the folder that it lies in as the working directory."""
    left_out = shutil.ignore_patterns("demonstrations", "tensorboard", "*.png", "checkpoints")
    shutil.copytree(run_folder, tmp_path / "run", ignore=left_out)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ls3"])
    return tmp_path / "run"


def refusal(*arguments):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    line = stopped.value.code
    assert isinstance(line, str)
    assert line.startswith(f"ls3 {arguments[0]}: ")
    assert "\n" not in line
    return line


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "must be given"),
        (b"vae: [1,\n", "config.yaml is no YAML"),
        (b"seed: \xff\n", "config.yaml is damaged: it is no text in UTF-8"),
        (b"- 1\n", "config.yaml holds no settings"),
        (b"algorithm: dqn\n", "config.yaml: algorithm must be one of ls3, sacfd, awac, bc; got 'dqn'."),
        (b"algorithm: [ls3]\n", "config.yaml: algorithm must be one of"),
        (b"planner: 3\n", "config.yaml: planner is a section, got 3"),
        (b"planner: {horizon: long}\n", "config.yaml: planner.horizon must be a whole number, got 'long'."),
        (b"planner: {horizn: 3}\n", "config.yaml: planner has no setting horizn"),
    ],
)
def test_evaluate_says_what_is_wrong_with_a_runs_settings(run, content, said):
    (run / "config.yaml").write_bytes(content)
    line = refusal("evaluate", "run=run", "device=cpu")
    assert said in line
    assert "config.yaml" in line
    assert not (run / "evaluation-seed12345").exists()


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_bytes(b""),
        lambda file: file.write_bytes(b"no agent"),
        lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]),
        lambda file: torch.save({"format": "another"}, file),
        lambda file: torch.save([1], file),
        lambda file: file.unlink(),
    ],
    ids=["empty", "text", "half", "other", "list", "gone"],
)
def test_evaluate_says_what_is_wrong_with_an_agent(run, damage):
    damage(run / "agent.pt")
    assert "run/agent.pt" in refusal("evaluate", "run=run", "device=cpu")
    assert not (run / "evaluation-seed12345").exists()


def test_evaluate_needs_a_file_of_the_run_and_a_new_folder(run):
    assert "run/checkpoints/agent_009.pt" in refusal(
        "evaluate", "run=run", "agent=checkpoints/agent_009.pt", "device=cpu"
    )
    assert "exists already" in refusal("evaluate", "run=run", "device=cpu", "output=run")
    line = refusal("evaluate", "run=run", "device=cpu", "planner.horizon=13")
    assert "planner.horizon must not exceed the 12 steps of an episode" in line


def change(path, **values):
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | values), encoding="utf-8")


def cut(path):
    path.write_bytes(path.read_bytes()[:-40])


@pytest.mark.parametrize(
    ("name", "damage", "said"),
    [
        ("summary.json", lambda path: path.unlink(), "None of the 1 runs is finished"),
        ("summary.json", cut, "is damaged: it is no JSON"),
        ("summary.json", lambda path: path.write_bytes(b"\xff\xfe"), "is damaged: it is no text in UTF-8"),
        ("summary.json", lambda path: path.write_text("[1]"), "is damaged: it holds no names with values"),
        ("summary.json", lambda path: path.write_text("{}"), "is damaged: it lacks the name of a task"),
        ("summary.json", lambda path: change(path, seed="0"), "is damaged: it lacks a seed"),
        ("summary.json", lambda path: change(path, online=3), "is damaged: it lacks the number online.success_rate"),
        (
            "summary.json",
            lambda path: change(path, evaluation={"success_rate": "all"}),
            "is damaged: it lacks the number evaluation.success_rate",
        ),
        ("metrics.csv", lambda path: path.unlink(), "metrics.csv is missing"),
        ("metrics.csv", lambda path: path.write_bytes(b"seconds,\xff\n"), "is damaged: it is no text in UTF-8"),
        ("metrics.csv", lambda path: path.write_text("a,b\n1,2\n"), "is damaged: line 2 has no seconds, phase, step"),
        (
            "metrics.csv",
            lambda path: path.write_text("seconds,phase,step,name,value\n1,online,x,mean_return,1\n"),
            "is damaged: line 2 has no",
        ),
        (
            "metrics.csv",
            lambda path: path.write_text("seconds,phase,step,name,value\n1,online,2\n"),
            "is damaged: line 2 has no",
        ),
        (
            "metrics.csv",
            lambda path: path.write_text("seconds,phase,step,name,value\n1,online,2,mean_return,-3\n"),
            "is damaged: its online episodes do not have all of mean_success, mean_violation, mean_return",
        ),
    ],
)
def test_report_says_which_file_is_damaged(run, name, damage, said):
    damage(run / name)
    line = refusal("report", "runs=run", "output=report")
    assert said in line
    assert not (run.parent / "report").exists()


def test_a_report_of_a_run_that_has_lost_its_metrics_invents_no_figures(run):
    (run / "metrics.csv").write_text("seconds,phase,step,name,value\n")
    with pytest.raises(SystemExit, match=r"metrics\.csv is damaged"):
        main(["report", "run", "output=report"])
    assert not (run.parent / "report").exists()


@pytest.mark.slow
def test_a_run_can_be_evaluated_when_the_file_of_its_vae_and_its_data_have_moved(run_folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(run_folder / "agent.pt", "first.pt")
    shutil.copytree(run_folder / "demonstrations", "data")
    tiny = ("preset=smoke", "device=cpu", "pictures=false", "online.updates=0", "task.horizon=4")
    for algorithm in ("ls3", "bc"):
        torch.manual_seed(0)
        run_experiment(
            train_settings(
                f"algorithm={algorithm}", *tiny, "vae.checkpoint=first.pt", "data=data", f"output={algorithm}"
            )
        )
    shutil.move("first.pt", "elsewhere.pt")
    shutil.move("data", "other")
    for algorithm in ("ls3", "bc"):
        assert settings_of_run(algorithm).vae.checkpoint is None
        assert main(["evaluate", f"run={algorithm}", "episodes=1", "device=cpu"]) == 0
        assert (tmp_path / algorithm / "evaluation-seed12345" / "summary.json").is_file()


@pytest.mark.parametrize("what", ["latent_dim", "background"])
def test_a_vae_of_another_shape_is_refused_before_the_folder_is_made(run, what):
    other = {"latent_dim": "agent.latent_dim=5", "background": "agent.background=true"}[what]
    line = refusal("train", "preset=smoke", "device=cpu", "vae.checkpoint=run/agent.pt", other, "output=new")
    assert line.startswith("ls3 train: vae.checkpoint: run/agent.pt holds an agent of another shape: ")
    assert what in line
    assert not (run.parent / "new").exists()


@pytest.mark.slow
def test_reports_are_written_and_printed_where_text_is_ascii(run):
    environment = os.environ | {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C", "COLUMNS": "200"}
    environment.pop("PYTHONIOENCODING", None)
    command = [sys.executable, "-m", "ls3_recipes", "report", "runs=run", "output=report"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "LS?" in done.stdout
    assert "LS³" in (run.parent / "report" / "report.html").read_text(encoding="utf-8")
