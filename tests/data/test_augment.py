import subprocess
import sys

import pytest
import torch

from ls3_torchrl.data import random_perspective


def test_perspective_moves_a_square_within_its_bounds_and_keeps_the_ground():
    images = torch.full((64, 3, 64, 64), 40, dtype=torch.uint8)
    images[:, :, 28:36, 28:36] = 200
    moved = random_perspective(images, shift=0.1, tilt=0.0)
    assert moved.dtype == torch.uint8
    assert moved.shape == images.shape
    rows, columns = (torch.stack([(i[0] > 120).nonzero()[:, k].float().mean() for i in moved]) for k in (0, 1))
    for place in (rows, columns):
        assert (place - 31.5).abs().max() <= 0.1 * 64 + 1
        assert place.std() > 2.0  # uniform over 12.8 pixels: 3.7
    assert moved[:, :, 0].max() <= 41  # what comes into view is the ground carried on
    assert not torch.equal(random_perspective(images, shift=0.0, tilt=0.1), images)
    assert torch.equal(random_perspective(images, shift=0.0, tilt=0.0), images)


def test_perspective_repeats_with_its_generator():
    images = torch.randint(256, (4, 1, 64, 64), dtype=torch.uint8)
    one, other = (random_perspective(images, generator=torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(one, other)


@pytest.mark.parametrize("options", [{"shift": 0.6}, {"tilt": 0.3}, {"shift": -0.1}])
def test_perspectives_that_lose_the_image_are_refused(options):
    with pytest.raises(ValueError, match="shift must lie in"):
        random_perspective(torch.zeros(1, 3, 64, 64, dtype=torch.uint8), **options)


def test_perspective_needs_uint8():
    with pytest.raises(TypeError, match=r"uint8 images, got torch\.float32"):
        random_perspective(torch.zeros(1, 3, 64, 64))


def test_only_perspectives_need_opencv_and_say_how_to_get_it():
    code = """
import sys
sys.modules["cv2"] = None  # what a missing libGL.so.1 comes to
import torch
from ls3_torchrl.data import TaggedReplayBuffer, random_perspective
try:
    random_perspective(torch.zeros(1, 3, 64, 64, dtype=torch.uint8))
except ImportError as error:
    print(error)
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "random_perspective needs OpenCV" in said
    assert "pip install 'ls3-torchrl[recipes]' or pip install opencv-python-headless" in said


def test_the_data_path_is_imported_without_opencv():
    code = "import sys, ls3_torchrl.data; print('cv2' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False"]
