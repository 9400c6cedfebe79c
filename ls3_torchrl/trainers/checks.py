"""What a buffer must hold for an agent to learn from it, found before time is spent."""

from __future__ import annotations

import warnings

from ls3_torchrl._checks import DataWarning
from ls3_torchrl.agent import LS3Agent
from ls3_torchrl.data import TaggedReplayBuffer
from ls3_torchrl.data.conform import require_actions


def require_actions_of(agent: LS3Agent, buffer: TaggedReplayBuffer) -> None:
    """Raise ``ValueError`` for actions of another number than the agent's, or outside the bounds it was made for."""
    if not len(buffer):
        return  # the first draw says so
    key, size = buffer.keys.action, agent.architecture.action_dim
    actions = buffer.transitions.storage[:].get(key)
    if actions.shape[-1] != size:
        raise ValueError(
            f"The buffer's {key!r} has {actions.shape[-1]} actions, the agent's networks have {size}. Make the agent "
            "for the robot whose data these are."
        )
    if agent.action_spec is not None:
        require_actions(actions, agent.action_spec, f"The buffer's {key!r}")


def warn_of_missing_outcomes(buffer: TaggedReplayBuffer) -> None:
    """Warn of data in which no step succeeds, or none violates a constraint."""
    if not len(buffer):
        return
    rows, keys = buffer.transitions.storage[:], buffer.keys
    for key, what in ((keys.success, "success, so nothing tells the goal"), (keys.constraint, "violation")):
        if not rows.get(key).any():
            warnings.warn(
                f"The data hold no {what}: {key!r} is false in all {len(rows)} steps. Add episodes that do, or check "
                "how it is computed.",
                DataWarning,
                stacklevel=3,
            )
