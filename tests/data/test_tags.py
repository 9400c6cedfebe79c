import pytest

from ls3_torchrl.data import ALL_TAGS, VALUE_TAGS, Tag


@pytest.mark.parametrize("value", ["constraint", "CONSTRAINT", 2, Tag.CONSTRAINT])
def test_parse_takes_name_number_or_tag(value):
    assert Tag.parse(value) is Tag.CONSTRAINT


@pytest.mark.parametrize("value", ["demo", 4, -1, ""])
def test_parse_names_the_known_tags_when_it_refuses(value):
    with pytest.raises(ValueError, match="'success', 'rand', 'constraint', 'online'"):
        Tag.parse(value)


def test_numbers_on_disk_never_move():
    assert [(tag.name, int(tag)) for tag in ALL_TAGS] == [
        ("SUCCESS", 0),
        ("RAND", 1),
        ("CONSTRAINT", 2),
        ("ONLINE", 3),
    ]


def test_values_learn_from_demonstrations_and_online_episodes_only():
    assert set(VALUE_TAGS) == {Tag.SUCCESS, Tag.ONLINE}
