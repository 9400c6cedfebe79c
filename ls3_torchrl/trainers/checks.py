"""Whether a buffer's rows fit the agent that is to learn from them, before hours are spent."""

from __future__ import annotations

import warnings

from ls3_torchrl._checks import DataWarning
from ls3_torchrl.agent import LS3Agent
from ls3_torchrl.data import VALUE_TAGS, Tag, TaggedReplayBuffer
from ls3_torchrl.data.bounds import require_within


def require_fitting_actions(agent: LS3Agent, buffer: TaggedReplayBuffer) -> None:
    """Raise ``ValueError`` for rows whose actions are not the agent's: of another size, or outside of its bounds."""
    if not len(buffer):
        return
    actions, size = buffer.transitions.storage[:].get(buffer.keys.action), agent.architecture.action_dim
    if actions.shape[-1] != size:
        raise ValueError(
            f"The buffer's actions have {actions.shape[-1]} dimensions, but the agent's {size}. Make the agent with "
            "action_dim as the data have, or use data of the same actions."
        )
    if agent.action_spec is not None:
        require_within(actions, agent.action_spec, "The buffer")


def warn_of_missing_outcomes(buffer: TaggedReplayBuffer, *, stacklevel: int) -> None:
    """Say so when no episode that values are learnt from ever succeeds, or no demonstrated violation violates."""
    if not len(buffer):
        return
    rows, keys, said = buffer.transitions.storage[:], buffer.keys, []
    tag = rows["tag"].flatten()
    values = sum(tag == int(each) for each in VALUE_TAGS) > 0
    if values.any() and not rows.get(keys.success).flatten()[values].any():
        said.append(
            "There is no success in the buffer's data that values are learnt from (success, online): no episode ever "
            "succeeds. Check the success labels; without any, nothing about the goal can be learnt."
        )
    violating = tag == int(Tag.CONSTRAINT)
    if violating.any() and not rows.get(keys.constraint).flatten()[violating].any():
        said.append(
            "There is no violation in the buffer's data tagged 'constraint': no step ever violates. Check the "
            "constraint labels; without any, the constraint cannot be learnt."
        )
    if said:
        warnings.warn(" ".join(said), DataWarning, stacklevel=stacklevel + 1)
