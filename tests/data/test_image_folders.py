import numpy as np
import pytest
import torch
from PIL import Image

from ls3_torchrl.data import EpisodeKeys, episode_from_images, pixels_from_images
from ls3_torchrl.data.image_folders import natural_order

T = 10


def arrays(steps=T):
    no = np.zeros(steps)
    return {"actions": np.zeros((steps, 2)), "rewards": no - 1, "constraints": no, "successes": no}


def fill(folder, count=T + 1, size=(64, 64), mode="RGB", suffix="png"):
    """Images whose grey value is their number times ten."""
    folder.mkdir(exist_ok=True)
    for t in range(count):
        Image.new("L", size, 10 * t).convert(mode).save(folder / f"img_{t}.{suffix}")
    return folder


def values(episode, key="pixels"):
    return torch.cat([episode[key], episode["next", key][-1:]])[:, :, 5, 5].tolist()


GREY = [[10 * t] * 3 for t in range(T + 1)]


def test_images_come_in_natural_order_and_other_files_are_left_out(tmp_path):
    folder = fill(tmp_path / "run")
    (folder / "notes.txt").write_text("the robot was tired")
    (folder / "._img_3.png").write_bytes(b"of another system")
    episode = episode_from_images(folder, **arrays())
    assert episode.batch_size == (T,)
    assert episode["pixels"].dtype == torch.uint8
    assert episode["pixels"].shape == (T, 3, 64, 64)
    assert values(episode) == GREY
    assert values(episode_from_images(str(folder), **arrays())) == GREY


def test_a_list_is_taken_in_its_order(tmp_path):
    folder = fill(tmp_path / "run")
    files = [folder / f"img_{t}.png" for t in reversed(range(T + 1))]
    assert values(episode_from_images(files, **arrays())) == GREY[::-1]
    assert values(episode_from_images((str(file) for file in files), **arrays())) == GREY[::-1]


def test_names_with_numbers_are_sorted_as_people_do():
    names = ["b1", "a10", "a2", "A3", "7", "10", "a2.5", "a2.10", "²"]
    assert sorted(names, key=natural_order) == ["7", "10", "a2", "a2.5", "a2.10", "A3", "a10", "b1", "²"]


@pytest.mark.parametrize("mode", ["L", "1", "P", "RGBA", "LA"])
def test_grey_palettes_and_transparency_become_red_green_and_blue(tmp_path, mode):
    episode = episode_from_images(fill(tmp_path / "run", mode=mode), **arrays())
    expected = GREY if mode != "1" else torch.tensor(values(episode)).tolist()
    assert values(episode) == expected
    assert episode["pixels"].shape == (T, 3, 64, 64)


def test_pixels_of_the_right_size_stay_bit_by_bit_as_they_are(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    for t, frame in enumerate(frames):
        Image.fromarray(frame).save(tmp_path / f"{t}.png")
    episode = episode_from_images(tmp_path, **arrays(2))
    assert torch.equal(episode["pixels"], torch.tensor(frames[:2]).movedim(-1, 1))
    assert torch.equal(episode["next", "pixels"], torch.tensor(frames[1:]).movedim(-1, 1))


def test_squash_keeps_the_margin_and_crop_keeps_the_proportions(tmp_path):
    wide = np.zeros((60, 120, 3), dtype=np.uint8)
    wide[:, :20], wide[20:40, 50:70] = (255, 0, 0), (0, 255, 0)  # a red margin, a green square of 20 in the middle
    for t in range(3):
        Image.fromarray(wide).save(tmp_path / f"{t}.png")
    squashed, cropped = (episode_from_images(tmp_path, **arrays(2), fit=fit) for fit in ("squash", "crop"))
    assert squashed["pixels"][0, 0, 32, 0] == 255
    assert not cropped["pixels"][0, 0].any()
    green = (cropped["pixels"][0, 1] > 127).nonzero()
    assert (green.amax(0) - green.amin(0) + 1).tolist() in ([21, 21], [22, 22], [20, 20])
    green = (squashed["pixels"][0, 1] > 127).nonzero()
    height, width = (green.amax(0) - green.amin(0) + 1).tolist()
    assert 1.8 < height / width < 2.3


def test_sizes_and_keys_of_ones_own(tmp_path):
    keys = EpisodeKeys(observation=("camera", "image"))
    episode = episode_from_images(fill(tmp_path / "run"), **arrays(), size=(32, 48), keys=keys)
    assert episode["camera", "image"].shape == (T, 3, 32, 48)


def test_an_image_is_turned_as_the_camera_was_held(tmp_path):
    picture = np.zeros((8, 64, 3), dtype=np.uint8)
    picture[:, :32] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # turn clockwise by a quarter
    for t in range(2):
        Image.fromarray(picture).save(tmp_path / f"{t}.png", exif=exif)
    pixels = episode_from_images(tmp_path, **arrays(1))["pixels"][0, 0]
    assert pixels[:30].min() == 255
    assert pixels[34:].max() == 0


def test_one_image_more_than_actions_is_needed(tmp_path):
    folder = fill(tmp_path / "run", T)
    with pytest.raises(ValueError, match=r"run has 10 images \(img_0.png to img_9.png\) for 10 actions.*must be 11"):
        episode_from_images(folder, **arrays())
    with pytest.raises(ValueError, match=r"The list of images has 0 images for 10 actions"):
        episode_from_images([], **arrays())


def test_folders_without_images_say_what_they_hold(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no image: none of .bmp.*Give another one"):
        episode_from_images(tmp_path, **arrays())
    fill(tmp_path / "episode_2")
    fill(tmp_path / "episode_10")
    with pytest.raises(FileNotFoundError, match=r"\['episode_2', 'episode_10'\]: give one of them"):
        episode_from_images(tmp_path, **arrays())
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        episode_from_images(tmp_path / "nowhere", **arrays())
    with pytest.raises(FileNotFoundError, match=r"img_0.png is a file. Give a folder"):
        episode_from_images(tmp_path / "episode_2" / "img_0.png", **arrays())
    with pytest.raises(FileNotFoundError, match=r"nothing\.png is no file"):
        episode_from_images(["nothing.png", "more.png"], **arrays(1))


def test_images_of_another_size_among_them_are_refused(tmp_path):
    folder = fill(tmp_path / "run")
    Image.new("RGB", (32, 24)).save(folder / "img_4.png")
    with pytest.raises(ValueError, match=r"img_4.png has 32 x 24 pixels, where img_0.png has 64 x 64"):
        episode_from_images(folder, **arrays())


def test_files_that_are_no_images_are_named(tmp_path):
    folder = fill(tmp_path / "run")
    whole = (folder / "img_4.png").read_bytes()
    for content in (b"", b"text", whole[:60]):
        (folder / "img_4.png").write_bytes(content)
        with pytest.raises(ValueError, match=r"img_4.png cannot be read as an image"):
            episode_from_images(folder, **arrays())


def test_sixteen_bits_are_refused_for_nobody_knows_what_is_white(tmp_path):
    for t in range(2):
        Image.fromarray(np.full((64, 64), 1000, dtype=np.uint16)).save(tmp_path / f"{t}.png")
    with pytest.raises(ValueError, match=r"0.png has pixels of kind 'I;16'.*8 bits"):
        episode_from_images(tmp_path, **arrays(1))


@pytest.mark.parametrize(
    ("options", "message"),
    [({"size": 0}, "size must be a positive"), ({"size": 2.5}, "size must"), ({"fit": "pad"}, "'squash', 'crop'")],
)
def test_settings_are_checked_before_anything_is_read(options, message):
    with pytest.raises(ValueError, match=message):
        episode_from_images("nowhere", **arrays(), **options)


@pytest.mark.parametrize(
    ("shape", "options", "expected"),
    [
        ((48, 64, 3), {}, [3, 64, 64]),
        ((48, 64), {}, [3, 64, 64]),
        ((64, 64, 1), {}, [3, 64, 64]),
        ((3, 48, 64), {"channels": "first"}, [3, 64, 64]),
        ((5, 48, 64, 9), {}, [5, 9, 64, 64]),
        ((5, 6, 48, 64), {"channels": "first", "size": (32, 16)}, [5, 6, 32, 16]),
        ((2, 2, 3), {"fit": "crop"}, [3, 64, 64]),
    ],
)
def test_arrays_of_images_of_all_kinds(shape, options, expected):
    out = pixels_from_images(np.zeros(shape, dtype=np.uint8), **options)
    assert list(out.shape) == expected
    assert out.dtype == torch.uint8


def test_stacked_frames_are_resized_one_by_one():
    stacked = np.random.default_rng(0).integers(0, 256, (48, 96, 6), dtype=np.uint8)
    one, two = pixels_from_images(stacked[..., :3]), pixels_from_images(stacked[..., 3:])
    assert torch.equal(pixels_from_images(stacked), torch.cat([one, two]))


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (np.zeros((3, 64, 64), dtype=np.uint8), r"got \[3, 64, 64\]. Their channels seem to come first"),
        (np.zeros((3, 96, 96), dtype=np.uint8), "channels='first'"),
        (np.zeros((64, 64, 4), dtype=np.uint8), r"images\[..., :3\] without transparency"),
        (np.zeros(64, dtype=np.uint8), r"got \[64\]"),
        (np.zeros((0, 64, 64, 3), dtype=np.uint8), r"got \[0, 64, 64, 3\]"),
    ],
)
def test_other_shapes_are_refused(images, message):
    with pytest.raises(ValueError, match=message):
        pixels_from_images(images)


def test_channels_last_are_not_taken_for_first():
    with pytest.raises(ValueError, match=r"got \[64, 64, 3\]. Their channels seem to come last"):
        pixels_from_images(np.zeros((64, 64, 3), dtype=np.uint8), channels="first")
    with pytest.raises(TypeError, match=r"must be uint8 in 0\.\.255, got float64"):
        pixels_from_images(np.zeros((64, 64, 3)))
