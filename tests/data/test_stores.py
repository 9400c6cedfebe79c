import io

import pytest
import torch
from tensordict import NonTensorData, TensorDict

from ls3_torchrl.data.stores import RowStore


def rows(first, count):
    return TensorDict({"deep": {"x": torch.arange(first, first + count).unsqueeze(-1)}}, [count])


def content(store):
    return store.storage[:]["deep", "x"].flatten().tolist()


@pytest.fixture(params=["memory", "memmap"])
def make(request, tmp_path):
    numbers = iter(range(99))

    def store(capacity, folder=None):
        if request.param == "memory":
            return RowStore(capacity)
        return RowStore(capacity, folder=folder or tmp_path / str(next(numbers)))

    return store


@pytest.mark.parametrize(("written", "expected"), [(3, [0, 1, 2]), (5, [0, 1, 2, 3, 4]), (8, [3, 4, 5, 6, 7])])
def test_rows_keep_their_order_and_the_ring_goes_on_when_it_has_grown(make, written, expected):
    store = make(5)
    for i in range(written):
        store.extend(rows(i, 1))
    store.grow(7)
    assert content(store) == expected
    assert (store.capacity, store.write_count, len(store)) == (7, written, len(expected))
    store.extend(rows(written, 4))
    whole = (expected + list(range(written, written + 4)))[-7:]
    assert sorted(content(store)) == whole
    assert store.sample(50)["deep", "x"].max() == written + 3


def test_an_empty_store_can_grow(make):
    store = make(2)
    store.grow(3)
    store.extend(rows(0, 3))
    assert content(store) == [0, 1, 2]


def test_a_grown_memory_map_leaves_no_second_copy(tmp_path):
    store = RowStore(1000, folder=tmp_path / "store")
    store.extend(rows(0, 1000))
    store.grow(1500)
    files = list(tmp_path.rglob("x.memmap"))
    assert [file.stat().st_size for file in files] == [1500 * 8]


@pytest.mark.parametrize("written", [0, 3, 8])
@pytest.mark.parametrize("way", ["state_dict", "dumps"])
def test_a_restored_store_draws_and_goes_on_alike(make, tmp_path, written, way):
    store, other = make(5), make(5)
    other.extend(rows(100, 4))  # goes away
    if written:
        store.extend(rows(0, 3))
    for i in range(3, written):
        store.extend(rows(i, 1))
    if way == "dumps":
        store.dumps(tmp_path / "dump")
        other.loads(tmp_path / "dump")
    else:
        file = io.BytesIO()
        torch.save(store.state_dict(), file)
        file.seek(0)
        other.load_state_dict(torch.load(file, weights_only=True))
    for _ in range(2):
        assert len(other) == len(store)
        if len(store):
            assert content(other) == content(store)
            one, two = (torch.manual_seed(3) and ring.sample(20) for ring in (store, other))
            assert torch.equal(one["deep", "x"], two["deep", "x"])
            assert torch.equal(one["index"], two["index"])
        for ring in (store, other):
            ring.extend(rows(written, 2))
    assert other.write_count == store.write_count == written + 4


def test_a_state_is_a_copy_without_the_unused_room():
    store = RowStore(1000)
    store.extend(rows(0, 2))
    state = store.state_dict()
    store.storage[:]["deep", "x"].fill_(9)
    assert state["rows"]["deep"]["x"].flatten().tolist() == [0, 1]
    assert state["rows"]["deep"]["x"].untyped_storage().nbytes() == 16


def test_a_dump_takes_the_place_of_an_earlier_one_and_of_nothing_else(tmp_path):
    store = RowStore(5)
    store.extend(rows(0, 4))
    store.dumps(tmp_path / "dump")
    store.extend(rows(4, 1))
    store.dumps(tmp_path / "dump")
    other = RowStore(5)
    other.loads(tmp_path / "dump")
    assert content(other) == [0, 1, 2, 3, 4]
    (tmp_path / "diary").mkdir()
    (tmp_path / "diary" / "today.txt").write_text("dear")
    with pytest.raises(FileExistsError, match="not a replay buffer's to remove"):
        store.dumps(tmp_path / "diary")
    with pytest.raises(FileExistsError, match="not a replay buffer's to remove"):
        RowStore(5, folder=tmp_path / "diary").extend(rows(0, 1))
    assert (tmp_path / "diary" / "today.txt").read_text() == "dear"


def test_a_folder_is_used_again_and_who_still_uses_it_keeps_its_rows(tmp_path):
    one, two = (RowStore(5, folder=tmp_path / "same") for _ in range(2))
    one.extend(rows(0, 3))
    two.extend(rows(10, 3))
    one.extend(rows(3, 1))
    assert content(one) == [0, 1, 2, 3]
    assert content(two) == [10, 11, 12]
    three = RowStore(9, folder=tmp_path / "same")
    three.extend(rows(20, 9))
    assert content(three) == list(range(20, 29))
    assert content(two) == [10, 11, 12]


def test_no_pickle_of_a_dump_is_run(tmp_path):
    store = RowStore(5)
    store.extend(rows(0, 3))
    store.dumps(tmp_path / "dump")
    TensorDict({"deep": NonTensorData("x")}).memmap(str(tmp_path / "odd"))
    (tmp_path / "odd" / "deep" / "other.pickle").write_bytes(b"not run")
    (tmp_path / "dump" / "rows").rename(tmp_path / "good")
    (tmp_path / "odd").rename(tmp_path / "dump" / "rows")
    with pytest.raises(ValueError, match=r"'deep' that is not an array.*Only arrays are read"):
        store.loads(tmp_path / "dump")
    assert content(store) == [0, 1, 2]


def test_a_store_first_written_in_inference_mode_can_be_written_outside_of_it(make):
    store = make(5)
    with torch.inference_mode():
        store.extend(rows(0, 2))
        store.extend(rows(2, 1))
    store.extend(rows(3, 1))
    store.storage[:]["deep", "x"].add_(1)
    assert content(store) == [1, 2, 3, 4]


def test_no_graph_is_stored(make):
    store, weight = make(5), torch.ones(1, requires_grad=True)
    for _ in range(2):
        store.extend(TensorDict({"x": weight * torch.ones(2, 1)}, [2]))
    assert not store.storage[:]["x"].requires_grad
