"""Which rows of a buffer are drawn."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

from tensordict import NestedKey, unravel_key

from ls3_torchrl._checks import require_at_least
from ls3_torchrl.data.tags import ALL_TAGS, Tag


@dataclass(frozen=True)
class RowSelection:
    """Which rows of a buffer are drawn: by origin, by label, by what follows them, and with how many online ones.

    Args:
        tags: the union to draw from, by name, number or :class:`~ls3_torchrl.data.Tag`; a single one stands for itself.
        without: label whose rows are left out, bool ``[*B, 1]``, such as ``"after_violation"``; none when ``None``.
        steps: K for stretches of K rows of one episode, in their order, none of which is left out; ``None`` for single
            rows.
        online_fraction: least fraction of online rows in a draw, in [0, 1), once there are some. Where offline data
            are many, a uniform draw hardly shows what the agent itself has met.

    Raises:
        ValueError: without a tag, for an unknown one, for steps below 1 or a fraction outside [0, 1).

    Example:
        >>> RowSelection(tags=["online", "success"]) == RowSelection(tags=("SUCCESS", 3))
        True
    """

    tags: Iterable[Tag | str | int] = ALL_TAGS
    without: NestedKey | None = None
    steps: int | None = None
    online_fraction: float = 0.0

    def __post_init__(self) -> None:
        tags = [self.tags] if isinstance(self.tags, (str, int)) else self.tags  # a Tag is an int
        parsed = tuple(sorted({Tag.parse(tag) for tag in tags}))
        if not parsed:
            names = ", ".join(repr(tag.name.lower()) for tag in Tag)
            raise ValueError(f"A selection needs at least one tag, got none. Choose from {names}.")
        object.__setattr__(self, "tags", parsed)
        if self.without is not None:
            object.__setattr__(self, "without", unravel_key(self.without))
        if self.steps is not None:
            require_at_least(self.steps, 1, "steps")
        if not 0.0 <= self.online_fraction < 1.0:
            raise ValueError(f"online_fraction must be in [0, 1), got {self.online_fraction}.")

    @classmethod
    def of(cls, selection: RowSelection | None, filters: dict[str, Any]) -> RowSelection:
        """A selection from itself or from its fields by name.

        Raises:
            TypeError: for both at once, for something else than a selection, or for unknown fields.
        """
        if selection is None:
            known = [field.name for field in fields(cls)]
            unknown = sorted(set(filters) - set(known))
            if unknown:
                raise TypeError(f"Unknown filters {unknown}. Known filters: {', '.join(known)}.")
            return cls(**filters)
        if filters:
            raise TypeError(f"Give a RowSelection or its fields, not both; got {selection} and {sorted(filters)}.")
        if not isinstance(selection, cls):
            raise TypeError(
                f"A selection must be a RowSelection, got {type(selection).__name__}. Name its fields instead, "
                "for example tags=['success']."
            )
        return selection
