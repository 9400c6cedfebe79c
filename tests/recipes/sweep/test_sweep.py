"""Whole sweeps of tiny runs: shared VAEs, stopping, going on, and the same figures wherever they are carried out."""

import csv
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import pytest
import torch

from ls3_recipes.commands.sweep import main
from ls3_recipes.configuration import train_settings
from ls3_recipes.protocol import run_experiment, train_vae
from ls3_recipes.run_files import read_json
from ls3_recipes.run_folder import Lock
from ls3_recipes.sweep import worker
from ls3_recipes.sweep.launchers import Launcher
from ls3_torchrl import LS3Agent

TINY = ["preset=smoke", "device=cpu", "threads=1", "pictures=false"]


def ls3(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-m", "ls3_recipes", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **options,
    )


def finished(process, status=0):
    out, _ = process.communicate(timeout=600)
    assert process.returncode == status, out
    return out


class Here(Launcher):
    """Carries out tasks one after another in this process, which spares each the imports."""

    slots = 1

    def submit(self, task):
        future = Future()
        try:
            worker.main([str(os.getppid()), *task.arguments])
        except SystemExit as error:
            Path(task.log).parent.mkdir(exist_ok=True)
            Path(task.log).write_text(str(error))
            future.set_result(1)
        else:
            future.set_result(0)
        return future

    def stop(self):
        raise AssertionError("Nothing is under way between two tasks.")


@pytest.fixture
def sweep_here(monkeypatch, tmp_path):
    """``ls3 sweep`` in this process."""
    monkeypatch.setattr("ls3_recipes.sweep.sweep.make_launcher", lambda *_: Here())
    monkeypatch.setattr(worker, "_end_with", lambda _: None)
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: main([*map(str, arguments)])


def table(folder):
    """Every figure of every run and update, without what a clock or a place is in."""
    rows = []
    for name in ("runs.csv", "curves.csv"):
        with (folder / "report" / name).open() as file:
            rows += [{key: row[key] for key in row if key not in ("minutes", "folder")} for row in csv.DictReader(file)]
    return rows


def jobs(folder):
    with (folder / "jobs.csv").open() as file:
        return {row["name"]: row for row in csv.DictReader(file)}


@pytest.mark.parametrize("algorithm", ["ls3", "sacfd", "awac"])
def test_a_run_with_a_shared_vae_ends_in_the_bits_of_one_that_makes_its_own(tmp_path, algorithm):
    how = [*TINY, f"algorithm={algorithm}", "vae.prediction_weight=1.0"]
    run_experiment(train_settings(*how, f"output={tmp_path / 'alone'}"))
    shared = train_vae(train_settings(*how, f"output={tmp_path / 'vae'}"))
    given = f"data={tmp_path / 'vae' / 'demonstrations'}", f"vae.checkpoint={shared}"
    run_experiment(train_settings(*how, *given, f"output={tmp_path / 'with'}"))
    one, other = (
        torch.load(tmp_path / name / "agent.pt", weights_only=True)["state_dict"] for name in ("alone", "with")
    )
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)
    first, second = (read_json(tmp_path / name / "summary.json") for name in ("alone", "with"))
    assert first["evaluation"] == second["evaluation"]


def test_every_algorithm_trains_the_same_vae(tmp_path):
    weights = []
    for name in ("ls3", "sacfd", "awac", "bc"):
        path = train_vae(train_settings(*TINY, f"algorithm={name}", f"output={tmp_path / name}"))
        weights.append(LS3Agent.load(path).encoder.state_dict())
    assert all(torch.equal(weights[0][key], other[key]) for other in weights[1:] for key in other)


def test_a_shared_vae_says_what_it_is(tmp_path):
    path = train_vae(train_settings(*TINY, f"output={tmp_path / 'vae'}"))
    assert LS3Agent.load(path).stage == "vae"
    agent = LS3Agent.load(path)
    assert LS3Agent.load(agent.save(tmp_path / "agent.pt")).stage is None
    with pytest.raises(ValueError, match="has no VAE"):
        train_vae(train_settings(*TINY, "algorithm=bc", "encoder=conv", f"output={tmp_path / 'none'}"))


def test_a_sweep_goes_on_where_it_was_killed_and_ends_with_the_same_figures(tmp_path, sweep_here):
    arms = ["planner.constraint_threshold=0.3,null", "rollouts=2", *TINY]
    sweep_here(*arms, f"output={tmp_path / 'whole'}")
    killed = ls3("sweep", *arms, f"output={tmp_path / 'killed'}", "hydra.launcher.workers=2", cwd=tmp_path)
    while not any((tmp_path / "killed").glob("runs/*/metrics.csv")):
        assert killed.poll() is None
        time.sleep(0.05)
    os.kill(killed.pid, signal.SIGKILL)
    killed.communicate()
    unfinished = [row for row in jobs(tmp_path / "killed").values() if row["state"] != "finished"]
    assert unfinished
    out = finished(ls3("sweep", *arms, f"output={tmp_path / 'killed'}", "hydra.launcher.workers=2", cwd=tmp_path))
    assert "finished" in out
    assert table(tmp_path / "killed") == table(tmp_path / "whole")
    rows = jobs(tmp_path / "killed")
    assert {row["state"] for row in rows.values()} == {"finished"}
    assert sorted(row["kind"] for row in rows.values()) == ["data", "rollouts", "rollouts", "train", "train", "vae"]
    text = (tmp_path / "killed" / "report" / "report.html").read_text()
    assert "no constraints" in text
    assert not [path for path in (tmp_path / "killed").rglob("*") if path.is_dir() and not any(path.iterdir())]
    before = (tmp_path / "killed" / "runs").stat().st_mtime_ns
    sweep_here(*arms, f"output={tmp_path / 'killed'}")  # nothing is left
    assert (tmp_path / "killed" / "runs").stat().st_mtime_ns == before
    with pytest.raises(SystemExit, match=r"other settings: planner\.num_candidates=20 there, 30 here"):
        sweep_here(*arms, "planner.num_candidates=30", f"output={tmp_path / 'killed'}")
    assert not (tmp_path / "runs").exists()
    assert not (tmp_path / "multirun").exists()


def test_slurm_from_the_command_line(tmp_path):
    slurm = "hydra/launcher=slurm", "hydra.launcher.cluster=local", "hydra.launcher.threads=1"
    run = *TINY, "algorithm=bc", "encoder=conv", f"output={tmp_path / 'out'}"
    finished(ls3("sweep", *run, *slurm, cwd=tmp_path))
    assert sorted(row["kind"] for row in jobs(tmp_path / "out").values()) == ["data", "train"]


def test_a_run_that_fails_is_listed_and_the_others_are_finished(tmp_path, sweep_here, capsys):
    (tmp_path / "out" / "runs" / "bc-navigation-seed0").mkdir(parents=True)
    (tmp_path / "out" / "runs" / "bc-navigation-seed0" / "note.txt").write_text("a folder of someone else's")
    with pytest.raises(SystemExit, match="ls3 sweep: 1 of 4 jobs failed"):
        sweep_here(*TINY, "algorithm=bc", "encoder=conv", "seed=0,1", f"output={tmp_path / 'out'}")
    rows = jobs(tmp_path / "out")
    assert rows["bc-navigation-seed0"]["state"] == "failed"
    assert "exists already" in rows["bc-navigation-seed0"]["error"]
    assert rows["bc-navigation-seed1"]["state"] == "finished"
    assert "Traceback" not in capsys.readouterr().out
    assert "Failed or not finished" in (tmp_path / "out" / "report" / "report.html").read_text()
    (tmp_path / "out" / "runs" / "bc-navigation-seed1" / "summary.json").write_text("{")
    with pytest.raises(SystemExit, match="not all of their runs could be reported"):
        sweep_here(*TINY, "algorithm=bc", "encoder=conv", "seed=1", f"output={tmp_path / 'out'}")


def test_ctrl_c_saves_every_run(tmp_path):
    process = ls3("sweep", *TINY, "vae.steps=100000", f"output={tmp_path / 'out'}", cwd=tmp_path)
    while not any((tmp_path / "out").glob("shared/vae-*/metrics.csv")):
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    out = finished(process, status=130)
    assert "To go on: the same command" in out
    assert any((tmp_path / "out").glob("shared/vae-*/checkpoints/run-*"))
    assert "cut off" in {row["state"] for row in jobs(tmp_path / "out").values()}


def test_refusals_come_before_the_folder(tmp_path):
    out = finished(ls3("sweep", *TINY, "planner.horizon=3,99", f"output={tmp_path / 'out'}", cwd=tmp_path), status=1)
    assert "planner.horizon must not exceed" in out
    assert len(out.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_folder_of_something_else_or_in_use_is_refused_as_it_is(tmp_path, sweep_here):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "sweep.yaml").write_text("servers: [a, b]\n")
    with pytest.raises(SystemExit, match=r"mine holds sweep\.yaml, and no sweep that could go on"):
        sweep_here(*TINY, f"output={tmp_path / 'mine'}")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["sweep.yaml"]
    (tmp_path / "busy").mkdir()
    lock = Lock(tmp_path / "busy" / "lock")
    with pytest.raises(SystemExit, match=r"^ls3 sweep: .*busy"):
        sweep_here(*TINY, f"output={tmp_path / 'busy'}")
    lock.release()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["hydra/launcher=cloud"], r"hydra/launcher must be one of local, ray, slurm; got 'cloud'"),
        (["hydra.launcher.worker=2"], r"no setting worker: did you mean hydra\.launcher\.workers\?"),
        (["hydra/launcher=ray", "hydra.launcher.workers=2"], r"no setting workers.*It has: name, address"),
        (["title=a,b"], r"one run has one value of title"),
        (["own", "--config-dir"], r"--config-dir must name a folder"),
        (["headless", "--config-dir", "mine"], r"headless\.yaml must begin with the line '# @package _global_'"),
        (["broken", "--config-dir", "mine"], r"broken\.yaml is no YAML"),
        (["settings={a: 1}", "--config-dir", "mine"], r"settings"),
        (["settings=['hydra.launcher.workers=1']"], r"an argument of ls3 sweep itself"),
    ],
)
def test_what_no_sweep_can_have_is_refused_in_one_line(tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine" / "sweep").mkdir(parents=True)
    (tmp_path / "mine" / "sweep" / "headless.yaml").write_text("title: mine\n")
    (tmp_path / "mine" / "sweep" / "broken.yaml").write_text(": : [\n")
    with pytest.raises(SystemExit, match=rf"^ls3 sweep: .*{said}") as error:
        main(arguments)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "runs").exists()
