"""Where a row of data came from: D_success, D_rand, D_constraint, or online."""

from __future__ import annotations

from enum import IntEnum


class Tag(IntEnum):
    """Origin of a transition, stored as uint8 under ``tag``.

    Example:
        >>> Tag.parse("success"), int(Tag.ONLINE)
        (<Tag.SUCCESS: 0>, 3)
    """

    SUCCESS = 0
    RAND = 1
    CONSTRAINT = 2
    ONLINE = 3

    @classmethod
    def parse(cls, value: Tag | str | int) -> Tag:
        """A tag from its name, number or itself.

        Raises:
            ValueError: for anything else; the message lists the names.
        """
        try:
            return cls[value.upper()] if isinstance(value, str) else cls(value)
        except (KeyError, ValueError):
            names = ", ".join(repr(tag.name.lower()) for tag in cls)
            raise ValueError(f"Unknown tag {value!r}. Known tags: {names}.") from None


#: All data, D in the paper.
ALL_TAGS: tuple[Tag, ...] = tuple(Tag)
#: The data that the value functions learn from (section 1.1.1): demonstrations and online episodes.
VALUE_TAGS: tuple[Tag, ...] = (Tag.SUCCESS, Tag.ONLINE)
