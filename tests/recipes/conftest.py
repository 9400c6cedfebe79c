"""One whole smoke run, with pictures, for the tests that look at what it left."""

from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

import ls3


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures") / "run"
    with initialize_config_dir(str(Path(ls3.__file__).parent / "conf"), version_base="1.3"):
        config = compose("ls3", ["preset=smoke", "device=cpu", f"output={folder}"])
    torch.manual_seed(0)
    ls3.train(config)
    return folder


@pytest.fixture
def config(request):
    conf = request.config.rootpath / "recipes" / "conf"
    with initialize_config_dir(str(conf), version_base="1.3"):
        return compose("ls3", ["preset=smoke"])
