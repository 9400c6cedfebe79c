"""The data path: episodes and their keys, tags, labels, the two-store buffer, augmentation, files and other formats."""

from ls3_torchrl.data.augment import random_perspective
from ls3_torchrl.data.buffer import TaggedReplayBuffer
from ls3_torchrl.data.conform import check_datasets
from ls3_torchrl.data.dataset import check_episodes, load_episodes, save_episodes
from ls3_torchrl.data.episodes import episode_from_arrays, split_episodes, steps_into_violation
from ls3_torchrl.data.image_folders import episode_from_images
from ls3_torchrl.data.keys import EpisodeKeys
from ls3_torchrl.data.labels import (
    after_violation,
    in_success,
    length_without_idle_end,
    reward_to_go,
    timed_out,
)
from ls3_torchrl.data.lerobot import load_lerobot
from ls3_torchrl.data.minari import load_minari
from ls3_torchrl.data.minari_export import save_minari
from ls3_torchrl.data.pixels import pixels_from_images
from ls3_torchrl.data.sampler import TagSampler
from ls3_torchrl.data.selection import RowSelection
from ls3_torchrl.data.stream import BatchStream
from ls3_torchrl.data.tags import ALL_TAGS, VALUE_TAGS, Tag
from ls3_torchrl.exceptions import DataWarning

__all__ = [
    "ALL_TAGS",
    "VALUE_TAGS",
    "BatchStream",
    "DataWarning",
    "EpisodeKeys",
    "RowSelection",
    "Tag",
    "TagSampler",
    "TaggedReplayBuffer",
    "after_violation",
    "check_datasets",
    "check_episodes",
    "episode_from_arrays",
    "episode_from_images",
    "in_success",
    "length_without_idle_end",
    "load_episodes",
    "load_lerobot",
    "load_minari",
    "pixels_from_images",
    "random_perspective",
    "reward_to_go",
    "save_episodes",
    "save_minari",
    "split_episodes",
    "steps_into_violation",
    "timed_out",
]
