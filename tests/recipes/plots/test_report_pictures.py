"""Figures of several runs together, by hand."""

import csv
import json

import numpy as np
import pytest
from PIL import Image

from ls3_recipes.commands.report import ReportSettings, report
from ls3_recipes.plots.report import mean_and_error, read_run


def make_run(folder, algorithm, seed, successes, *, task="navigation", episodes=4, evaluation=-50.0):
    folder.mkdir(parents=True)
    figures = {"success_rate": 1.0, "violation_rate": 0.0, "return_std": 0.0, "episodes": 20}
    summary = {"algorithm": algorithm, "task": task, "seed": seed, "demonstrations": figures | {"return_mean": -80.0}}
    summary |= {"online": figures | {"return_mean": -70.0}, "evaluation": figures | {"return_mean": evaluation}}
    (folder / "summary.json").write_text(json.dumps(summary))
    with (folder / "metrics.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["seconds", "phase", "step", "name", "value"])
        rows.writerow([1, "VAE", 0, "mean_success", 9])  # of another phase
        for i, success in enumerate(successes):
            for name, value in (("mean_success", success), ("mean_violation", 0.25), ("mean_return", -60.0 - i)):
                rows.writerow([1, "online", (i + 1) * episodes, name, value])
    return folder


def settings(tmp_path, *folders):
    return ReportSettings(runs=tuple(map(str, folders)), output=str(tmp_path / "report"))


def test_a_run_is_read_as_it_was_written(tmp_path):
    run = read_run(make_run(tmp_path / "a", "awac", 3, [0.0, 0.5]))
    assert (run.algorithm, run.seed) == ("awac", 3)
    assert run.episodes.tolist() == [4, 8]
    assert run.curves["mean_success"].tolist() == [0.0, 0.5]
    assert run.curves["mean_return"].tolist() == [-60.0, -61.0]


def test_mean_and_standard_error_by_hand():
    values = np.array([[1.0, 0.0], [3.0, 0.0], [5.0, 3.0]])
    mean, error = mean_and_error(values)
    assert mean.tolist() == [3.0, 1.0]
    assert error.tolist() == pytest.approx([2.0 / 3**0.5, 3**0.5 / 3**0.5])
    mean, error = mean_and_error(values[:1])
    assert mean.tolist() == [1.0, 0.0]
    assert error.tolist() == [0.0, 0.0]


def test_table_and_picture(tmp_path):
    folders = [
        make_run(tmp_path / "b0", "bc", 0, [1.0, 1.0], evaluation=-84.0),
        make_run(tmp_path / "l1", "ls3", 1, [0.5, 1.0], evaluation=-52.0),
        make_run(tmp_path / "l0", "ls3", 0, [0.0, 1.0], evaluation=-50.0),
    ]
    rows = report(settings(tmp_path, *folders))
    assert [(row["algorithm"], row["seeds"]) for row in rows] == [("LS³", "2"), ("Behaviour cloning", "1")]
    assert rows[0]["evaluation return"] == "-51.0 ± 1.0"
    assert rows[0]["evaluation success"] == "100 ± 0 %"
    assert rows[0]["violating episodes"] == "2.0 ± 0.0"  # a quarter of 4, twice
    text = (tmp_path / "report" / "comparison.md").read_text().splitlines()
    assert text[2].startswith("| LS³ | 2 |")
    assert len(text) == 4
    picture = np.asarray(Image.open(tmp_path / "report" / "comparison.png").convert("RGB"))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"task": "reacher"}, "several tasks: navigation, reacher"),
        ({"episodes": 2}, "different online episodes"),
        ({"seed": 0, "algorithm": "ls3"}, "come twice"),
    ],
)
def test_what_is_not_comparable_is_refused(tmp_path, other, message):
    one = make_run(tmp_path / "one", "ls3", 0, [0.0, 1.0])
    two = make_run(tmp_path / "two", **({"algorithm": "awac", "seed": 1, "successes": [0.0, 1.0]} | other))
    with pytest.raises(ValueError, match=message):
        report(settings(tmp_path, one, two))
    assert not (tmp_path / "report").exists()


def test_nothing_and_no_run_are_refused(tmp_path):
    with pytest.raises(ValueError, match="No runs"):
        report(settings(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"summary\.json is missing"):
        report(settings(tmp_path, tmp_path))
    (tmp_path / "report").mkdir()
    with pytest.raises(FileExistsError, match="exists already"):
        report(settings(tmp_path, tmp_path))
