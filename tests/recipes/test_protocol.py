"""The protocol: what is refused before any work, what a run leaves, and that its seed decides it."""

import csv
import json
import math
import platform
import sys
from importlib.metadata import version

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from ls3_recipes import experiment, offline_data
from ls3_recipes.algorithms import ls3
from ls3_recipes.configuration import settings_of_run, train_settings
from ls3_recipes.options import as_dict
from ls3_recipes.protocol import run_experiment
from ls3_recipes.seeding import seeds
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, load_episodes, save_episodes

# TorchRL warns about classes of its own while its collectors are imported.
pytestmark = pytest.mark.filterwarnings("ignore:Creating .* which inherits from WeightUpdaterBase:DeprecationWarning")


def settings(*overrides):
    return train_settings("preset=smoke", "device=cpu", *overrides)


@pytest.fixture
def no_work(monkeypatch):
    """Fails the test as soon as a run begins to collect or to train."""

    def work(*args, **kwargs):
        pytest.fail("the run began to work")

    monkeypatch.setattr(offline_data, "collect_demonstrations", work)
    monkeypatch.setattr(ls3, "LS3Trainer", work)
    monkeypatch.setattr(ls3, "VAETrainer", work)


# --- refusals before any work ---------------------------------------------------------------------------------


def test_an_existing_output_folder_is_refused_before_any_work(no_work, tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    config = settings(f"output={tmp_path}")
    with pytest.raises(FileExistsError, match=r"(?s)exists already.*output=DIR"):
        run_experiment(config)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.fixture
def no_probe(monkeypatch):
    """Leaves out what takes most of a smoke run's time and changes nothing that is learnt."""
    monkeypatch.setattr(ls3, "probe", lambda *_: {})


def tiny_episodes(folder, tags, task="navigation"):
    pixels = torch.zeros(1, 2, 3, 64, 64, dtype=torch.uint8)
    flags = {key: torch.zeros(1, 2, 1, dtype=torch.bool) for key in ("constraint", "success")}
    step = {"pixels": pixels, "reward": -torch.ones(1, 2, 1), **flags}
    episodes = TensorDict({"pixels": pixels, "action": torch.zeros(1, 2, 2), "next": step}, [1, 2])
    return save_episodes(dict.fromkeys(tags, episodes), folder, task=task, seed=0)


@pytest.mark.parametrize(("there", "missing"), [(Tag.SUCCESS, "constraint"), (Tag.CONSTRAINT, "success")])
def test_data_without_an_essential_kind_are_refused_before_any_work(no_work, tmp_path, there, missing):
    data = tiny_episodes(tmp_path / "data", [there])
    config = settings(f"data={data}", f"output={tmp_path / 'run'}")
    with pytest.raises(ValueError, match=f"has no {missing} episodes.*Collect them first"):
        run_experiment(config)
    assert not (tmp_path / "run").exists()


def test_data_of_another_task_are_refused_before_any_work(no_work, tmp_path):
    data = tiny_episodes(tmp_path / "data", [Tag.SUCCESS, Tag.CONSTRAINT], task="reacher")
    config = settings(f"data={data}", f"output={tmp_path / 'run'}")
    with pytest.raises(ValueError, match="'reacher', but 'navigation' is wanted"):
        run_experiment(config)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("override", "error", "message"),
    [
        ("planner.num_elites=21", ValueError, r"^planner\.num_elites must lie between 1 and num_candidates = 20"),
        (
            "planner.safe_set_threshold=1.2",
            ValueError,
            r"^planner\.safe_set_threshold must lie strictly between 0 and 1",
        ),
        ("planner.engine=jax", ValueError, "'auto', 'fused', 'rollout'"),
        ("agent.action_scale=range", ValueError, "'box'"),
        ("buffer.capacity=0", ValueError, r"^buffer\.capacity must be at least 1"),
        ("buffer.success_tail=0", ValueError, r"^buffer\.success_tail must be at least 1"),
        ("agent.latent_dim=0", ValueError, r"^agent\.latent_dim must be at least 1"),
        ("data=/nowhere/at/all", FileNotFoundError, r"holds no episodes.*ls3 collect"),
    ],
)
def test_impossible_settings_are_refused_before_any_work(no_work, tmp_path, override, error, message):
    with pytest.raises(error, match=message):
        run_experiment(settings(f"output={tmp_path / 'run'}", override))
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device to choose")
def test_cuda_without_a_device_is_refused_before_any_work(no_work, tmp_path):
    config = train_settings("preset=smoke", "device=cuda", f"output={tmp_path / 'run'}")
    with pytest.raises(ValueError, match="device=cuda was asked for, but PyTorch sees no CUDA device"):
        run_experiment(config)
    assert not (tmp_path / "run").exists()


# --- parts ----------------------------------------------------------------------------------------------------


def test_parts_of_a_run_share_no_seed():
    drawn = [seed for run in range(50) for seed in seeds(run).values()]
    assert len(set(drawn)) == len(drawn)


# --- everything once ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_smoke_preset_runs_everything_and_leaves_a_complete_folder(tmp_path):
    folder = tmp_path / "run"
    fixed = ["threads=1", "vae.autocast=false", "optim.autocast=false", "planner.precision=fp32"]
    config = settings("seed=3", "pictures=false", f"output={folder}", *fixed)
    returned = run_experiment(config)

    summary = json.loads((folder / "summary.json").read_text())
    assert summary == json.loads(json.dumps(returned))
    assert (summary["task"], summary["preset"], summary["seed"]) == ("navigation", "smoke", 3)
    assert summary["minutes"] >= 0
    assert {"cpu", "cores", "threads", "gpu"} <= set(summary["hardware"])
    episodes = {"demonstrations": 3, "online": 2 * 2, "evaluation": 2}
    for part, count in episodes.items():
        figures = summary[part]
        assert set(figures) == {"success_rate", "violation_rate", "return_mean", "return_std", "episodes"}
        assert figures["episodes"] == count
        assert 0 <= figures["success_rate"] <= 1
        assert 0 <= figures["violation_rate"] <= 1
        assert figures["return_std"] >= 0
    for part in ("online", "evaluation"):  # 12 steps of -1 or 0
        assert -12 <= summary[part]["return_mean"] <= 0

    assert OmegaConf.load(folder / "config.yaml") == as_dict(config)
    assert settings_of_run(folder) == config
    versions = json.loads((folder / "versions.json").read_text())
    assert versions["torch"] == version("torch")
    assert versions["python"] == platform.python_version()

    with (folder / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {"VAE", "Dynamics", "Safe set", "Constraint", "Goal", "online"} <= {row["phase"] for row in rows}
    assert all(math.isfinite(float(row["value"])) for row in rows)
    assert any((folder / "tensorboard").iterdir())

    demonstrations = load_episodes(folder / "demonstrations", task="navigation")
    assert set(demonstrations) == {Tag.SUCCESS, Tag.CONSTRAINT}

    # A checkpoint from before the first online episode, and one after each update; the agent is one that acted.
    checkpoints = sorted(path.name for path in (folder / "checkpoints").iterdir())
    assert checkpoints == ["agent_000.pt", "agent_001.pt", "agent_002.pt"]
    agents = [LS3Agent.load(folder / "checkpoints" / name, latent_dim=config.agent.latent_dim) for name in checkpoints]
    final = LS3Agent.load(folder / summary["agent"])
    weights = final.state_dict()
    assert any(all(torch.equal(weights[key], agent.state_dict()[key]) for key in weights) for agent in agents[:-1])
    frozen, learning = ("encoder", "decoder"), ("dynamics", "value", "safe_set", "constraint", "goal")
    for name in (*frozen, *learning):
        pairs = [
            (a, b)
            for a, b in zip(getattr(agents[0], name).parameters(), getattr(agents[-1], name).parameters(), strict=True)
        ]
        same = all(torch.equal(a, b) for a, b in pairs)
        assert same == (name in frozen), name


@pytest.mark.slow
def test_the_seed_decides_a_run(no_probe, tmp_path):
    def run(name, seed):
        output = f"output={tmp_path / name}"
        summary = run_experiment(settings("pictures=false", "online.updates=1", f"seed={seed}", output))
        weights = LS3Agent.load(tmp_path / name / "agent.pt").state_dict()
        return summary["online"], summary["evaluation"], weights

    one, two, other = run("one", 1), run("two", 1), run("other", 2)
    assert one[:2] == two[:2]
    assert all(torch.equal(one[2][name], two[2][name]) for name in one[2])
    assert not all(torch.equal(one[2][name], other[2][name]) for name in one[2])


def test_the_agent_that_is_kept_is_the_one_whose_episodes_went_best(no_probe, monkeypatch, tmp_path):
    monkeypatch.setattr(experiment, "best_update", lambda online: 1)
    run_experiment(settings("pictures=false", f"output={tmp_path / 'run'}"))
    kept = LS3Agent.load(tmp_path / "run" / "agent.pt").state_dict()
    agents = [LS3Agent.load(path).state_dict() for path in sorted((tmp_path / "run" / "checkpoints").glob("*.pt"))]
    same = [all(torch.equal(kept[key], agent[key]) for key in kept) for agent in agents]
    assert same == [False, True, False]


def test_without_updates_there_are_no_online_episodes_and_nothing_is_selected(no_probe, tmp_path):
    run = settings("online.updates=0", "pictures=false", f"output={tmp_path / 'run'}")
    summary = run_experiment(run)
    assert "online" not in summary
    assert [path.name for path in (tmp_path / "run" / "checkpoints").iterdir()] == ["agent_000.pt"]


def test_a_run_whose_data_were_there_already_learns_the_same(no_probe, run_folder, tmp_path):
    folder = tmp_path / "run"
    torch.manual_seed(0)
    run_experiment(settings(f"data={run_folder / 'demonstrations'}", "pictures=false", f"output={folder}"))
    assert not (folder / "demonstrations").exists()
    one, other = (LS3Agent.load(path / "agent.pt").state_dict() for path in (run_folder, folder))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_the_summary_says_how_busy_the_cores_were(run_folder):
    summary = json.loads((run_folder / "summary.json").read_text())
    if sys.platform == "linux":
        # Phases too short for the clock's ticks are there as well.
        assert summary["cpu_utilisation"].keys() == summary["seconds"].keys()
    assert all(0.0 <= used <= 1.0 for used in summary.get("cpu_utilisation", {}).values())
