"""Former names of settings are read, with a warning that gives the present one; what is gone is told."""

import re

import pytest
from omegaconf import OmegaConf

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.configuration import settings_of_run, train_settings
from ls3_recipes.options import as_dict, defaults
from ls3_recipes.renamed import (
    REMOVED,
    RENAMED,
    RENAMED_OF_BENCHMARK,
    on_command_line,
    rename_overrides,
    rename_settings,
)


def has(name):
    for algorithm in ALGORITHMS.values():
        node = defaults(algorithm.settings_class)
        for key in name.split("."):
            node = node.get(key, {}) if isinstance(node, dict) else {}
        if node != {}:
            return True
    return False


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_every_present_name_is_a_setting_and_no_former_one_is(old, new):
    assert has(new)
    assert not has(old)


@pytest.mark.parametrize("prefix", ["", "+", "++", "~"])
def test_arguments_are_renamed_with_a_warning(prefix):
    with pytest.warns(UserWarning, match=r"vae\.agent is now called vae\.checkpoint"):
        assert rename_overrides([f"{prefix}vae.agent=a=b", "seed=1"]) == [f"{prefix}vae.checkpoint=a=b", "seed=1"]
    with pytest.warns(UserWarning, match="plain is now called reference"):
        assert rename_overrides(["plain=false"], RENAMED_OF_BENCHMARK) == ["reference=false"]


def test_what_only_begins_like_a_former_name_stays():
    overrides = ["loss.gamma_safe_set=0.5", "--help", "vae.agents=3", "online.share"]
    assert rename_overrides(overrides) == overrides


def test_an_argument_by_its_former_name_sets_the_present_one():
    with pytest.warns(UserWarning, match=r"buffer\.success_tail"):
        assert as_dict(train_settings("preset=smoke", "loss.success_tail=4"))["buffer"]["success_tail"] == 4


def test_settings_of_files_are_renamed_and_empty_sections_vanish():
    old = {"loss": {"gamma": 0.9, "gamma_safe_set": 0.3}, "task": {"name": "reacher", "risk": {"gamma": 0.5}}}
    with pytest.warns(UserWarning, match="is now called"):
        new = rename_settings(old)
    assert new == {
        "loss": {"gamma_safe_set": 0.3},
        "task": {"name": "reacher"},
        "buffer": {"gamma": 0.9},
        "policy": {"risk": {"gamma": 0.5}},
    }
    assert old["loss"]["gamma"] == 0.9


def test_where_both_names_are_there_the_present_one_counts():
    with pytest.warns(UserWarning, match=r"policy\.penalty"):
        new = rename_settings({"task": {"name": "a", "sacfd_penalty": -3}, "policy": {"penalty": -1}})
    assert new["policy"] == {"penalty": -1}


def test_in_composed_settings_a_former_name_wins_over_defaults_but_not_over_arguments():
    composed = {"online": {"share": 0.2, "fraction": 0.5}}
    with pytest.warns(UserWarning, match=r"online\.fraction"):
        assert rename_settings(composed, explicit=()) == {"online": {"fraction": 0.2}}
    with pytest.warns(UserWarning, match=r"online\.fraction"):
        assert rename_settings(composed, explicit={"online.fraction"}) == {"online": {"fraction": 0.5}}


def test_the_former_penalty_of_sacfd_is_none_of_awac():
    for algorithm, penalty in (("sacfd", -5), ("awac", -1)):
        composed = {"algorithm": algorithm, "task": {"sacfd_penalty": -5}, "policy": {"penalty": -1}}
        with pytest.warns(UserWarning, match=r"policy\.penalty"):
            assert rename_settings(composed, explicit=())["policy"] == {"penalty": penalty}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_run_of_before_the_renaming_has_the_settings_that_it_had(tmp_path, algorithm):
    settings = train_settings(f"algorithm={algorithm}", "preset=smoke", "buffer.gamma=0.9", "buffer.success_tail=7")
    old = as_dict(settings)
    # As they were written before: under their former names, with what the task alone had.
    for former, present in RENAMED.items():
        *path, name = present.split(".")
        section = old
        for key in path:
            section = section.get(key, {})
        if name in section:
            *path, last = former.split(".")
            target = old
            for key in path:
                target = target.setdefault(key, {})
            target[last] = section[name] if former.startswith("task.") and "policy" in present else section.pop(name)
    old["task"] |= {"sacfd_penalty": -3.0, "risk": {"gamma": 0.95, "threshold": 0.8}}
    assert not old.pop("buffer")
    OmegaConf.save(OmegaConf.create(old), tmp_path / "config.yaml")
    with pytest.warns(UserWarning, match="is now called"):
        assert settings_of_run(tmp_path) == settings


def having(name):
    """Arguments of a run with the section of a setting."""
    return "preset=smoke", f"algorithm={'sacfd' if name.startswith('policy.') else 'ls3'}"


@pytest.mark.parametrize("name", REMOVED)
def test_a_setting_that_is_gone_is_none_and_arguments_that_set_it_are_told(name):
    assert not has(name)
    with pytest.raises(ValueError, match=rf"^The setting {name} is gone: .* Leave it out\.$"):
        train_settings(*having(name), f"{name}=7")


@pytest.mark.parametrize(("name", "only"), REMOVED.items())
def test_a_run_that_was_trained_with_a_setting_that_is_gone_is_read(tmp_path, name, only):
    section, key = name.split(".")
    settings = train_settings(*having(name))
    for value in (False if name == "vae.unit_scale" else only, 7):
        values = as_dict(settings)
        values[section][key] = value
        OmegaConf.save(OmegaConf.create(values), tmp_path / "config.yaml")
        if value == (False if name == "vae.unit_scale" else only):  # the preset smoke predicts no latents
            assert settings_of_run(tmp_path) == settings
        else:
            with pytest.warns(UserWarning, match=f"trained with settings that are gone: {name}="):
                assert settings_of_run(tmp_path) == settings


def test_what_a_run_had_that_is_gone_is_told_in_one_line(tmp_path, capsys):
    values = as_dict(train_settings("preset=smoke"))
    values["planner"] |= {"goal_reduction": "expected", "min_std": 0.0}
    values["optim"]["cooldown"] = 0.25
    values["vae"] |= {"unit_scale": True, "prediction_weight": 1.0}
    OmegaConf.save(OmegaConf.create(values), tmp_path / "config.yaml")
    gone = 'goal_reduction="expected", optim.cooldown=0.25. Its agent plans now without planner.goal_reduction.'
    with pytest.warns(UserWarning, match=re.escape(f"trained with settings that are gone: planner.{gone}")):
        settings_of_run(tmp_path)
    with on_command_line("ls3 report"):
        settings_of_run(tmp_path)
    assert capsys.readouterr().err == f"ls3 report: this run was trained with settings that are gone: planner.{gone}\n"


@pytest.mark.parametrize(
    ("weight", "scaled", "fits"), [(0, False, True), (1, True, True), (0, True, False), (1, False, False)]
)
def test_latents_have_their_own_unit_where_they_are_predicted(weight, scaled, fits):
    settings = {"vae": {"prediction_weight": weight, "unit_scale": scaled}}
    if fits:
        assert rename_settings(settings, explicit=()) == {"vae": {"prediction_weight": weight}}
    else:
        with pytest.raises(ValueError, match=r"vae\.unit_scale is gone: it follows vae\.prediction_weight"):
            rename_settings(settings, explicit=())


def test_in_a_file_of_ones_own_a_setting_that_is_gone_may_only_say_what_all_runs_do():
    assert rename_settings({"vae": {"crop_scale": None, "steps": 3}}, explicit=()) == {"vae": {"steps": 3}}
    with pytest.raises(ValueError, match=r"vae\.crop_scale is gone.* Got \[0\.8, 1\.0\]\."):
        rename_settings({"vae": {"crop_scale": [0.8, 1.0]}}, explicit=())
