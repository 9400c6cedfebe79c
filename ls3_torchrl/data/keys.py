"""Where episodes keep their entries."""

from __future__ import annotations

from dataclasses import dataclass, fields

from tensordict import NestedKey, unravel_key


@dataclass(frozen=True)
class EpisodeKeys:
    """Under which keys episodes keep observations, actions, rewards, violations and successes.

    The buffer and the functions that save, load, check and build episodes take one, so that own data need no renaming.
    All keys may be nested.

    Args:
        observation: the observation of each step, of any dtype and shape. The observation after the step is found
            under ``("next", observation)``.
        action: the action of each step, float ``[*B, A]``.
        reward: its reward, float ``[*B, 1]``.
        constraint: whether its next state violates a constraint, bool ``[*B, 1]``.
        success: whether its next state lies in the goal set, bool ``[*B, 1]``.

    Raises:
        ValueError: when two entries have the same key, or the observation or action lies under ``next``.

    Example:
        >>> EpisodeKeys(observation=("agent", "state")).next_observation
        ('next', 'agent', 'state')
    """

    observation: NestedKey = "pixels"
    action: NestedKey = "action"
    reward: NestedKey = ("next", "reward")
    constraint: NestedKey = ("next", "constraint")
    success: NestedKey = ("next", "success")

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, unravel_key(getattr(self, field.name)))
        for name in ("observation", "action"):
            if as_tuple(getattr(self, name))[0] == "next":
                raise ValueError(
                    f"The key of the {name} must not lie under 'next', got {getattr(self, name)!r}. "
                    "Name the entry of the step itself."
                )
        if len(set(self.required)) < len(self.required):
            raise ValueError(f"Each entry of an episode needs a key of its own, got {self}.")

    @property
    def next_observation(self) -> tuple[str, ...]:
        """Where the observation after a step lies."""
        return ("next", *as_tuple(self.observation))

    @property
    def required(self) -> tuple[NestedKey, ...]:
        """All entries that an episode must have."""
        return (self.observation, self.action, self.next_observation, self.reward, self.constraint, self.success)


def as_tuple(key: NestedKey) -> tuple[str, ...]:
    """A nested key as a tuple, whatever its depth."""
    return (key,) if isinstance(key, str) else tuple(key)
