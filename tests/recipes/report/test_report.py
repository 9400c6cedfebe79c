"""What several runs say together, by hand."""

import csv
import html.parser
import json
import re

import numpy as np
import pytest
import yaml
from PIL import Image

from ls3_recipes.commands.report import main
from ls3_recipes.report.groups import grouped
from ls3_recipes.report.reading import read_run, run_folders
from ls3_recipes.report.statistics import estimate, interquartile_mean
from ls3_recipes.report.tables import figures_of, settings_side_by_side
from ls3_recipes.report.writing import LABELS, write_report


def make_run(folder, algorithm, seed, successes, *, task="navigation", episodes=4, evaluation=-50.0, **planner):
    folder.mkdir(parents=True)
    figures = {"success_rate": 1.0, "violation_rate": 0.0, "return_std": 0.0, "episodes": 20}
    summary = {"algorithm": algorithm, "task": task, "seed": seed, "minutes": 6.0}
    summary |= {"demonstrations": figures | {"return_mean": -80.0}}
    summary |= {"online": figures | {"return_mean": -70.0}, "evaluation": figures | {"return_mean": evaluation}}
    (folder / "summary.json").write_text(json.dumps(summary))
    settings = {"algorithm": "awac", "preset": "cpu", "seed": seed, "output": str(folder), "task": {"name": task}}
    (folder / "config.yaml").write_text(yaml.safe_dump(settings | ({"planner": planner} if planner else {})))
    with (folder / "metrics.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["seconds", "phase", "step", "name", "value"])
        rows.writerow([1, "VAE", 0, "mean_success", 9])  # of another phase
        for i, success in enumerate(successes):
            for name, value in (("mean_success", success), ("mean_violation", 0.25), ("mean_return", -60.0 - i)):
                rows.writerow([1, "online", (i + 1) * episodes, name, value])
    return folder


def roll_out(folder, *successes):
    (folder / "rollouts").mkdir()
    for update, success in enumerate(successes):
        figures = {"success": [success, True], "violation": [False, False], "return": [-40.0, -50.0]}
        content = {"update": update, "online_episodes": 4 * update, **figures}
        (folder / "rollouts" / f"agent_{update:03d}.json").write_text(json.dumps(content))


class Page(html.parser.HTMLParser):
    """What a page holds, and what it would fetch."""

    def __init__(self, path):
        super().__init__()
        self.words, self.sources, self.links, self.ids, self.open = [], [], [], set(), []
        self.feed(path.read_text(encoding="utf-8"))
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.sources += [attrs[name] for name in ("src", "srcset", "poster") if name in attrs]
        self.links += [attrs["href"]] if "href" in attrs else []
        self.ids |= {attrs["id"]} if "id" in attrs else set()
        if tag not in ("meta", "img", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data.strip())


def test_a_run_is_read_as_it_was_written(tmp_path):
    folder = make_run(tmp_path / "a", "awac", 3, [0.0, 0.5], horizon=5)
    roll_out(folder, False, True)
    run = read_run(folder)
    assert (run.algorithm, run.seed, run.task) == ("awac", 3, "navigation")
    assert run.episodes.tolist() == [4, 8]
    assert run.curves["mean_success"].tolist() == [0.0, 0.5]
    assert run.curves["mean_return"].tolist() == [-60.0, -61.0]
    assert run.rollouts.episodes.tolist() == [0, 4]
    assert run.rollouts.figures["success"].tolist() == [[0.0, 1.0], [1.0, 1.0]]
    assert run.settings["planner.horizon"] == 5
    assert not {"seed", "output"} & run.settings.keys()


def test_interquartile_mean_and_bootstrap_by_hand():
    assert interquartile_mean(np.array([1.0, 2.0, 3.0, 100.0])) == pytest.approx(2.5)
    assert interquartile_mean(np.array([1.0, 2.0, 9.0])) == pytest.approx(4.0)  # three: none is left out
    values = np.array([0.0, 1.0])
    found = estimate(values)  # its resamples are 00, 01, 10 and 11: a quarter each lies at an end
    assert (found.middle, found.low, found.high) == (0.5, 0.0, 1.0)
    rates = np.array([0.0, 0.0, 0.0, 1.0])
    assert estimate(rates).middle == 0.0
    assert estimate(rates, trimmed=False).middle == 0.25  # the run that violates is seen
    single = estimate(np.array([[1.0, 2.0]]))
    assert single.middle.tolist() == [1.0, 2.0]
    assert np.isnan(single.low).all()


def test_an_interval_covers_the_mean_as_often_as_it_says():
    draw = np.random.default_rng(1)
    covered = [
        found.low <= 0.0 <= found.high for found in (estimate(draw.normal(size=20), trimmed=False) for _ in range(300))
    ]
    assert 0.88 < np.mean(covered) < 0.99


def test_runs_that_differ_in_seeds_alone_are_one_group(tmp_path):
    runs = [
        read_run(make_run(tmp_path / f"{limit}-{seed}", "ls3", seed, [1.0], safe_set_threshold=limit, horizon=5))
        for limit in (None, 0.8, 0.5)
        for seed in (1, 0)
    ]
    groups = grouped(runs, LABELS)
    assert [group.title for group in groups] == ["LS³, δ_S = 0.5", "LS³, δ_S = 0.8", "LS³, no safe set"]
    assert [[run.seed for run in group.runs] for group in groups] == [[0, 1]] * 3
    assert len({group.colour for group in groups}) == 3
    marked = {name: (values, differs) for name, values, differs in settings_side_by_side(groups)}
    assert marked["planner.safe_set_threshold"] == (["0.5", "0.8", "null"], True)
    assert marked["planner.horizon"] == (["5", "5", "5"], False)
    with pytest.raises(ValueError, match="come twice"):
        grouped([*runs, runs[0]], LABELS)


def test_groups_that_differ_in_many_settings_have_titles_and_films_of_their_own(tmp_path):
    many = {"horizon": 5, "num_candidates": 20, "num_particles": 4}
    runs = [read_run(make_run(tmp_path / "first", "ls3", 0, [1.0], horizon=1, num_candidates=9, num_particles=1))]
    runs += [read_run(make_run(tmp_path / f"{r}", "ls3", 0, [1.0], **many, relaxation=r)) for r in (0.5, 0.8)]
    titles = [group.title for group in grouped(runs, LABELS)]
    assert len({*titles}) == 3


def test_runs_of_one_seed_on_other_data_are_groups_of_their_own(tmp_path):
    runs = []
    for name, seed in (("a", 0), ("b", 0), ("a", 1)):
        folder = make_run(tmp_path / f"{name}{seed}", "ls3", seed, [1.0])
        settings = yaml.safe_load((folder / "config.yaml").read_text()) | {"data": f"/data/{name}"}
        (folder / "config.yaml").write_text(yaml.safe_dump(settings))
        runs.append(read_run(folder))
    assert [len(group.runs) for group in grouped(runs, LABELS)] == [2, 1]
    assert [len(group.runs) for group in grouped(runs[1:], LABELS)] == [2]  # every seed may have data of its own


def test_a_run_of_two_sweeps_comes_twice_whatever_folders_it_names(tmp_path):
    runs = []
    for sweep, seed, digest in (("a", 0, "d0"), ("b", 0, "d0"), ("a", 1, "d1"), ("b", 1, "other")):
        folder = make_run(tmp_path / f"{sweep}{seed}", "ls3", seed, [1.0])
        settings = yaml.safe_load((folder / "config.yaml").read_text())
        settings |= {"data": f"/runs/{sweep}/shared/data-{seed}"}
        settings |= {"vae": {"checkpoint": f"/runs/{sweep}/shared/vae-{seed}/vae.pt"}}
        (folder / "config.yaml").write_text(yaml.safe_dump(settings))
        (folder / "versions.json").write_text(json.dumps({"data": digest}))
        runs.append(read_run(folder))
    with pytest.raises(ValueError, match=r"come twice: .*a0, .*b0"):
        grouped(runs[:3], LABELS)
    groups = grouped([runs[0], *runs[2:]], LABELS)  # seed 1 on other data: every sweep is a group, not every seed
    assert [[run.seed for run in group.runs] for group in groups] == [[0, 1], [1]]
    assert groups[1].changes["data"] == "/runs/b"


def test_evaluations_and_shared_vaes_are_no_runs_and_folders_may_have_any_name(tmp_path):
    run = make_run(tmp_path / "shared" / "x", "ls3", 0, [1.0])
    for folder in (run / "evaluation", tmp_path / "evaluated"):
        folder.mkdir()
        (folder / "config.yaml").write_text(f"run: {run}\nagent: agent.pt\n")
        (folder / "summary.json").write_text("{}")
    make_run(tmp_path / "shared" / "vae-navigation-seed0-00000000", "ls3", 0, [1.0])
    assert run_folders([tmp_path]) == ([run], [])
    assert run_folders([tmp_path / "shared"]) == ([run], [])


def test_the_table_by_hand(tmp_path):
    runs = [
        read_run(make_run(tmp_path / "b0", "bc", 0, [1.0, 1.0], evaluation=-84.0)),
        read_run(make_run(tmp_path / "l1", "ls3", 1, [0.5, 1.0], evaluation=-52.0)),
        read_run(make_run(tmp_path / "l0", "ls3", 0, [0.0, 1.0], evaluation=-50.0)),
    ]
    rows = figures_of(grouped(runs, LABELS))
    assert [(row["algorithm"], row["seeds"]) for row in rows] == [("LS³", "2"), ("Behaviour cloning", "1")]
    assert rows[0]["evaluation return"] == "−51.0 [−52.0, −50.0]"
    assert rows[0]["evaluation success"] == "100 % [100, 100]"
    assert rows[1]["evaluation return"] == "−84.0"
    assert rows[0]["violating episodes"] == "2.0 [2.0, 2.0]"  # a quarter of 4, twice


def test_the_page_holds_everything_and_fetches_nothing(tmp_path):
    for seed in (0, 1):
        for limit in (0.2, 0.5, None):
            name = f"ls3-{limit}-{seed}"
            roll_out(make_run(tmp_path / name, "ls3", seed, [0.5, 1.0], constraint_threshold=limit), False, True)
        make_run(tmp_path / f"awac-{seed}", "awac", seed, [0.5], task="reacher", episodes=3)
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "config.yaml").write_text("seed: 3\n")
    make_run(tmp_path / "shared" / "vae-x", "ls3", 9, [1.0])
    write_report([tmp_path], tmp_path / "report", "A <sweep>", {"broken": "no <room>"})
    page = Page(tmp_path / "report" / "report.html")
    text = " ".join(page.words)
    for said in ("A <sweep>", "LS³, δ_C = 0.5", "LS³, no constraints", "AWAC", "no <room>", "broken", "Reacher"):
        assert said in text, said
    assert str(tmp_path / "cut") in text
    assert "vae" not in [word for word in page.words if "shared" in word]
    assert page.sources
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert all(link.startswith("#") and link[1:] in page.ids for link in page.links)
    assert "http" not in re.sub('base64,[^"]*', "", (tmp_path / "report" / "report.html").read_text())
    for name in ("navigation-learning", "navigation-rollouts", "navigation-sensitivity", "reacher-learning"):
        picture = np.asarray(Image.open(tmp_path / "report" / f"{name}.png").convert("RGB"))
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
    with (tmp_path / "report" / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    assert {row["planner.constraint_threshold"] for row in rows} == {"0.2", "0.5", ""}
    with (tmp_path / "report" / "curves.csv").open() as file:
        kinds = [row["kind"] for row in csv.DictReader(file)]
    assert (kinds.count("online"), kinds.count("rollouts")) == (14, 12)


def test_damaged_runs_are_left_out_and_named(tmp_path, capsys):
    for seed in range(3):
        make_run(tmp_path / "runs" / f"{seed}", "ls3", seed, [1.0, 0.5])
    (tmp_path / "runs" / "0" / "summary.json").write_text("{")
    (tmp_path / "runs" / "1" / "metrics.csv").write_text("seconds,phase,step,name,value\n")
    report = write_report([tmp_path / "runs"], tmp_path / "report", "Three")
    assert [[run.seed for run in group.runs] for part in report.parts for group in part.groups] == [[2]]
    assert sorted(report.left_out) == [str(tmp_path / "runs" / name) for name in "01"]
    page = (tmp_path / "report" / "report.html").read_text()
    assert "summary.json is damaged" in page
    assert "online episodes do not have all of" in page
    assert capsys.readouterr().out.count("Left out: ") == 2
    (tmp_path / "runs" / "2" / "summary.json").write_text("{")
    with pytest.raises(ValueError, match="No run can be read"):
        write_report([tmp_path / "runs"], tmp_path / "again", "None")


def test_the_command_takes_folders(tmp_path, capsys):
    folders = [make_run(tmp_path / "it's, one", "ls3", 0, [1.0]), make_run(tmp_path / "b=2", "awac", 0, [1.0])]
    main([*map(str, folders), f"output={tmp_path / 'report'}"])
    assert "AWAC" in capsys.readouterr().out
    assert (tmp_path / "report" / "report.html").is_file()
    with pytest.raises(SystemExit, match="exists already"):
        main([str(folders[0]), f"output={tmp_path / 'report'}"])


def test_nothing_and_no_run_are_refused(tmp_path):
    with pytest.raises(SystemExit, match="No runs"):
        main([])
    with pytest.raises(SystemExit, match="holds no run"):
        main([str(tmp_path)])
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "config.yaml").write_text("seed: 3\n")
    assert run_folders([tmp_path]) == ([], [tmp_path / "cut"])
    with pytest.raises(SystemExit, match="None of the 1 runs is finished"):
        main([str(tmp_path), f"output={tmp_path / 'report'}"])
