"""Every picture of a run is drawn, is an image, and is not blank."""

import av
import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from ls3_recipes.plots.films import save_film

NAMES = ("learning_curves", "losses", "reconstructions", "heatmaps", "paths", "plans", "timelines")


@pytest.mark.parametrize("name", NAMES)
def test_picture_is_there_and_shows_something(run_folder, name):
    pixels = np.asarray(Image.open(run_folder / f"{name}.png").convert("RGB"))
    assert min(pixels.shape[:2]) > 100
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20


def test_films_have_a_frame_for_every_step(run_folder):
    with Image.open(run_folder / "evaluation.gif") as video:
        assert video.n_frames == 12
    with av.open(str(run_folder / "evaluation.mp4")) as film:
        assert film.streams.video[0].codec_context.name == "h264"  # which browsers play
        assert len(list(film.decode(video=0))) == 12


@pytest.mark.parametrize("name", ["film.gif", "film.mp4"])
def test_frames_tell_the_outcome(tmp_path, name):
    pixels = torch.zeros(2, 3, 9, 64, 64, dtype=torch.uint8)
    pixels[:, :, -3:] = 200  # of stacked pictures, the newest is shown
    flags = torch.zeros(2, 2, 3, 1, dtype=torch.bool)
    flags[0, 0, 1:], flags[1, 1, 2:] = True, True
    step = {"pixels": pixels, "constraint": flags[0], "success": flags[1]}
    save_film(tmp_path / name, TensorDict({"next": step}, [2, 3]))
    with av.open(str(tmp_path / name)) as film:
        last = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)][2].astype(int)
    assert last.shape == (204, 402, 3)  # three pixels for one, and gaps of six
    assert abs(last[100, 100] - 200).max() < 8
    frames = [last[100, 4 + 198 * i] for i in range(2)]
    wanted = [[0xD1, 0x49, 0x5B], [0x1B, 0x7F, 0x79]]  # violated, in the goal
    assert all(abs(found - np.array(colour)).max() < 40 for found, colour in zip(frames, wanted, strict=True))
