import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from ls3_torchrl.data import RowSelection, Tag, TagSampler


def rows(tags, first=0):
    n = len(tags)
    return TensorDict(
        {"tag": torch.tensor(tags, dtype=torch.uint8).unsqueeze(-1), "id": first + torch.arange(n).unsqueeze(-1)}, [n]
    )


def buffer_of(tags, wanted, capacity=64):
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), sampler=TagSampler(RowSelection(tags=wanted)))
    buffer.extend(rows(tags))
    return buffer


def test_draws_uniformly_from_a_union_however_uneven_its_parts():
    torch.manual_seed(0)
    # 1 success and 9 constraint rows among 30: every one of the ten is due one tenth of the draws.
    tags = [1] * 10 + [0] + [3] * 10 + [2] * 9
    buffer = buffer_of(tags, ["success", "constraint"])
    drawn = buffer.sample(20_000)["id"].flatten()
    counts = torch.bincount(drawn, minlength=30)
    wanted = [i for i, tag in enumerate(tags) if tag in (0, 2)]
    assert counts.nonzero().flatten().tolist() == wanted
    # Binomial: 2000 expected, standard deviation 42.
    assert (counts[wanted] - 2000).abs().max() < 5 * 42


def test_rows_are_the_indices_of_the_tags():
    buffer = buffer_of([0, 1, 2, 3, 0], [Tag.SUCCESS, "online"])
    assert buffer.sampler.rows(buffer.storage).tolist() == [0, 3, 4]


@pytest.mark.parametrize("tags", [[], [0, 0, 3]])
def test_a_tag_without_rows_says_which_and_what_to_do(tags):
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(8), sampler=TagSampler(RowSelection(tags=["constraint", "rand"]))
    )
    if tags:
        buffer.extend(rows(tags))
    with pytest.raises(RuntimeError, match=rf"{len(tags)} rows.*'rand', 'constraint'.*Collect"):
        buffer.sampler.sample(buffer.storage, 2)


def test_rows_that_say_so_are_left_out():
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(8), sampler=TagSampler(RowSelection(tags=["success"], without="after_violation"))
    )
    after = torch.tensor([False, True, False, False]).unsqueeze(-1)
    buffer.extend(rows([0, 0, 1, 0]).set("after_violation", after))
    assert buffer.sampler.rows(buffer.storage).tolist() == [0, 3]


def test_no_tag_at_all_is_refused():
    with pytest.raises(ValueError, match="at least one tag"):
        RowSelection(tags=[])


def test_unknown_tag_is_refused():
    with pytest.raises(ValueError, match="Unknown tag 'demo'"):
        RowSelection(tags=["demo"])


def test_rows_written_after_a_draw_are_found():
    buffer = buffer_of([0, 1], ["success"])
    assert set(buffer.sample(50)["id"].flatten().tolist()) == {0}
    buffer.extend(rows([1, 0], first=2))
    assert set(buffer.sample(200)["id"].flatten().tolist()) == {0, 3}
    buffer.add(rows([0], first=4)[0])
    assert set(buffer.sample(200)["id"].flatten().tolist()) == {0, 3, 4}


def test_rows_overwritten_by_another_tag_are_dropped():
    buffer = buffer_of([0, 0, 1], ["success"], capacity=3)
    buffer.sample(4)
    buffer.extend(rows([1], first=3))  # the ring writes over row 0
    assert set(buffer.sample(100)["id"].flatten().tolist()) == {1}


def test_relabelled_rows_are_seen_after_refresh():
    buffer = buffer_of([0, 1], ["success"])
    buffer.sample(4)
    buffer.storage[:]["tag"][1] = int(Tag.SUCCESS)
    buffer.sampler.refresh()
    assert buffer.sampler.rows(buffer.storage).tolist() == [0, 1]


def test_nested_tag_key():
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(8), sampler=TagSampler(RowSelection(tags=["rand"]), tag_key=("meta", "tag"))
    )
    buffer.extend(TensorDict({"meta": {"tag": torch.tensor([[0], [1]], dtype=torch.uint8)}}, [2]))
    assert buffer.sample(3)["meta", "tag"].flatten().tolist() == [1, 1, 1]


def fractions(buffer, count=400):
    """Fraction of each of the first four tags in a draw."""
    return (torch.bincount(buffer.sample(count)["tag"].flatten().long(), minlength=4) / count).tolist()


def buffer_with_fraction(tags, fraction, wanted=("success", "rand", "online")):
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(256), sampler=TagSampler(RowSelection(tags=wanted, online_fraction=fraction))
    )
    buffer.extend(rows(tags))
    return buffer


def test_few_online_rows_have_their_fraction_and_the_others_stay_uniform():
    torch.manual_seed(0)
    buffer = buffer_with_fraction([0] * 60 + [1] * 30 + [3] * 10, fraction=0.5)
    success, rand, constraint, online = fractions(buffer, 30_000)
    assert online == 0.5
    assert constraint == 0.0
    assert abs(success - 2 * rand) < 0.02  # 60 rows to 30
    drawn = buffer.sample(30_000)["id"].flatten()
    counts = torch.bincount(drawn, minlength=100)
    assert (counts[:90] - 167).abs().max() < 5 * 13  # binomial: 15,000 over 90 rows
    assert (counts[90:] - 1500).abs().max() < 5 * 39


@pytest.mark.parametrize(("tags", "online"), [([0] * 10, 0.0), ([3] * 10, 1.0), ([0] * 10 + [3] * 90, 0.9)])
def test_none_and_many_online_rows_are_drawn_as_they_are(tags, online):
    torch.manual_seed(0)
    assert abs(fractions(buffer_with_fraction(tags, fraction=0.5), 10_000)[3] - online) < 0.02


def test_the_fraction_follows_rows_that_come_later():
    buffer = buffer_with_fraction([0] * 90, fraction=0.25)
    assert fractions(buffer)[3] == 0.0
    buffer.extend(rows([3] * 3, first=90))
    assert fractions(buffer)[3] == 0.25
    buffer.extend(rows([3] * 150, first=93))
    assert fractions(buffer)[3] > 0.5


@pytest.mark.parametrize("fraction", [-0.1, 1.0])
def test_impossible_fractions_are_refused(fraction):
    with pytest.raises(ValueError, match=rf"online_fraction must be in \[0, 1\), got {fraction}"):
        RowSelection(tags=["online"], online_fraction=fraction)
