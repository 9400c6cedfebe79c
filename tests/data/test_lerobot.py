"""Against a small dataset that LeRobot's own writer has made: ``lerobot_v3/README.md``."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from ls3_torchrl.data import (
    DataWarning,
    EpisodeKeys,
    Tag,
    TaggedReplayBuffer,
    check_datasets,
    load_lerobot,
    pixels_from_images,
)

WRITTEN = Path(__file__).with_name("lerobot_v3")
LENGTHS = (5, 4)
LABELS = {"constraint": lambda columns: columns["force"] > 3}
STATE = EpisodeKeys(observation="state")


def picture(episode, frame, camera):
    """What the dataset was written with; 0 for the camera at the top, 1 for that at the wrist."""
    y, x = np.mgrid[0:72, 0:96]
    out = np.zeros((72, 96, 3))
    out[..., 0] = 40 + 40 * frame
    out[..., 1] = 255 * x / 95 if camera == 0 else 255 * y / 71
    out[..., 2] = 60 + 120 * episode
    return out.astype(np.uint8)


def frames(row, key="pixels"):
    return torch.cat([row[key], row["next", key][-1:]])


@pytest.fixture
def folder(tmp_path):
    """A copy that a test may damage."""
    return Path(shutil.copytree(WRITTEN, tmp_path / "robot"))


def rewritten(folder, **changes):
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return folder


def changed_columns(folder, **columns):
    """With other values in the data."""
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(path)
    for name, values in columns.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    pq.write_table(table, path)
    return folder


@pytest.mark.parametrize(("camera", "tolerance"), [("top", 6.0), ("observation.images.wrist", 0.0)])
@pytest.mark.parametrize("fit", ["squash", "crop"])
def test_images_of_videos_and_of_tables_are_those_that_were_written(camera, tolerance, fit):
    read = load_lerobot(WRITTEN, camera=camera, fit=fit, **LABELS)
    assert {tag: [len(row) for row in rows.unbind(0)] for tag, rows in read.items()} == {
        Tag.SUCCESS: [4],
        Tag.CONSTRAINT: [3],
    }
    for number, row in enumerate((read[Tag.SUCCESS][0], read[Tag.CONSTRAINT][0])):
        pictures = [picture(number, frame, int("wrist" in camera)) for frame in range(LENGTHS[number])]
        written = torch.stack([pixels_from_images(each, fit=fit) for each in pictures])
        # A frame beside the right one differs by 40 in red, one of the other episode by 120 in blue.
        error = (frames(row).int() - written.int()).abs().float()
        assert error.flatten(2).mean(-1).max() <= tolerance
        assert row["pixels"].dtype == torch.uint8


def test_actions_rewards_and_labels_are_those_of_the_steps_that_were_seen():
    read = load_lerobot(WRITTEN, camera="wrist", **LABELS, extra={"state": "observation.state"})
    first, second = read[Tag.SUCCESS][0], read[Tag.CONSTRAINT][0]
    torch.testing.assert_close(first["action"], torch.tensor([[0.1 * t, 0.0] for t in range(4)]))
    assert first["next", "success"].flatten().tolist() == [False, False, False, True]
    assert first["next", "reward"].flatten().tolist() == [-1, -1, -1, 0]
    assert first["next", "state"][:, 1].tolist() == [1, 2, 3, 4]
    # The force of the second frame belongs to the state that the first action led to.
    assert second["next", "constraint"].flatten().tolist() == [True, False, False]
    check_datasets(read)
    buffer = TaggedReplayBuffer(100, latent_dim=4, extra_keys=["state"])
    for tag, episodes in read.items():
        buffer.add(episodes, tag)
    assert len(buffer) == 7


def test_the_last_action_can_be_kept_with_the_last_image_twice():
    read = load_lerobot(WRITTEN, camera="wrist", **LABELS, last="repeat", extra={"state": "observation.state"})
    row = read[Tag.SUCCESS][0]
    assert len(row) == 5
    for key in ("pixels", "state"):
        assert torch.equal(row["next", key][-1], row[key][-1])
    assert row["action"][-1, 0] == pytest.approx(0.4)
    assert row["next", "success"].flatten().tolist() == [False, False, False, True, True]


def test_a_success_that_only_the_dropped_action_tells_of_is_warned_of(folder):
    only_last = [False] * 4 + [True] + [False] * 3 + [True]
    changed_columns(folder, **{"next.success": only_last, "next.reward": [s - 1.0 for s in only_last]})
    with pytest.warns(DataWarning, match=r"the only success of episodes \[0, 1\] \(2 in all\).*last='repeat'"):
        read = load_lerobot(folder, camera="wrist", constraint=False)
    assert list(read) == [Tag.RAND]
    assert list(load_lerobot(folder, camera="wrist", constraint=False, last="repeat")) == [Tag.SUCCESS]


def test_states_alone_need_no_image_and_sources_are_names_functions_or_answers():
    options = {"camera": "observation.state", "keys": STATE, "constraint": False}
    read = load_lerobot(WRITTEN, **options, reward=lambda columns: columns["next.success"] - 1.0, tag="online")
    assert [tuple(row["state"].shape) for row in read[Tag.ONLINE].unbind(0)] == [(4, 3), (3, 3)]
    one = load_lerobot(WRITTEN, **options, action="observation.state", episodes=[1])[Tag.SUCCESS][0]
    assert one["action"][:, 1].tolist() == [1, 2, 3]
    assert list(load_lerobot(WRITTEN, **options, tag=lambda columns: "rand")) == [Tag.RAND]
    small = load_lerobot(WRITTEN, camera="top", constraint=False, size=(32, 48), keys=STATE, episodes=[0])
    assert small[Tag.SUCCESS]["state"].shape == (1, 4, 3, 32, 48)


def test_the_older_layout_is_read_too(tmp_path):
    """Version 2.1 has a file for each episode, and lists them in lines of JSON."""
    info = json.loads((WRITTEN / "meta" / "info.json").read_text())
    info["codebase_version"], info["chunks_size"] = "v2.1", 1
    info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    table = pq.read_table(WRITTEN / "data" / "chunk-000" / "file-000.parquet")
    lines, start = [], 0
    for number, length in enumerate(LENGTHS):
        path = tmp_path / info["data_path"].format(episode_chunk=number, episode_index=number)
        path.parent.mkdir(parents=True)
        pq.write_table(table.slice(start, length), path)
        lines.append(json.dumps({"episode_index": number, "tasks": ["push"], "length": length}))
        start += length
    (tmp_path / "meta" / "episodes.jsonl").write_text("\n".join(lines) + "\n")
    old, new = (load_lerobot(each, camera="wrist", **LABELS) for each in (tmp_path, WRITTEN))
    assert list(old) == list(new)
    for tag in new:
        assert (old[tag] == new[tag]).all()


def test_discrete_actions_and_single_ones_have_one_column(folder):
    changed_columns(folder, action=np.arange(9, dtype=np.float32))
    info = json.loads((folder / "meta" / "info.json").read_text())
    info["features"]["action"]["shape"] = [1]
    read = load_lerobot(rewritten(folder, features=info["features"]), camera="wrist", **LABELS)
    assert read[Tag.CONSTRAINT]["action"].flatten().tolist() == [5, 6, 7]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"camera": None}, KeyError, r"has 2 cameras: observation.images.top, observation.images.wrist"),
        ({"camera": "side"}, KeyError, r"has no camera 'side'. Its columns are: observation.images.top"),
        ({"constraint": None}, KeyError, r"Episode 0 of .* its constraint.*constraint=False where it never is"),
        ({"constraint": "force"}, ValueError, "must hold bools, or 0 and 1; got 1.0|got 5.0"),
        ({"constraint": "forces"}, KeyError, "has no entry 'forces'.*'?force'?"),
        ({"action": lambda columns: columns["action"] / 0}, ValueError, "action is not finite"),
        ({"episodes": [2]}, ValueError, "has no episode 2: its 2 are 0 to 1"),
        ({"last": "keep"}, ValueError, "'drop', 'repeat'"),
        ({"size": 0}, ValueError, "size must be"),
        ({"fit": "pad"}, ValueError, "fit must be"),
        ({"keys": EpisodeKeys(observation="pixels"), "camera": "observation.state"}, ValueError, r"C, 64, 64\]"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero:RuntimeWarning", "ignore:invalid value:RuntimeWarning")
def test_what_cannot_be_understood_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        load_lerobot(WRITTEN, **({"camera": "wrist"} | LABELS | options))


def test_an_episode_of_one_frame_leads_nowhere(folder):
    path = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.column_names.index("length"), "length", pa.array([1, 4])), path)
    data = folder / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(data)
    pq.write_table(pa.concat_tables([table.slice(0, 1), table.slice(5)]), data)
    with pytest.raises(ValueError, match=r"Episode 0 of .* has one frame.*last='repeat'"):
        load_lerobot(folder, camera="wrist", **LABELS)
    with pytest.warns(DataWarning, match="recorded rewards"):
        changed = load_lerobot(folder, camera="wrist", constraint=False, success=False, last="repeat")
    assert sorted(len(row) for row in changed[Tag.RAND].unbind(0)) == [1, 4]


def test_damaged_and_missing_files_are_named(folder):
    with pytest.raises(FileNotFoundError, match=r"holds no LeRobot dataset: .*info.json is missing"):
        load_lerobot(folder / "data")
    for version in ("v1.6", None, "v4.0"):
        with pytest.raises(ValueError, match=rf"version {version!r}; v2.0, v2.1, v3.0 are read"):
            load_lerobot(rewritten(folder, codebase_version=version))
    rewritten(folder, codebase_version="v3.0")
    for fps in (0, None, "ten", float("nan")):
        with pytest.raises(ValueError, match="frames there are in a second"):
            load_lerobot(rewritten(folder, fps=fps))
    rewritten(folder, fps=10)
    with pytest.raises(ValueError, match="describes no features"):
        load_lerobot(rewritten(folder, features=[]))


@pytest.mark.parametrize(
    "told", ["../../secret.parquet", "/etc/{chunk_index}", "{nowhere}", "{chunk_index.real.x}", None]
)
def test_paths_that_lead_out_of_the_folder_are_refused(folder, told):
    with pytest.raises((ValueError, FileNotFoundError), match=r"outside of it|does not say where|is missing"):
        load_lerobot(rewritten(folder, data_path=told), camera="wrist", **LABELS)


def test_videos_that_are_cut_off_or_lack_frames_are_refused(folder):
    video = folder / "videos" / "observation.images.top" / "chunk-000" / "file-000.mp4"
    whole = video.read_bytes()
    for content in (b"", b"no video", whole[: len(whole) // 2]):
        video.write_bytes(content)
        with pytest.raises(ValueError, match=r"cannot be read as a video|has no frame within"):
            load_lerobot(folder, camera="top", **LABELS)
    video.write_bytes(whole)
    times = [0.0, 0.1, 0.2, 0.3, 0.4, 0.0, 0.1, 0.2, 0.9]  # the last one lies behind the video's end
    with pytest.raises(ValueError, match=r"no frame within 0.04 s of 1.4 s"):
        load_lerobot(changed_columns(folder, timestamp=np.array(times, dtype=np.float32)), camera="top", **LABELS)
    video.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1530\n")
    with pytest.raises(ValueError, match=r"file-000.mp4 is a pointer of Git LFS.*git lfs pull"):
        load_lerobot(folder, camera="top", **LABELS)
    video.unlink()
    with pytest.raises(FileNotFoundError, match=r"file-000.mp4 of episode 0 is missing"):
        load_lerobot(folder, camera="top", **LABELS)


def test_tables_with_fewer_frames_than_promised_are_refused(folder):
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    pq.write_table(pq.read_table(path).slice(0, 7), path)
    with pytest.raises(ValueError, match="holds 2 frames of episode 1, where meta promises 4"):
        load_lerobot(folder, camera="wrist", **LABELS)
    path.write_bytes(b"PAR1 no table")
    with pytest.raises(ValueError, match=r"file-000.parquet cannot be read"):
        load_lerobot(folder, camera="wrist", **LABELS)
    pq.write_table(pq.read_table(WRITTEN / "data/chunk-000/file-000.parquet").drop_columns("frame_index"), path)
    with pytest.raises(ValueError, match=r"lacks the columns \['frame_index'\]"):
        load_lerobot(folder, camera="wrist", **LABELS)
    listed = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    pq.write_table(pa.table({"number": [0, 1]}), listed)
    with pytest.raises(ValueError, match=r"file-000.parquet does not list episodes"):
        load_lerobot(folder, camera="wrist", **LABELS)
    shutil.rmtree(folder / "meta" / "episodes")
    with pytest.raises(FileNotFoundError, match="does not list the episodes"):
        load_lerobot(folder, camera="wrist", **LABELS)
