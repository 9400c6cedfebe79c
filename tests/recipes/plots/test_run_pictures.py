"""Every picture of a run is drawn, is an image, and is not blank."""

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from ls3_recipes.plots.run import save_video

NAMES = ("learning_curves", "losses", "reconstructions", "heatmaps", "paths", "plans", "timelines")


@pytest.mark.parametrize("name", NAMES)
def test_picture_is_there_and_shows_something(run_folder, name):
    pixels = np.asarray(Image.open(run_folder / f"{name}.png").convert("RGB"))
    assert min(pixels.shape[:2]) > 100
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20


def test_video_has_a_frame_for_every_step(run_folder):
    with Image.open(run_folder / "evaluation.gif") as video:
        assert video.n_frames == 12


def test_frames_tell_the_outcome_and_missing_episodes_leave_room(tmp_path):
    pixels = torch.zeros(2, 3, 9, 64, 64, dtype=torch.uint8)
    pixels[:, :, -3:] = 200  # of stacked pictures, the newest is shown
    flags = torch.zeros(2, 2, 3, 1, dtype=torch.bool)
    flags[0, 0, 1:], flags[1, 1, 2:] = True, True
    step = {"pixels": pixels, "constraint": flags[0], "success": flags[1]}
    save_video(tmp_path / "video.gif", TensorDict({"next": step}, [2, 3]), count=3, zoom=1, gap=6)
    with Image.open(tmp_path / "video.gif") as video:
        assert video.size == (3 * 70 + 6, 76)
        video.seek(2)
        last = np.asarray(video.convert("RGB")).astype(int)
    assert abs(last[40, 40] - 200).max() < 8
    frames = [last[40, 4 + 70 * i] for i in range(3)]
    wanted = [[0xD1, 0x49, 0x5B], [0x1B, 0x7F, 0x79], [255, 255, 255]]  # violated, in the goal, not there
    assert all(abs(found - np.array(colour)).max() < 8 for found, colour in zip(frames, wanted, strict=True))
