"""When the state of a run is saved."""

import pytest

from ls3_recipes.interrupts import Interrupted, Interrupts
from ls3_recipes.run_state import RunState
from ls3_torchrl.trainers import Checkpoints


class Part:
    """Something with a state."""

    def state_dict(self):
        return {"step": 1}

    def load_state_dict(self, state_dict):
        assert state_dict == {"step": 1}


def test_states_are_saved_by_the_clock_and_when_a_signal_waits(tmp_path):
    interrupts = Interrupts()
    often = RunState(Checkpoints(tmp_path / "often"), {"one": Part()}, interrupts, 1e-9)
    never = RunState(Checkpoints(tmp_path / "never"), {"one": Part()}, interrupts, 1e9)
    for state in (often, never):
        state.after_step()
    assert often.load()
    assert not never.load()

    def step():
        with interrupts.deferred():
            interrupts._receive(15, None)
            never.after_step()

    with pytest.raises(Interrupted):
        step()
    assert never.load()
