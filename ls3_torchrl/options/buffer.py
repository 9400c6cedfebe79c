"""What a replay buffer keeps of episodes."""

from __future__ import annotations

from dataclasses import dataclass

from ls3_torchrl._values import require_at_least, require_unit_interval


@dataclass(frozen=True, kw_only=True)
class BufferOptions:
    """The options of :class:`~ls3_torchrl.data.TaggedReplayBuffer` that matter to what is learnt, as documented there.

    Raises:
        ValueError: for a capacity or a tail below 1, or γ outside [0, 1].

    Example:
        >>> BufferOptions(capacity=1000).gamma
        0.99
    """

    capacity: int
    gamma: float = 0.99
    success_tail: int | None = None

    def __post_init__(self) -> None:
        require_at_least(self.capacity, 1, "capacity")
        require_unit_interval(self.gamma, "gamma")
        if self.success_tail is not None:
            require_at_least(self.success_tail, 1, "success_tail")
