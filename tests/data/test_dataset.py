import json

import pytest
import torch
from tensordict import TensorDict

from ls3_torchrl.data import Tag, check_episodes, load_episodes, save_episodes


def episodes(n=2, t=3):
    flags = {k: torch.rand(n, t, 1) > 0.5 for k in ("constraint", "success")}
    pixels = torch.randint(256, (n, t, 3, 64, 64), dtype=torch.uint8)
    return TensorDict(
        {
            "pixels": pixels,
            "action": torch.randn(n, t, 2),
            "next": {"pixels": pixels.flip(1), "reward": torch.randn(n, t, 1), **flags},
        },
        [n, t],
    )


def test_round_trip_is_exact(tmp_path):
    torch.manual_seed(0)
    written = {Tag.SUCCESS: episodes(2, 3), Tag.CONSTRAINT: episodes(1, 4)}
    folder = save_episodes(written, tmp_path / "demos", task="navigation", seed=5)
    read = load_episodes(folder, task="navigation")
    assert list(read) == [Tag.SUCCESS, Tag.CONSTRAINT]
    for tag, there in written.items():
        assert read[tag].batch_size == there.batch_size
        assert (read[tag] == there).all()
        assert read[tag]["pixels"].dtype == torch.uint8
    description = json.loads((folder / "episodes.json").read_text())
    assert description["seed"] == 5
    assert description["episodes"] == {"success": [2, 3], "constraint": [1, 4]}


def test_an_existing_folder_is_never_written_into(tmp_path):
    with pytest.raises(FileExistsError, match="exists already"):
        save_episodes({Tag.RAND: episodes()}, tmp_path, task="navigation", seed=0)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_when_one_set_is_faulty(tmp_path):
    faulty = episodes()
    faulty["action"][0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="constraint: action is not finite"):
        save_episodes({Tag.SUCCESS: episodes(), Tag.CONSTRAINT: faulty}, tmp_path / "demos", task="x", seed=0)
    assert not (tmp_path / "demos").exists()


def test_a_folder_without_description_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no episodes.*collect\.py"):
        load_episodes(tmp_path)


def test_episodes_of_another_task_are_refused(tmp_path):
    folder = save_episodes({Tag.RAND: episodes(1, 1)}, tmp_path / "demos", task="navigation", seed=0)
    with pytest.raises(ValueError, match="'navigation', but 'reacher' is wanted"):
        load_episodes(folder, task="reacher")


@pytest.mark.parametrize(("key", "value"), [("version", 99), ("format", "other")])
def test_another_format_or_version_is_refused(tmp_path, key, value):
    folder = save_episodes({Tag.RAND: episodes(1, 1)}, tmp_path / "demos", task="navigation", seed=0)
    path = folder / "episodes.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(ValueError, match=f"{value}.*Collect again"):
        load_episodes(folder)


@pytest.mark.parametrize(
    "key", ["pixels", "action", *(("next", k) for k in ("pixels", "reward", "constraint", "success"))]
)
def test_a_missing_key_is_named(key):
    with pytest.raises(KeyError, match=key if isinstance(key, str) else key[1]):
        check_episodes(episodes().exclude(key))


def test_one_dimension_is_not_a_set_of_episodes():
    with pytest.raises(ValueError, match=r"demos must have batch size \[N, T\], got \[3\]"):
        check_episodes(episodes()[0], name="demos")


@pytest.mark.parametrize("key", ["pixels", ("next", "pixels")])
def test_images_must_be_bytes_of_the_right_size(key):
    floats = episodes()
    floats[key] = floats[key] / 255.0
    with pytest.raises(TypeError, match="must be uint8"):
        check_episodes(floats)
    small = episodes()
    small[key] = small[key][..., :32, :32]
    with pytest.raises(ValueError, match=r"\[N, T, C, 64, 64\], got \[2, 3, 3, 32, 32\]"):
        check_episodes(small)


@pytest.mark.parametrize("key", ["action", ("next", "reward")])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_numbers_must_be_finite(key, bad):
    faulty = episodes()
    faulty[key][1, 2] = bad
    with pytest.raises(ValueError, match="is not finite"):
        check_episodes(faulty)
