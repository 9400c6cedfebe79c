"""Every setting that the preset cpu changes has its line in the document on them, and there are not many."""

import re
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from ls3_recipes.configuration import CONF, train_settings
from ls3_recipes.options import as_dict

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "docs" / "ablations.md").read_text(encoding="utf-8")
NOW = DOCUMENT.split("## What it changes now")[1].split("\n## ")[0]
IN_TABLE = {
    name
    for line in NOW.splitlines()
    if line.startswith("| `")
    for name in re.findall(r"`([a-z_.]+)`", line.split("|")[1])
}
# What costs hours to switch back: how many steps, images, episodes, candidates and particles.
EFFORT = {
    "vae.steps",
    "vae.batch_size",
    "online.episodes_per_update",
    "planner.num_candidates",
    "planner.num_particles",
}


def flat(settings, prefix=""):
    out = {}
    for key, value in settings.items():
        out |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return out


def settings_of(*arguments):
    return flat(as_dict(train_settings(*arguments)))


CPU, PAPER = (settings_of("task=navigation", f"preset={preset}") for preset in ("cpu", "paper"))
#: What the preset cpu changes of LS³'s settings on Navigation.
CHANGED = {name for name, value in CPU.items() if value != PAPER[name]} - {"preset"}


def test_the_preset_cpu_changes_few_settings_each_with_a_line_in_the_document():
    assert len(CHANGED) <= 20
    assert IN_TABLE == CHANGED
    assert f"changes {len(CHANGED)} settings" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"| `cpu` | {len(CHANGED)} settings" in (ROOT / "docs" / "deviations.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("task", "most"), [("reacher", 8), ("cable_routing", 8), ("pushing", 8)])
def test_what_a_task_needs_beyond_it_is_less(task, most):
    tuned = flat(OmegaConf.to_container(OmegaConf.load(CONF / "tuned" / f"{task}-cpu.yaml")))
    assert 0 < len(tuned) <= most, sorted(tuned)
    assert [name for name in sorted(tuned) if f"`{name}`" not in NOW] == []
    # Each of them changes what the task has otherwise.
    paper = settings_of(f"task={task}", "preset=paper")
    otherwise = paper | {name: CPU[name] for name in CHANGED}
    assert [name for name, value in tuned.items() if otherwise[name] == value] == []


def test_the_sweep_switches_every_change_back_but_those_that_cost_hours():
    arms = yaml.safe_load((CONF / "sweep" / "ablation.yaml").read_text(encoding="utf-8"))["arms"]
    assert arms[0] == []
    names = [[argument.partition("=")[0] for argument in arm] for arm in arms]
    assert {name for arm in names for name in arm} == CHANGED - EFFORT
    for arm, changes in zip(arms, names, strict=True):
        switched = settings_of("task=navigation", "preset=cpu", *arm)
        assert [switched[name] for name in changes] == [PAPER[name] for name in changes]


@pytest.mark.parametrize("task", ["reacher", "cable_routing"])
def test_a_task_has_a_sweep_that_switches_its_own_changes_back(task):
    tuned = flat(OmegaConf.to_container(OmegaConf.load(CONF / "tuned" / f"{task}-cpu.yaml")))
    arms = yaml.safe_load((CONF / "sweep" / f"ablation_{task}.yaml").read_text(encoding="utf-8"))["arms"]
    assert arms[0] == []
    switched = dict(argument.split("=", 1) for arm in arms for argument in arm)
    # How many updates there are is how long a run takes.
    assert set(switched) == set(tuned) - {"online.updates"}
    otherwise = settings_of(f"task={task}", "preset=paper") | {name: CPU[name] for name in CHANGED}
    for name in switched:
        assert settings_of(f"task={task}", "preset=cpu", f"{name}={switched[name]}")[name] == otherwise[name]
