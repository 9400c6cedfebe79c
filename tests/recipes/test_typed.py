"""Values by their annotations, and the nearest of names."""

from typing import Literal

import pytest

from ls3_recipes.typed import did_you_mean, typed, words


@pytest.mark.parametrize(
    ("value", "hint", "made"),
    [
        (3, int, 3),
        (1e3, int, 1000),
        (3, float, 3.0),
        (True, bool, True),
        ("a", str, "a"),
        (None, int | None, None),
        ("auto", bool | Literal["auto"], "auto"),
        ([1, 2.0], tuple[int, ...], (1, 2)),
        ([], tuple[int, ...], ()),
        ([0, 1], tuple[float, float] | None, (0.0, 1.0)),
        ([1.5, 2], float | tuple[float, ...] | Literal["box"], (1.5, 2.0)),
    ],
)
def test_what_is_meant_is_taken_in_the_fields_own_type(value, hint, made):
    got = typed(value, hint, "a.b")
    assert got == made
    assert type(got) is type(made)


@pytest.mark.parametrize(
    ("value", "hint", "error"),
    [
        (True, int, TypeError),
        (1, bool, TypeError),
        (1.5, int, TypeError),
        (float("inf"), int, TypeError),
        ("3", int, TypeError),
        (None, float, TypeError),
        ("nan", float, ValueError),
        (float("nan"), float, ValueError),
        (10**400, float, ValueError),
        (2**63, int, ValueError),
        (3, str, TypeError),
        ("Max", Literal["max", "mean"], ValueError),
        (1, bool | Literal["auto"], TypeError),
        ([1, "a"], tuple[int, ...], TypeError),
        ([1, float("nan")], tuple[float, ...], ValueError),
        ([1], tuple[float, float], ValueError),
        ({"a": 1}, tuple[int, ...], TypeError),
        ([3], int, TypeError),
    ],
)
def test_what_is_not_is_refused_by_name(value, hint, error):
    with pytest.raises(error, match=r"^a\.b must ") as refused:
        typed(value, hint, "a.b")
    assert "\n" not in str(refused.value)


def test_text_that_reads_as_a_number_is_to_be_quoted():
    with pytest.raises(TypeError, match=r"^output must be text, got 2024\. Put it in quotes: \"output='2024'\"\.$"):
        typed(2024, str, "output")


def test_annotations_in_words():
    assert words(Literal["max", "mean"]) == "one of 'max', 'mean'"
    assert words(tuple[float, float] | None) == "a list of 2 finite numbers, or null"


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("planner.horizn", ": did you mean planner.horizon?"),
        ("horizon", ": did you mean planner.horizon or task.horizon?"),
        ("planner.lr", ": did you mean vae.lr?"),
        ("planner.foo", ""),
        ("", ""),
    ],
)
def test_the_nearest_name_is_proposed_only_where_it_is_near(name, meant):
    assert did_you_mean(name, ["planner.horizon", "task.horizon", "vae.lr", "seed"]) == meant
