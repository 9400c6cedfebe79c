"""The two small commands, on what the large one left."""

import json
import shutil

import pytest
from omegaconf import OmegaConf
from PIL import Image

from ls3_recipes.command_settings import ReportSettings
from ls3_recipes.commands.collect import CollectSettings, collect
from ls3_recipes.commands.evaluate import EvaluateSettings, evaluate
from ls3_recipes.commands.report import report
from ls3_recipes.configuration import compose_settings
from ls3_torchrl.data import Tag, load_episodes


def evaluated(*arguments):
    return evaluate(compose_settings("evaluate", EvaluateSettings, ["device=cpu", *arguments]))


def test_collect_saves_what_train_reads(tmp_path):
    folder = tmp_path / "mine"
    settings = compose_settings("collect", CollectSettings, [f"output={folder}", "seed=4", "task.offline_episodes=2"])
    assert collect(settings) == folder
    episodes = load_episodes(folder, task="navigation")
    assert {tag: tuple(data.shape) for tag, data in episodes.items()} == {
        Tag.SUCCESS: (2, 100),
        Tag.CONSTRAINT: (2, 100),
    }
    with pytest.raises(FileExistsError, match="output=DIR"):
        collect(settings)


def test_collect_names_its_folder_after_task_and_seed():
    settings = compose_settings("collect", CollectSettings, ["task=reacher", "seed=4"])
    assert (settings.output, settings.task.name) == ("data/reacher-seed4", "reacher")


def test_evaluate_runs_a_trained_agent_and_leaves_summary_and_video(run_folder, tmp_path):
    folder = tmp_path / "evaluation"
    summary = evaluated(f"run={run_folder}", "episodes=3", f"output={folder}")
    assert summary["evaluation"]["episodes"] == 3
    assert json.loads((folder / "summary.json").read_text()) == summary
    with Image.open(folder / "evaluation.gif") as video:
        assert video.n_frames == 12


def test_evaluate_takes_an_earlier_checkpoint_and_other_planner_settings(run_folder, tmp_path):
    folder = tmp_path / "evaluation"
    evaluated(
        f"run={run_folder}",
        "agent=checkpoints/agent_000.pt",
        "episodes=1",
        f"output={folder}",
        "planner.num_candidates=8",
    )
    written = OmegaConf.load(folder / "config.yaml")
    assert written.planner.num_candidates == 8
    assert written.planner.horizon == 3  # the run's


def test_a_filter_stands_before_any_policy(run_folder, tmp_path):
    folder = tmp_path / "random"
    said = (f"run={run_folder}", "policy=random", "episodes=2", f"filter={run_folder}")
    summary = evaluated(*said, "planner.num_candidates=8", f"output={folder}")
    assert (summary["algorithm"], summary["agent"]) == ("random", None)
    rates = summary["filter"]
    assert rates["intervention_rate"] == pytest.approx(rates["constraint_rate"] + rates["safe_set_rate"])
    assert json.loads((folder / "summary.json").read_text())["filtered_by"] == str(run_folder)
    assert OmegaConf.load(folder / "config.yaml").planner.num_candidates == 8
    # LS³'s own planner carries its plan beside the filter's.
    trained = evaluated(*said[:1], *said[2:], f"output={tmp_path / 'trained'}")
    assert trained["algorithm"] == "ls3"
    with pytest.raises(ValueError, match=r"policy must be one of 'trained', 'random', got 'careless'"):
        evaluated(f"run={run_folder}", "policy=careless", f"output={tmp_path / 'other'}")


def test_a_filter_is_a_run_of_ls3_on_the_same_task(run_folder, tmp_path):
    for name, change in (("bc", {"algorithm": "bc"}), ("reacher", {"task": {"name": "reacher"}})):
        other = tmp_path / name
        other.mkdir()
        config = OmegaConf.merge(OmegaConf.load(run_folder / "config.yaml"), change)
        OmegaConf.save(config, other / "config.yaml")
    with pytest.raises(ValueError, match=r"filter must be a run on navigation, as .* is; .*reacher is one on reacher"):
        evaluated(f"run={run_folder}", f"filter={tmp_path / 'reacher'}", f"output={tmp_path / 'o'}")
    with pytest.raises(FileNotFoundError, match=r"config\.yaml is missing"):
        evaluated(f"run={run_folder}", f"filter={tmp_path}", f"output={tmp_path / 'o'}")


def test_planner_settings_that_fit_no_planner_are_refused(run_folder, tmp_path):
    with pytest.raises(ValueError, match=r"^planner\.num_elites must lie"):
        evaluated(f"run={run_folder}", "planner.num_elites=1000", f"output={tmp_path / 'evaluation'}")
    assert not (tmp_path / "evaluation").exists()


def test_an_agent_that_is_missing_is_named_with_those_that_there_are(run_folder, tmp_path):
    unfinished = tmp_path / "run"
    (unfinished / "checkpoints").mkdir(parents=True)
    for name in ("config.yaml", "checkpoints/agent_000.pt", "checkpoints/agent_001.pt"):
        shutil.copy(run_folder / name, unfinished / name)
    said = (
        r"agent\.pt is missing. The newest agent of the run is agent=checkpoints/agent_001.pt. It is not finished: ls3"
    )
    with pytest.raises(FileNotFoundError, match=said):
        evaluated(f"run={unfinished}", f"output={tmp_path / 'evaluation'}")
    assert not (tmp_path / "evaluation").exists()
    evaluated(f"run={unfinished}", "agent=checkpoints/agent_001.pt", "episodes=1", f"output={tmp_path / 'evaluation'}")
    with pytest.raises(FileNotFoundError, match=r"agent_009\.pt is missing. The newest agent of the run is"):
        evaluated(f"run={run_folder}", "agent=checkpoints/agent_009.pt", f"output={tmp_path / 'other'}")


def test_a_report_says_of_an_unfinished_run_how_to_finish_it(run_folder, tmp_path):
    shutil.copytree(run_folder, tmp_path / "run")
    (tmp_path / "run" / "summary.json").unlink()
    with pytest.raises(ValueError, match=r"None of the 1 runs is finished; ls3 train resume=.*/run goes on with one"):
        report(ReportSettings(runs=(str(tmp_path / "run"),), output=str(tmp_path / "report")))


def test_evaluate_refuses_a_folder_that_is_no_run(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"config\.yaml is missing"):
        evaluated(f"run={tmp_path}")


def test_evaluate_says_that_a_run_is_needed():
    with pytest.raises(Exception, match="run"):
        evaluated()
