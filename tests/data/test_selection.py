import pytest

from ls3_torchrl.data import ALL_TAGS, RowSelection, Tag


def test_the_default_admits_everything():
    selection = RowSelection()
    assert (selection.tags, selection.without, selection.steps, selection.online_fraction) == (ALL_TAGS, None, None, 0)


def test_equal_selections_are_equal_however_they_are_written():
    one = RowSelection(tags=["online", Tag.SUCCESS, "SUCCESS"], without=("after_violation",))
    other = RowSelection(tags=(0, 3), without="after_violation")
    assert one == other
    assert hash(one) == hash(other)
    assert {one: 1}[other] == 1
    assert one.tags == (Tag.SUCCESS, Tag.ONLINE)


@pytest.mark.parametrize("tag", ["rand", Tag.RAND, 1])
def test_a_single_tag_stands_for_itself(tag):
    assert RowSelection(tags=tag).tags == (Tag.RAND,)


@pytest.mark.parametrize("change", [{"tags": ["rand"]}, {"without": "x"}, {"steps": 1}, {"online_fraction": 0.1}])
def test_selections_that_differ_are_different(change):
    assert RowSelection(**change) != RowSelection()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tags": []}, "at least one tag, got none. Choose from 'success'"),
        ({"tags": ["demo"]}, "Unknown tag 'demo'"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"online_fraction": 1.0}, r"online_fraction must be in \[0, 1\), got 1.0"),
        ({"online_fraction": -0.1}, r"online_fraction must be in \[0, 1\), got -0.1"),
    ],
)
def test_impossible_selections_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RowSelection(**options)


def test_a_selection_or_its_fields():
    selection = RowSelection(tags=["rand"], steps=3)
    assert RowSelection.of(None, {}) == RowSelection()
    assert RowSelection.of(None, {"tags": ["rand"], "steps": 3}) == selection
    assert RowSelection.of(selection, {}) is selection
    with pytest.raises(TypeError, match="not both"):
        RowSelection.of(selection, {"steps": 2})
    with pytest.raises(TypeError, match=r"Unknown filters \['share'\]. Known filters: tags, without, steps"):
        RowSelection.of(None, {"share": 0.5})
    with pytest.raises(TypeError, match="must be a RowSelection, got list"):
        RowSelection.of(["rand"], {})
