"""``ls3 calibrate``: thresholds from one half of fresh violations, counted on the other."""

import json
import shutil

import pytest
import torch

from ls3_recipes.commands.calibrate import CalibrateSettings, calibrate
from ls3_recipes.configuration import compose_settings
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, load_episodes, save_episodes, steps_into_violation
from ls3_torchrl.planners import foresee


def calibrated(*arguments):
    return calibrate(compose_settings("calibrate", CalibrateSettings, ["device=cpu", *arguments]))


@pytest.fixture
def easy_run(run_folder, tmp_path):
    """A run whose estimators are certain of nothing."""
    folder = shutil.copytree(run_folder, tmp_path / "run")
    agent = LS3Agent.load(folder / "agent.pt")
    with torch.no_grad():
        for head in (agent.constraint, agent.safe_set):
            head.network[-1].weight.mul_(1e-3)
            head.network[-1].bias.zero_()
    agent.save(folder / "agent.pt")
    return folder


def test_thresholds_are_found_on_one_half_and_tested_on_the_other(easy_run, tmp_path):
    folder = tmp_path / "calibration"
    summary = calibrated(f"run={easy_run}", "alpha=[0.1,0.3]", "episodes=80", f"output={folder}")
    assert json.loads((folder / "summary.json").read_text()) == summary
    assert (folder / "calibration.png").is_file()
    assert 2 * 30 < summary["found_on"] + summary["tested_on"] <= 80
    strict, loose = summary["levels"]
    assert strict["constraint_threshold"] < loose["constraint_threshold"]
    assert strict["safe_set_threshold"] > loose["safe_set_threshold"]
    for level in (strict, loose):
        for name in ("missed_by_constraint", "missed_by_safe_set"):  # four deviations of 40 draws, and of 40 thresholds
            assert level[name] <= level["alpha"] + 4 * (2 * level["alpha"] * (1 - level["alpha"]) / 40) ** 0.5
    assert strict["false_alarms"] > 0.5  # an estimator that knows nothing pays for it


def test_a_level_without_thresholds_costs_the_others_nothing(easy_run, tmp_path, capsys):
    summary = calibrated(f"run={easy_run}", "alpha=[0.001,0.3]", "episodes=40", f"output={tmp_path / 'some'}")
    assert [level["alpha"] for level in summary["levels"]] == [0.3]
    assert list(summary["not_found"]) == ["0.001"]
    assert "needs 999 violations at least" in summary["not_found"]["0.001"]
    assert "alpha=0.001: " in capsys.readouterr().out


def test_episodes_of_ones_own_calibrate_as_well(easy_run, tmp_path):
    violating = load_episodes(easy_run / "demonstrations")[Tag.CONSTRAINT]
    several = torch.cat([violating] * 12)
    data = save_episodes({Tag.CONSTRAINT: several}, tmp_path / "mine", task="navigation", seed=0)
    summary = calibrated(f"run={easy_run}", "alpha=[0.5]", f"data={data}", f"output={tmp_path / 'own'}")
    count = len(steps_into_violation(several))
    assert summary["found_on"] + summary["tested_on"] == count
    planner = LS3Agent.load(easy_run / "agent.pt").planner()
    seen = foresee(planner, steps_into_violation(violating))["constraint_prob"]
    assert seen.min() - 1e-3 <= summary["levels"][0]["constraint_threshold"] <= seen.max() + 1e-3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["alpha=[0.001]", "episodes=20"], "alpha=0.001 needs 999 violations at least, got"),
        (["alpha=[1.5]"], r"alpha must hold numbers between 0 and 1, such as \[0.05,0.1\]; got \[1.5\]"),
        (["alpha=[]"], "alpha must hold numbers"),
        (["episodes=1"], "episodes must be at least 2"),
    ],
)
def test_what_bounds_nothing_is_refused_and_leaves_no_folder(easy_run, tmp_path, arguments, message):
    folder = tmp_path / "calibration"
    with pytest.raises(ValueError, match=message):
        calibrated(f"run={easy_run}", f"output={folder}", *arguments)
    assert not folder.exists()


def test_only_a_run_of_ls3_has_thresholds(run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "bc")
    written = (folder / "config.yaml").read_text().replace("algorithm: ls3", "algorithm: bc")
    (folder / "config.yaml").write_text(written)
    with pytest.raises(ValueError, match="is a run of bc, which has no planner to calibrate"):
        calibrated(f"run={folder}", f"output={tmp_path / 'calibration'}")
    with pytest.raises(FileNotFoundError, match=r"nothing\.pt is missing"):
        calibrated(f"run={run_folder}", "agent=nothing.pt", f"output={tmp_path / 'calibration'}")
