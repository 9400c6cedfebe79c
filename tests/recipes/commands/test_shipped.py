"""The agents that come with the package: small, whole, of this machine nothing, and evaluated by their task's name."""

import json

import pytest

from ls3_recipes.commands import main
from ls3_recipes.configuration import settings_of_run
from ls3_recipes.shipped import shipped_agents, with_shipped_agents
from ls3_torchrl import LS3Agent

SHIPPED = shipped_agents()


def test_there_are_agents():
    assert "navigation" in SHIPPED


@pytest.mark.parametrize("task", SHIPPED)
def test_a_shipped_agent_is_small_and_comes_with_its_settings_and_a_card(task):
    folder = SHIPPED[task]
    assert (folder / "agent.pt").stat().st_size < 2.3e6
    settings = settings_of_run(folder)
    assert settings.task.name == task
    assert LS3Agent.load(folder / "agent.pt").task == task
    assert "/" not in (folder / "config.yaml").read_text()  # no paths
    card = (folder / "card.md").read_text()
    for heading in ("How it was trained", "How well it does", "What it is not for"):
        assert heading in card


def test_names_of_tasks_stand_for_shipped_agents_where_nothing_else_is_meant(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    place = SHIPPED["navigation"]
    assert with_shipped_agents("evaluate", ["agent=navigation", "seed=1"]) == [
        f"run='{place}'",
        "episodes=6",
        "output='runs/navigation-evaluate-seed${seed}'",
        "seed=1",
    ]
    assert with_shipped_agents("calibrate", ["agent=navigation", "output=o"]) == [f"run='{place}'", "output=o"]
    assert with_shipped_agents("evaluate", ["run=r", "filter=navigation"]) == ["run=r", f"filter='{place}'"]
    for others in (["agent=navigation", "run=r"], ["agent=agent.pt"], ["filter=runs/x"]):
        assert with_shipped_agents("evaluate", others) == others
    (tmp_path / "navigation").mkdir()
    assert with_shipped_agents("evaluate", ["filter=navigation"]) == ["filter=navigation"]  # a folder of one's own


@pytest.mark.slow
def test_a_shipped_agent_is_evaluated_without_a_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    few = ["planner.num_candidates=8", "planner.num_elites=4", "planner.num_particles=1"]
    assert main(["evaluate", "agent=navigation", "filter=navigation", "episodes=1", "device=cpu", *few]) == 0
    folder = tmp_path / "runs/navigation-evaluate-seed12345"
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["task"], summary["evaluation"]["episodes"]) == ("navigation", 1)
    assert (folder / "evaluation.gif").is_file()
    assert not list(SHIPPED["navigation"].glob("evaluation*"))
