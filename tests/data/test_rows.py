import pytest
import torch
from tensordict import NonTensorData, TensorDict

from ls3_torchrl.data import EpisodeKeys, Tag
from ls3_torchrl.data.rows import OWN_KEYS, episode_rows, require_free, tag_of


def test_rows_hold_the_labels_that_an_episode_has_under_its_own_keys():
    keys = EpisodeKeys("o", "a", ("next", "deep", "r"), "hit", ("next", "there"))
    success = torch.tensor([[False], [True], [False]])
    hit = torch.tensor([[True], [False], [False]])
    episode = TensorDict({"a": torch.rand(3, 2), "hit": hit, "x": torch.rand(3, 4), "next": {"there": success}}, [3])
    episode["next", "deep", "r"] = success.float() - 1
    posteriors = TensorDict({"loc": torch.arange(8.0).reshape(4, 2), "scale": -torch.arange(8.0).reshape(4, 2)}, [4])
    rows = episode_rows(episode, posteriors, Tag.RAND, keys=keys, extra_keys=["x"], gamma=0.5)
    for key in (keys.action, keys.reward, keys.constraint, keys.success, "x"):
        assert torch.equal(rows[key], episode[key])
    assert rows["tag"].tolist() == [[1], [1], [1]]
    assert rows["in_success"].flatten().tolist() == [True, True, False]
    assert rows["after_violation"].flatten().tolist() == [False, True, True]
    assert not rows["timed_out"].any()
    assert rows["reward_to_go"].flatten().tolist() == [-1.25, -0.5, -1.0]
    assert rows["steps_left"].flatten().tolist() == [3, 2, 1]
    for name in ("loc", "scale"):
        assert torch.equal(rows[name], posteriors[name][:3])
        assert torch.equal(rows["next", name], posteriors[name][1:])
    assert set(rows.keys(True, True)) - {*keys.required, "x"} <= OWN_KEYS


def test_keys_of_the_rows_own_are_refused():
    require_free(["action", ("next", "reward"), ("deep", "loc")])
    with pytest.raises(ValueError, match=r"keys \['tag'\] are the buffer's own"):
        require_free(["action", "tag"])


@pytest.mark.parametrize(
    ("value", "tag"),
    [
        (torch.full((3, 1), 2, dtype=torch.uint8), Tag.CONSTRAINT),
        (torch.zeros(3, dtype=torch.int64), Tag.SUCCESS),
        (NonTensorData("rand", batch_size=[3]), Tag.RAND),
        (None, Tag.ONLINE),
    ],
)
def test_an_episode_tells_its_tag(value, tag):
    episode = TensorDict({"action": torch.zeros(3, 1)}, [3])
    if value is not None:
        episode["tag"] = value
    assert tag_of(episode) is tag


def test_one_episode_has_one_known_tag():
    episode = TensorDict({"tag": torch.tensor([0, 0, 3])}, [3])
    with pytest.raises(ValueError, match=r"one tag, got \[0, 3\]"):
        tag_of(episode)
    with pytest.raises(ValueError, match="Unknown tag 9"):
        tag_of(TensorDict({"tag": torch.tensor([9])}, [1]))
