"""Metrics on Weights & Biases, offline."""

import pytest

from ls3_recipes import tracker
from ls3_recipes.configuration import train_settings
from ls3_recipes.protocol import run_experiment

QUICK = ("preset=smoke", "device=cpu", "pictures=false", "algorithm=bc", "encoder=conv", "online.updates=1")


@pytest.mark.slow
def test_a_run_is_followed_offline(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    logged = []
    keep = wandb.Run.log

    def log(self, data, *args, **options):
        logged.append(data)
        return keep(self, data, *args, **options)

    monkeypatch.setattr(wandb.Run, "log", log)
    run_experiment(train_settings(*QUICK, "tracker=wandb", f"output={tmp_path / 'run'}"))
    assert any("online/mean_return" in data for data in logged)
    assert list((tmp_path / "run").rglob("run-*.wandb"))


def test_a_tracker_that_is_not_installed_is_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr(tracker, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"tracker=wandb needs a package: pip install wandb\."):
        run_experiment(train_settings(*QUICK, "tracker=wandb", f"output={tmp_path / 'run'}"))
    assert not (tmp_path / "run").exists()
