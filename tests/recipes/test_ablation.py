"""Every setting that the preset cpu changes has its line in the document on them, and there are not many."""

from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from ls3_recipes.configuration import CONF, train_settings
from ls3_recipes.options import as_dict

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "docs" / "ablations.md").read_text(encoding="utf-8")


def flat(settings, prefix=""):
    out = {}
    for key, value in settings.items():
        out |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return out


def changed(task):
    """What the preset cpu changes of the preset paper on a task."""
    cpu, paper = (flat(as_dict(train_settings(f"task={task}", f"preset={preset}"))) for preset in ("cpu", "paper"))
    return {name for name, value in cpu.items() if value != paper[name] and name != "preset"}


def test_the_preset_cpu_changes_few_settings_each_with_a_line_in_the_document():
    names = changed("navigation")
    assert len(names) <= 20, sorted(names)
    assert [name for name in sorted(names) if f"`{name}" not in DOCUMENT] == []


@pytest.mark.parametrize("task", ["reacher", "pushing", "cable_routing"])
def test_what_a_task_needs_beyond_it_is_less(task):
    tuned = flat(OmegaConf.to_container(OmegaConf.load(CONF / "tuned" / f"{task}-cpu.yaml")))
    assert 0 < len(tuned) <= 8, sorted(tuned)
    assert [name for name in sorted(tuned) if f"`{name}" not in DOCUMENT] == []
    # Each of them changes what the task has otherwise.
    paper = flat(as_dict(train_settings(f"task={task}", "preset=paper")))
    cpu = flat(as_dict(train_settings("task=navigation", "preset=cpu")))
    otherwise = paper | {name: cpu[name] for name in changed("navigation")}
    assert [name for name, value in tuned.items() if otherwise[name] == value] == []


def test_the_sweep_switches_back_what_the_preset_changes():
    sweep = yaml.safe_load((CONF / "sweep" / "ablation.yaml").read_text(encoding="utf-8"))
    switched = {argument.partition("=")[0] for arm in sweep["arms"] for argument in arm}
    assert switched <= changed("navigation")
    # What costs hours is left out: how many steps, images, episodes, candidates and particles.
    effort = {"steps", "batch_size", "episodes_per_update", "updates", "num_candidates", "num_particles"}
    assert {name for name in changed("navigation") - switched if name.split(".")[-1] not in effort} == set()
