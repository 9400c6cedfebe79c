"""One whole smoke run, with pictures, for the tests that look at what it left; and a logger that remembers."""

import pytest
import torch
from torchrl.record.loggers import Logger

from ls3_recipes.configuration import train_settings
from ls3_recipes.protocol import run_experiment


class Recorder(Logger):
    """A logger that keeps what is logged as (name, value, step)."""

    def __init__(self):
        self.rows = []
        super().__init__(exp_name="test", log_dir="")

    def _create_experiment(self):
        return None

    def log_scalar(self, name, value, step=None):
        self.rows.append((name, value, step))

    def log_video(self, name, video, step=None, **kwargs):
        raise NotImplementedError

    def log_hparams(self, cfg):
        raise NotImplementedError

    def log_histogram(self, name, data, **kwargs):
        raise NotImplementedError

    def __repr__(self):
        return "Recorder()"


@pytest.fixture
def recorder():
    return Recorder()


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures") / "run"
    torch.manual_seed(0)
    run_experiment(train_settings("preset=smoke", "device=cpu", f"output={folder}"))
    return folder
