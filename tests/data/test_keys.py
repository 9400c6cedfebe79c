import dataclasses

import pytest

from ls3_torchrl.data import EpisodeKeys


def test_the_defaults_are_the_standard_keys():
    keys = EpisodeKeys()
    assert keys.required == (
        *("pixels", "action", ("next", "pixels")),
        *(("next", name) for name in ("reward", "constraint", "success")),
    )


def test_nested_keys_are_written_in_one_way_and_compare_equal():
    one = EpisodeKeys(observation=("agent", ("state",)), action=("agent", "action"))
    assert one == EpisodeKeys(observation=("agent", "state"), action=("agent", "action"))
    assert hash(one) == hash(EpisodeKeys(("agent", "state"), ("agent", "action")))
    assert one.next_observation == ("next", "agent", "state")
    assert EpisodeKeys(observation=("state",)).observation == "state"


@pytest.mark.parametrize("name", ["observation", "action"])
def test_what_belongs_to_the_step_itself_lies_outside_next(name):
    with pytest.raises(ValueError, match=rf"key of the {name} must not lie under 'next'"):
        EpisodeKeys(**{name: ("next", "thing")})


@pytest.mark.parametrize(
    "same", [{"observation": "action"}, {"reward": ("next", "success")}, {"reward": ("next", "pixels")}]
)
def test_two_entries_under_one_key_are_refused(same):
    with pytest.raises(ValueError, match="needs a key of its own"):
        EpisodeKeys(**same)


def test_they_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        EpisodeKeys().action = "other"
