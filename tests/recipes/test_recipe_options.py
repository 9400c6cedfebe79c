"""Settings from signatures, and from nested mappings."""

from dataclasses import dataclass, field

import pytest
from omegaconf import MISSING

from ls3_recipes.options import as_dict, build, defaults, errors_of, from_signatures


@dataclass(frozen=True, kw_only=True)
class Inner:
    size: int
    rates: tuple[float, ...] = (0.1, 0.2)

    def __post_init__(self):
        if self.size < 1:
            raise ValueError(f"size must be at least 1, got {self.size}.")


@dataclass(frozen=True, kw_only=True)
class Middle:
    inner: Inner
    other: str = "a"


@dataclass(frozen=True, kw_only=True)
class Outer:
    middle: Middle
    names: tuple[str, ...] = field(default_factory=tuple)


def fly(height, *, speed=3.0, height_key="z", in_keys=()): ...


def land(*, gear=True): ...


def test_fields_are_keyword_arguments_that_are_no_keys():
    flight = from_signatures("Flight", "How.", fly, land)
    assert defaults(flight) == {"speed": 3.0, "gear": True}
    assert flight.__doc__ == "How."
    assert defaults(from_signatures("Flight", "How.", fly, only=("height", "speed"))) == {
        "height": MISSING,
        "speed": 3.0,
    }


def test_all_arguments_but_some_can_be_taken():
    flight = from_signatures("Flight", "How.", fly, without=("height_key", "in_keys"))
    assert defaults(flight) == {"height": MISSING, "speed": 3.0}
    with pytest.raises(ValueError, match="argument weight"):
        from_signatures("Flight", "How.", fly, without=("weight",))


def test_arguments_that_clash_or_are_not_there_are_noticed():
    with pytest.raises(ValueError, match="argument speed"):
        from_signatures("Flight", "How.", fly, fly)
    with pytest.raises(ValueError, match="argument weight"):
        from_signatures("Flight", "How.", fly, only=("speed", "weight"))


def test_nested_settings_are_built_with_defaults_and_lists_as_tuples_and_back():
    built = build(Outer, {"middle": {"inner": {"size": 2, "rates": [0.5]}}, "names": ["x", "y"]})
    assert built == Outer(middle=Middle(inner=Inner(size=2, rates=(0.5,))), names=("x", "y"))
    assert build(Outer, as_dict(built)) == built
    assert as_dict(built)["middle"]["inner"]["rates"] == [0.5]
    assert defaults(Outer) == {
        "middle": {"inner": {"size": MISSING, "rates": [0.1, 0.2]}, "other": "a"},
        "names": [],
    }


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"middle": {"inner": {"size": 0}}}, r"^middle\.inner\.size must be at least 1, got 0\.$"),
        (
            {"middle": {"inner": {"sise": 2}}},
            r"^middle\.inner has no setting sise: did you mean middle\.inner\.size\? It has: size, rates\.$",
        ),
        ({"middle": "a"}, r"^middle is a section, got 'a': set middle\.KEY=VALUE\.$"),
        ({"middle": {"inner": 3}}, r"^middle\.inner is a section, got 3: set middle\.inner\.KEY=VALUE\.$"),
        ({"midle": {}}, r"^The run has no setting midle\. It has: middle, names\.$"),
        ({"middle": {"inner": {}}}, r"^middle\.inner\.size must be given"),
        ({"middle": {"inner": {"size": MISSING}}}, r"^middle\.inner\.size must be given"),
        ({}, r"^middle\.inner\.size must be given"),
    ],
)
def test_errors_name_setting_and_section(values, message):
    with pytest.raises(ValueError, match=message):
        build(Outer, values)


def test_only_messages_that_begin_with_a_setting_get_its_section():
    for message, shown in (
        ("size must", "box.size must"),
        ("sizes must", "sizes must"),
        ("x.size must", "x.size must"),
    ):
        with pytest.raises(ValueError, match=f"^{shown}"), errors_of("box", ["size"]):
            raise ValueError(message)
