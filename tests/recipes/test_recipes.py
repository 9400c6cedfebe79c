import csv
import json
import math
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException, MissingConfigException
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.data import Bounded

import protocol
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, load_episodes, save_episodes
from settings import agent_options

RECIPES = Path(__file__).parents[2] / "recipes"
PRESETS = ("cpu", "paper", "smoke")

# TorchRL warns about classes of its own while its collectors are imported.
pytestmark = pytest.mark.filterwarnings("ignore:Creating .* which inherits from WeightUpdaterBase:DeprecationWarning")


def configure(*overrides):
    with initialize_config_dir(config_dir=str(RECIPES / "conf"), version_base="1.3"):
        return compose("ls3", overrides=list(overrides))


@pytest.fixture
def ls3():
    import ls3 as recipe

    return recipe


@pytest.fixture
def no_work(ls3, monkeypatch):
    """Fails the test as soon as the recipe begins to collect or to train."""

    def work(*args, **kwargs):
        pytest.fail("the recipe began to work")

    monkeypatch.setattr(protocol, "collect_demonstrations", work)
    monkeypatch.setattr(ls3, "Training", work)
    monkeypatch.setattr(ls3, "train_vae", work)


# --- configuration --------------------------------------------------------------------------------------------

# Table 1 of the supplement, the Navigation column.
TABLE_1 = {
    "planner.safe_set_threshold": 0.8,
    "planner.constraint_threshold": 0.2,
    "vae.beta": 1e-6,
    "planner.horizon": 5,
    "planner.num_particles": 20,
    "planner.num_candidates": 1000,
    "planner.num_elites": 100,
    "agent.latent_dim": 32,
    "planner.p_random": 1.0,
    "optim.batch_size": 256,
    "vae.batch_size": 256,
    "loss.gamma": 0.99,
    "loss.gamma_safe_set": 0.3,
}

# What the supplement's text says beside the table, and the counts of the original experiments.
TEXT = {
    "agent.dynamics_hidden": [128, 128],
    "agent.value_hidden": [256, 256, 256],
    "agent.classifier_hidden": [256, 256, 256],
    "agent.propagation": "ts1",
    "optim.lr": 1e-4,
    "vae.lr": 1e-4,
    "optim.dynamics_lr": 1e-3,
    "optim.target_interval": 100,
    "planner.relaxation": 0.8,
    "planner.optim_steps": 4,  # n_cem_iters = 5 samples five iterations and scores four
    "planner.pessimism": 0.0,
    "planner.min_std": 0.0,
    "online.updates": 25,
    "online.episodes_per_update": 10,
    "online.value_td_steps": 2000,
    "online.dynamics_steps": 512,
    "online.classifier_steps": 512,
    "offline.dynamics_steps": 10_000,
    "offline.classifier_steps": 10_000,
    "vae.steps": 100_000,
    "vae.crop_scale": [0.8, 1.0],
    "task.buffer_capacity": 35_000,
}


@pytest.mark.parametrize(("key", "value"), [*TABLE_1.items(), *TEXT.items()])
def test_the_paper_preset_is_the_paper(key, value):
    assert OmegaConf.select(configure("task=navigation", "preset=paper"), key) == value


def test_the_paper_collects_as_many_episodes_as_the_paper():
    import ls3_envs

    assert "offline_episodes" not in configure("preset=paper").task
    assert {kind: data.episodes for kind, data in ls3_envs.domain("navigation").offline.items()} == {
        "success": 50,
        "constraint": 50,
    }


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_composes_and_fits_the_library(preset):
    config = configure(f"preset={preset}")
    assert config.preset == preset
    assert OmegaConf.missing_keys(config) == set()
    # Agent and planner take exactly these settings, and find them in range.
    spec = Bounded(low=-3.0, high=3.0, shape=(2,))
    agent = LS3Agent(action_dim=2, **agent_options(config, spec))
    planner = agent.planner(spec, **config.planner)
    assert planner.horizon == config.planner.horizon
    assert planner.optimizer.num_candidates == config.planner.num_candidates


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_change_the_effort_not_the_safety_thresholds(preset):
    config = configure(f"preset={preset}")
    for key in ("planner.safe_set_threshold", "planner.constraint_threshold", "loss.gamma", "loss.gamma_safe_set"):
        assert OmegaConf.select(config, key) == TABLE_1[key]


def test_command_line_settings_win_over_the_preset():
    config = configure("preset=smoke", "planner.num_candidates=33", "seed=7")
    assert config.planner.num_candidates == 33
    assert config.seed == 7


def test_the_output_folder_is_named_after_task_preset_and_seed():
    assert Path(configure("preset=smoke", "seed=4").output).name.startswith("navigation-smoke-seed4")


@pytest.mark.parametrize(
    ("override", "error", "message"),
    [
        (
            "task=moon_landing",
            MissingConfigException,
            r"(?s)task/moon_landing.*Available options in 'task'.*navigation",
        ),
        ("preset=fast", MissingConfigException, r"(?s)preset/fast.*Available options in 'preset'.*cpu.*paper.*smoke"),
        ("planner.num_candidate=5", ConfigCompositionException, r"Could not override 'planner\.num_candidate'"),
        ("sead=1", ConfigCompositionException, "Could not override 'sead'"),
    ],
)
def test_unknown_names_are_refused_with_what_there_is(override, error, message):
    with pytest.raises(error, match=message):
        configure(override)


# --- refusals before any work ---------------------------------------------------------------------------------


def test_an_existing_output_folder_is_refused_before_any_work(ls3, no_work, tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    config = configure("preset=smoke", "device=cpu", f"output={tmp_path}")
    with pytest.raises(FileExistsError, match=r"exists already.*output=DIR"):
        ls3.train(config)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def tiny_episodes(folder, tags, task="navigation"):
    pixels = torch.zeros(1, 2, 3, 64, 64, dtype=torch.uint8)
    flags = {key: torch.zeros(1, 2, 1, dtype=torch.bool) for key in ("constraint", "success")}
    step = {"pixels": pixels, "reward": -torch.ones(1, 2, 1), **flags}
    episodes = TensorDict({"pixels": pixels, "action": torch.zeros(1, 2, 2), "next": step}, [1, 2])
    return save_episodes(dict.fromkeys(tags, episodes), folder, task=task, seed=0)


@pytest.mark.parametrize(("there", "missing"), [(Tag.SUCCESS, "constraint"), (Tag.CONSTRAINT, "success")])
def test_data_without_an_essential_kind_are_refused_before_any_work(ls3, no_work, tmp_path, there, missing):
    data = tiny_episodes(tmp_path / "data", [there])
    config = configure("preset=smoke", "device=cpu", f"data={data}", f"output={tmp_path / 'run'}")
    with pytest.raises(ValueError, match=f"has no {missing} episodes.*Collect them first"):
        ls3.train(config)
    assert not (tmp_path / "run").exists()


def test_data_of_another_task_are_refused_before_any_work(ls3, no_work, tmp_path):
    data = tiny_episodes(tmp_path / "data", [Tag.SUCCESS, Tag.CONSTRAINT], task="reacher")
    config = configure("preset=smoke", "device=cpu", f"data={data}", f"output={tmp_path / 'run'}")
    with pytest.raises(ValueError, match="'reacher', but 'navigation' is wanted"):
        ls3.train(config)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("override", "error", "message"),
    [
        ("planner.num_elites=21", ValueError, "num_elites must lie between 1 and num_candidates = 20"),
        ("planner.safe_set_threshold=1.2", ValueError, "safe_set_threshold must lie strictly between 0 and 1"),
        ("planner.engine=jax", ValueError, "'auto', 'fused', 'rollout'"),
        ("agent.propagation=ts2", ValueError, "'ts1', 'tsinf'"),
        ("agent.latent_dim=0", ValueError, "latent_dim must be at least 1"),
        ("data=/nowhere/at/all", FileNotFoundError, r"holds no episodes.*collect\.py"),
    ],
)
def test_impossible_settings_are_refused_before_any_work(ls3, no_work, tmp_path, override, error, message):
    config = configure("preset=smoke", "device=cpu", f"output={tmp_path / 'run'}", override)
    with pytest.raises(error, match=message):
        ls3.train(config)
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device to choose")
def test_cuda_without_a_device_is_refused_before_any_work(ls3, no_work, tmp_path):
    config = configure("preset=smoke", "device=cuda", f"output={tmp_path / 'run'}")
    with pytest.raises(ValueError, match="device=cuda was asked for, but PyTorch sees no CUDA device"):
        ls3.train(config)
    assert not (tmp_path / "run").exists()


# --- the command line -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_help_names_groups_settings_and_examples(tmp_path):
    command = [sys.executable, str(RECIPES / "ls3.py"), "preset=paper", "--help"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    for word in ("task=navigation", *PRESETS, "num_candidates: 1000", "output=", "python recipes/ls3.py"):
        assert word in done.stdout
    assert list(tmp_path.iterdir()) == []


# --- parts ----------------------------------------------------------------------------------------------------


def test_parts_of_a_run_share_no_seed():
    drawn = [seed for run in range(50) for seed in protocol.seeds(run).values()]
    assert len(set(drawn)) == len(drawn)


def test_figures_of_episodes_by_hand():
    from common import episode_figures, summarise

    step = {
        "reward": torch.tensor([[-1.0, -1.0, 0.0], [-1.0, -1.0, -1.0]]).unsqueeze(-1),
        "success": torch.tensor([[False, False, True], [False] * 3]).unsqueeze(-1),
        "constraint": torch.tensor([[False] * 3, [False, True, False]]).unsqueeze(-1),
    }
    figures = episode_figures(TensorDict({"next": step}, [2, 3]))
    assert figures["return"].tolist() == [-2.0, -3.0]
    assert figures["success"].tolist() == [True, False]
    assert figures["violation"].tolist() == [False, True]
    # Over all episodes of all parts, not a mean of means.
    one = {name: value[:1] for name, value in figures.items()}
    assert summarise([figures, one]) == {
        "success_rate": 0.6667,
        "violation_rate": 0.3333,
        "return_mean": -2.333,
        "return_std": 0.471,
        "episodes": 3,
    }


# --- everything once ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_smoke_preset_runs_everything_and_leaves_a_complete_folder(ls3, tmp_path):
    folder = tmp_path / "run"
    config = configure("preset=smoke", "device=cpu", "seed=3", "pictures=false", f"output={folder}")
    returned = ls3.train(config)

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

    written = OmegaConf.load(folder / "config.yaml")
    assert written.planner == config.planner
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

    # A checkpoint from before the first online episode, and one after each update; the last is the agent.
    checkpoints = sorted(path.name for path in (folder / "checkpoints").iterdir())
    assert checkpoints == ["agent_000.pt", "agent_001.pt", "agent_002.pt"]
    agents = [LS3Agent.load(folder / "checkpoints" / name, latent_dim=config.agent.latent_dim) for name in checkpoints]
    final = LS3Agent.load(folder / summary["agent"])
    for name, weights in final.state_dict().items():
        assert torch.equal(weights, agents[-1].state_dict()[name]), name
    frozen, learning = ("encoder", "decoder"), ("dynamics", "value", "safe_set", "constraint", "goal")
    for name in (*frozen, *learning):
        pairs = [
            (a, b)
            for a, b in zip(getattr(agents[0], name).parameters(), getattr(final, name).parameters(), strict=True)
        ]
        same = all(torch.equal(a, b) for a, b in pairs)
        assert same == (name in frozen), name


@pytest.mark.slow
def test_the_seed_decides_a_run(ls3, tmp_path):
    def run(name, seed):
        config = configure("preset=smoke", "device=cpu", "pictures=false", "online.updates=1", f"seed={seed}")
        config.output = str(tmp_path / name)
        summary = ls3.train(config)
        weights = LS3Agent.load(tmp_path / name / "agent.pt").state_dict()
        return summary["online"], summary["evaluation"], weights

    one, two, other = run("one", 1), run("two", 1), run("other", 2)
    assert one[:2] == two[:2]
    assert all(torch.equal(one[2][name], two[2][name]) for name in one[2])
    assert not all(torch.equal(one[2][name], other[2][name]) for name in one[2])


def test_the_best_update_violates_least_then_returns_most_and_is_the_latest_of_equals():
    def figures(violation, *returns):
        return {"violation": torch.tensor(violation).bool(), "return": torch.tensor(returns)}

    rounds = [figures([0, 1], -9.0, -9.0), figures([0, 0], -40.0, -50.0), figures([0, 0], -44.0, -46.0)]
    assert protocol.best_update(rounds) == 2
    assert protocol.best_update(rounds[:2]) == 1
    assert protocol.best_update(rounds[:1]) == 0


@pytest.mark.parametrize("select", ["last", "best"])
def test_the_agent_that_is_kept_is_the_one_that_was_selected(ls3, monkeypatch, tmp_path, select):
    monkeypatch.setattr(protocol, "best_update", lambda online: 1)
    ls3.train(configure("preset=smoke", f"online.select={select}", "pictures=false", f"output={tmp_path / 'run'}"))
    kept = LS3Agent.load(tmp_path / "run" / "agent.pt").state_dict()
    agents = [LS3Agent.load(path).state_dict() for path in sorted((tmp_path / "run" / "checkpoints").glob("*.pt"))]
    same = [all(torch.equal(kept[key], agent[key]) for key in kept) for agent in agents]
    assert same == ([False, True, False] if select == "best" else [False, False, True])
