"""Every picture of a run is drawn, is an image, and is not blank."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from PIL import Image

import ls3

NAMES = ("learning_curves", "losses", "reconstructions", "heatmaps", "paths", "plans")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures") / "run"
    with initialize_config_dir(str(Path(ls3.__file__).parent / "conf"), version_base="1.3"):
        config = compose("ls3", ["preset=smoke", "device=cpu", f"output={folder}"])
    torch.manual_seed(0)
    ls3.train(config)
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_picture_is_there_and_shows_something(run_folder, name):
    pixels = np.asarray(Image.open(run_folder / f"{name}.png").convert("RGB"))
    assert min(pixels.shape[:2]) > 100
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20


def test_film_has_a_frame_for_every_step(run_folder):
    with Image.open(run_folder / "evaluation.gif") as film:
        assert film.n_frames == 12
