import subprocess
import sys

import pytest
import torch

from ls3_torchrl.data import random_perspective, random_resized_crop

# Pixel centres along one side in [-1, 1], the frame in which crops are defined.
GRID = (torch.arange(64) + 0.5) / 32 - 1


def ramps(batch):
    """Images whose channels hold the x and y coordinate of each pixel, scaled to [0, 1]."""
    y, x = torch.meshgrid(GRID, GRID, indexing="ij")
    return ((torch.stack([x, y]) + 1) / 2).expand(batch, -1, -1, -1)


def test_the_full_crop_is_the_image_itself():
    torch.manual_seed(0)
    pixels = torch.randint(256, (2, 3, 64, 64), dtype=torch.uint8)
    torch.testing.assert_close(random_resized_crop(pixels, scale=(1.0, 1.0)), pixels / 255.0, atol=2e-5, rtol=0)


def test_crops_are_squares_within_the_image_with_an_area_in_range():
    generator = torch.Generator().manual_seed(0)
    out = 2 * random_resized_crop(ramps(200), scale=(0.5, 0.8), generator=generator) - 1
    # Read from the middle of the image, where no border pixel takes part: x' = side * x + shift.
    mid = slice(16, 48)
    along_x, along_y = out[:, 0, 32, mid], out[:, 1, mid, 32]
    span = GRID[47] - GRID[16]
    side_x, side_y = (along_x[:, -1] - along_x[:, 0]) / span, (along_y[:, -1] - along_y[:, 0]) / span
    torch.testing.assert_close(side_x, side_y, atol=1e-4, rtol=0)
    area = side_x.square()
    assert area.min() > 0.5 - 1e-3
    assert area.max() < 0.8 + 1e-3
    assert area.max() - area.min() > 0.25  # the range is used, not one value of it
    for along, side in ((along_x, side_x), (along_y, side_y)):
        shift = (along[:, 0] + along[:, -1]) / 2 - side * (GRID[16] + GRID[47]) / 2
        assert (side + shift.abs() < 1 + 1e-3).all()
        # Shifts reach towards both edges: 200 uniform draws leave less than a tenth of the way uncovered.
        room = (shift / (1 - side)).sort().values
        assert room[0] < -0.9
        assert room[-1] > 0.9


def test_images_of_a_batch_are_cropped_differently():
    out = random_resized_crop(ramps(4), generator=torch.Generator().manual_seed(1))
    pairs = torch.cdist(out.flatten(1), out.flatten(1)) + torch.eye(4) * 1e3
    assert pairs.min() > 0.1


def test_a_generator_makes_crops_repeatable_and_leaves_the_global_one_alone():
    before = torch.get_rng_state()
    one, two = (random_resized_crop(ramps(3), generator=torch.Generator().manual_seed(7)) for _ in range(2))
    assert torch.equal(one, two)
    assert torch.equal(before, torch.get_rng_state())


def test_bytes_and_floats_give_the_same_picture():
    torch.manual_seed(0)
    pixels = torch.randint(256, (2, 3, 64, 64), dtype=torch.uint8)
    one, two = (
        random_resized_crop(images, generator=torch.Generator().manual_seed(3)) for images in (pixels, pixels / 255.0)
    )
    torch.testing.assert_close(one, two)
    assert one.dtype == torch.float32
    assert one.min() >= 0
    assert one.max() <= 1


@pytest.mark.parametrize("scale", [(0.0, 1.0), (0.9, 0.8), (0.8, 1.1), (-0.5, 0.5)])
def test_impossible_scales_are_refused(scale):
    with pytest.raises(ValueError, match="0 < low <= high <= 1"):
        random_resized_crop(torch.zeros(1, 3, 64, 64), scale=scale)


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
from ls3_torchrl.data import TaggedReplayBuffer, random_perspective, random_resized_crop
random_resized_crop(torch.zeros(1, 3, 64, 64))
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
