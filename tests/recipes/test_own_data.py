"""Runs on data of one's own: without states, of another robot, without a success, where text is not UTF-8."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import ls3_envs
from ls3_recipes.algorithms import ls3
from ls3_recipes.commands.train import main
from ls3_recipes.configuration import train_settings
from ls3_recipes.protocol import run_experiment
from ls3_torchrl.data import DataWarning, Tag, save_episodes, split_episodes

# TorchRL warns about classes of its own while its collectors are imported.
pytestmark = pytest.mark.filterwarnings("ignore:Creating .* which inherits from WeightUpdaterBase:DeprecationWarning")

KEYS = ("pixels", "action", *(("next", key) for key in ("pixels", "reward", "constraint", "success")))


@pytest.fixture(scope="module")
def demonstrations():
    return {
        tag: ls3_envs.collect_offline("navigation", tag.name.lower(), episodes=2)
        for tag in (Tag.SUCCESS, Tag.CONSTRAINT)
    }


@pytest.fixture
def own_data(demonstrations, tmp_path):
    """Writes the demonstrations, with the standard keys alone, changed in some way; returns the folder."""

    def write(change=lambda episodes: None, folder="data"):
        sets = {}
        for tag, episodes in demonstrations.items():
            own = episodes.select(*KEYS).clone()
            change(own)
            sets[tag] = own
        return save_episodes(sets, tmp_path / folder, task="navigation", seed=0)

    return write


def settings(data, output, *more, updates=1):
    return train_settings(
        "preset=smoke", "device=cpu", f"online.updates={updates}", f"data={data}", f"output={output}", *more
    )


def test_a_run_on_images_and_actions_alone_leaves_its_results_and_the_pictures_that_need_no_states(own_data, tmp_path):
    run_experiment(settings(own_data(), tmp_path / "run"))
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"summary.json", "agent.pt", "learning_curves.png", "losses.png", "reconstructions.png"} <= left
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert "failed_pictures" not in summary
    assert "probe" not in summary or not summary["probe"]


def test_a_picture_that_fails_costs_nothing_but_itself(own_data, tmp_path, monkeypatch):
    from ls3_recipes.plots import run as plots

    def fail(*args, **kwargs):
        raise RuntimeError("no ink left")

    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    monkeypatch.setattr(plots, "plot_losses", fail)
    summary = run_experiment(settings(own_data(), tmp_path / "run"))
    assert summary["failed_pictures"] == {"losses.png": "no ink left"} or "no ink left" in str(
        summary["failed_pictures"]
    )
    assert (tmp_path / "run" / "learning_curves.png").is_file()
    assert not (tmp_path / "run" / "losses.png").exists()


def widen(episodes):
    episodes["action"] = torch.cat([episodes["action"], episodes["action"][..., :1]], -1)


def scale(episodes):
    episodes["action"] = 10.0 * episodes["action"]


def score(episodes):
    episodes["next", "reward"] = episodes["next", "reward"] * 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (widen, "has 3 actions, where the action spec has 2"),
        (scale, "lies outside of what can be carried out"),
        (score, "is 0 in all"),
    ],
)
def test_data_of_another_robot_are_refused_in_one_line_before_any_folder(own_data, tmp_path, change, message):
    folder = own_data(change)
    with pytest.raises(SystemExit) as ended:
        main(["preset=smoke", f"data={folder}", f"output={tmp_path / 'run'}"])
    assert message in str(ended.value)
    assert str(folder) in str(ended.value)
    assert "\n" not in str(ended.value)
    assert not (tmp_path / "run").exists()


def fail(episodes):
    episodes["next", "success"].zero_()
    episodes["next", "reward"].fill_(-1.0)


def test_demonstrations_that_never_succeed_are_warned_of(own_data, tmp_path, monkeypatch):
    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    config = settings(own_data(fail), tmp_path / "run", "pictures=false", updates=0)
    with pytest.warns(DataWarning) as told:
        run_experiment(config)
    said = " ".join(str(warning.message) for warning in told)
    assert "No episode of 2 that are tagged success ever succeeds" in said


def test_episodes_of_different_lengths_train_from_file_to_agent(demonstrations, tmp_path, monkeypatch):
    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    sets = {}
    for tag, episodes in demonstrations.items():
        rows = split_episodes(episodes.select(*KEYS))
        label = ("next", "success" if tag == Tag.SUCCESS else "constraint")
        ends = [int(row[label].flatten().float().argmax()) for row in rows]
        sets[tag] = [row[: end + 2 + number] for number, (row, end) in enumerate(zip(rows, ends, strict=True))]
    lengths = {len(row) for rows in sets.values() for row in rows}
    assert len(lengths) > 1
    folder = save_episodes(sets, tmp_path / "data", task="navigation", seed=0)
    summary = run_experiment(settings(folder, tmp_path / "run"))
    assert "failed_pictures" not in summary


@pytest.mark.slow
def test_everything_is_written_and_read_where_text_is_not_utf8(own_data, tmp_path):
    where = os.pathsep.join(str(Path(__file__).parents[2] / part) for part in ("", "envs", "recipes"))
    ascii_only = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C", "PYTHONPATH": where}

    def ls3_command(*arguments):
        command = [sys.executable, "-m", "ls3_recipes", *map(str, arguments)]
        run = subprocess.run(command, env=os.environ | ascii_only, cwd=tmp_path, capture_output=True, check=False)
        assert run.returncode == 0, run.stderr.decode(errors="replace")[-2000:]

    ls3_command("train", "preset=smoke", "online.updates=1", f"data={own_data()}", "output=run", "pictures=false")
    ls3_command("report", "runs=[run]", "output=report")
    assert "LS³" in (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
