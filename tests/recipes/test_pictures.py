"""Every picture of a run is drawn, is an image, and is not blank."""

import numpy as np
import pytest
from PIL import Image

NAMES = ("learning_curves", "losses", "reconstructions", "heatmaps", "paths", "plans")


@pytest.mark.parametrize("name", NAMES)
def test_picture_is_there_and_shows_something(run_folder, name):
    pixels = np.asarray(Image.open(run_folder / f"{name}.png").convert("RGB"))
    assert min(pixels.shape[:2]) > 100
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20


def test_film_has_a_frame_for_every_step(run_folder):
    with Image.open(run_folder / "evaluation.gif") as film:
        assert film.n_frames == 12
