"""The agents that come with the package: small, whole, of this machine nothing, and evaluated by their task's name."""

import json
import re
from pathlib import Path

import pytest

from ls3_recipes.commands import main
from ls3_recipes.configuration import settings_of_run
from ls3_recipes.overrides import parse
from ls3_recipes.shipped import quoted, shipped_agents, with_shipped_agents
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
    run, episodes, output, seed = with_shipped_agents("evaluate", ["agent=navigation", "seed=1"])
    assert (run, episodes, seed) == (f"run='{place}'", "episodes=6", "seed=1")
    assert re.fullmatch(r"output=runs/navigation-evaluate-\d{8}-\d{6}", output)
    assert with_shipped_agents("calibrate", ["agent=navigation", "output=o"]) == [f"run='{place}'", "output=o"]
    assert with_shipped_agents("evaluate", ["run=r", "filter=navigation"]) == ["run=r", f"filter='{place}'"]
    for others in (["agent=navigation", "run=r"], ["filter=runs/x"]):
        assert with_shipped_agents("evaluate", others) == others
    (tmp_path / "navigation").mkdir()
    assert with_shipped_agents("evaluate", ["filter=navigation"]) == ["filter=navigation"]  # a folder of one's own


@pytest.mark.parametrize("command", ["evaluate", "calibrate"])
def test_an_agent_that_is_not_shipped_needs_its_run(command, capsys):
    with pytest.raises(SystemExit) as left:
        main([command, "agent=navgation"])
    said = f"{left.value} {capsys.readouterr().err}"
    assert "agent=navgation needs the folder of its run" in said
    assert "navigation" in said.split("are")[-1]


@pytest.mark.parametrize("path", ["/a b/c", "C:\\Users\\me", "/it's/mine", "/odd\\'one"])
def test_a_path_is_read_back_as_it_is(path):
    (override,) = parse([f"run={quoted(Path(path))}"])
    assert override.value() == path


@pytest.mark.slow
def test_a_shipped_agent_is_evaluated_without_a_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    few = ["planner.num_candidates=8", "planner.num_elites=4", "planner.num_particles=1"]
    assert main(["evaluate", "agent=navigation", "filter=navigation", "episodes=1", "device=cpu", *few]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["task"], summary["evaluation"]["episodes"]) == ("navigation", 1)
    assert (folder / "evaluation.gif").is_file()
    assert not list(SHIPPED["navigation"].glob("evaluation*"))
