"""Pictures come after the results; one that fails costs nothing but itself, and data without states have the others."""

import json

import matplotlib.pyplot as plt
import pytest
import torch
from tensordict import LazyStackedTensorDict, TensorDict
from torch import nn

from ls3_recipes.algorithms import ls3
from ls3_recipes.configuration import train_settings
from ls3_recipes.figures import as_one_shape, episode_figures
from ls3_recipes.plots import run as plots_of_run
from ls3_recipes.plots.agent import plot_timelines
from ls3_recipes.plots.plane import states_of
from ls3_recipes.plots.style import draw, picture
from ls3_recipes.protocol import run_experiment
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, load_episodes, save_episodes

STANDARD = ("pixels", "action", *(("next", key) for key in ("pixels", "reward", "constraint", "success")))
QUICK = ("preset=smoke", "device=cpu", "online.updates=1", "task.horizon=6")


def test_between_pictures_a_signal_that_waits_is_heard():
    drawn = []

    def stop():
        if len(drawn) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        draw({name: lambda name=name: drawn.append(name) for name in "abc"}, stop)
    assert drawn == ["a", "b"]


def test_each_failure_is_told_and_the_others_are_drawn(tmp_path, capsys):
    def fail():
        with picture(tmp_path / "b.png", 1, 1, (1, 1)):
            raise KeyError("state")

    figures = len(plt.get_fignums())
    failed = draw({"a.png": (tmp_path / "a.png").touch, "b.png": fail, "c.png": (tmp_path / "c.png").touch})
    assert failed == {"b.png": "KeyError: 'state'"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "c.png"]
    assert "b.png was not drawn: KeyError: 'state'" in capsys.readouterr().out
    assert len(plt.get_fignums()) == figures  # nothing is left open


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ls3", "sacfd"])
def test_own_data_without_states_are_trained_on_and_drawn(run_folder, tmp_path, algorithm):
    there = load_episodes(run_folder / "demonstrations")
    data = save_episodes(
        {tag: episodes.select(*STANDARD) for tag, episodes in there.items()},
        tmp_path / "data",
        task="navigation",
        seed=0,
    )
    output = tmp_path / "run"
    summary = run_experiment(train_settings(f"algorithm={algorithm}", *QUICK, f"data={data}", f"output={output}"))
    assert "failed_pictures" not in summary
    assert summary["probe"] == {}
    assert json.loads((output / "summary.json").read_text(encoding="utf-8")) == summary
    names = {"learning_curves", "losses", "paths", "reconstructions", "heatmaps"}
    names |= {"timelines", "plans"} if algorithm == "ls3" else set()
    assert {path.stem for path in output.glob("*.png")} == names


@pytest.mark.slow
def test_results_are_there_before_pictures_which_may_all_fail(tmp_path, monkeypatch, capsys):
    there = []

    def fail(*_):
        there.append((tmp_path / "run" / "summary.json").is_file())
        raise RuntimeError("no ink")

    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    monkeypatch.setattr(plots_of_run, "picture", fail)
    monkeypatch.setattr(plots_of_run, "save_film", fail)
    summary = run_experiment(train_settings(*QUICK, "algorithm=bc", "encoder=conv", f"output={tmp_path / 'run'}"))
    assert there == [True] * 5
    assert set(summary["failed_pictures"]) == {
        *("learning_curves.png", "losses.png", "evaluation.gif", "evaluation.mp4", "paths.png")
    }
    assert set(summary["failed_pictures"].values()) == {"RuntimeError: no ink"}
    assert json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8")) == summary
    assert capsys.readouterr().out.count("was not drawn: RuntimeError: no ink") == 5


class Foreign(nn.Module):
    """A classifier or value of one's own: it reads and writes one key each, and has no method but the call."""

    def __init__(self, *shape):
        super().__init__()
        self.in_keys, self.out_keys, self.shape = ["latent"], ["mine"], shape

    def forward(self, tensordict):
        total = tensordict["latent"].sum(-1).reshape(-1, *[1] * len(self.shape))
        return tensordict.set("mine", total.expand(-1, *self.shape))


@pytest.mark.parametrize("value", [(1,), (3, 1)])
def test_heads_and_values_of_ones_own_are_drawn(run_folder, tmp_path, value):
    agent = LS3Agent.load(run_folder / "agent.pt")
    planner = agent.planner()
    agent.safe_set, agent.constraint, agent.goal, agent.value = Foreign(1), Foreign(1), Foreign(1), Foreign(*value)
    offline = load_episodes(run_folder / "demonstrations")
    plot_timelines(tmp_path, agent, planner, offline, offline[Tag.SUCCESS])
    assert (tmp_path / "timelines.png").stat().st_size > 1000


def episode(steps, *, state=True):
    flags = {key: torch.zeros(steps, 1, dtype=torch.bool) for key in ("constraint", "success")}
    flags["success"][-1] = True
    step = {"reward": -torch.ones(steps, 1), **flags}
    return TensorDict({"next": step} | ({"state": torch.zeros(steps, 2)} if state else {}), [steps])


def test_figures_of_episodes_of_different_lengths():
    ragged = LazyStackedTensorDict.lazy_stack([episode(3), episode(5)], 0)
    figures = episode_figures(ragged)
    assert figures["return"].tolist() == [-3.0, -5.0]
    assert figures["success"].tolist() == [True, True]
    assert as_one_shape(ragged).shape == (1, 8)
    alike = LazyStackedTensorDict.lazy_stack([episode(3), episode(3)], 0)
    assert as_one_shape(alike) is alike


def test_states_are_those_that_there_are():
    with_states = torch.stack([episode(3)] * 4)
    assert len(states_of(with_states, 3)) == 3
    assert states_of(torch.stack([episode(3, state=False)]), 3) == []
    assert states_of(None, 3) == []
