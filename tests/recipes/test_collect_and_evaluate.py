"""The two small recipes, on what the large one left."""

import json
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from PIL import Image

import collect
import evaluate
from ls3_torchrl.data import Tag, load_episodes

CONF = str(Path(collect.__file__).parent / "conf")


def configure(name, *overrides):
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose(name, list(overrides))


def test_collect_saves_what_ls3_reads(tmp_path):
    folder = tmp_path / "mine"
    config = configure("collect", f"output={folder}", "seed=4", "+task.offline_episodes=2")
    assert collect.collect(config) == folder
    episodes = load_episodes(folder, task="navigation")
    assert {tag: tuple(data.shape) for tag, data in episodes.items()} == {
        Tag.SUCCESS: (2, 100),
        Tag.CONSTRAINT: (2, 100),
    }
    with pytest.raises(FileExistsError, match="output=DIR"):
        collect.collect(config)


def test_evaluate_runs_a_trained_agent_and_leaves_summary_and_film(run_folder, tmp_path):
    folder = tmp_path / "evaluation"
    config = configure("evaluate", f"run={run_folder}", "episodes=3", "device=cpu", f"output={folder}")
    summary = evaluate.evaluate(config)
    assert summary["evaluation"]["episodes"] == 3
    assert json.loads((folder / "summary.json").read_text()) == summary
    with Image.open(folder / "evaluation.gif") as film:
        assert film.n_frames == 12


def test_evaluate_takes_an_earlier_checkpoint_and_other_planner_settings(run_folder, tmp_path):
    folder = tmp_path / "evaluation"
    overrides = (f"run={run_folder}", "agent=checkpoints/agent_000.pt", "episodes=1", "device=cpu", f"output={folder}")
    evaluate.evaluate(configure("evaluate", *overrides, "+planner.num_candidates=8"))
    assert "num_candidates: 8" in (folder / "config.yaml").read_text()


def test_evaluate_refuses_a_folder_that_is_no_run(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"config\.yaml is missing"):
        evaluate.evaluate(configure("evaluate", f"run={tmp_path}"))
