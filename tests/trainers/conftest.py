"""What the tests of training share: a logger that remembers, small agents, and episodes of noise."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.record.loggers import Logger

from ls3_torchrl import LS3Agent

LATENT_DIM = 8
SIZES = {
    "latent_dim": LATENT_DIM,
    "num_dynamics": 2,
    "num_values": 2,
    "dynamics_hidden": (16,),
    "value_hidden": (16,),
    "classifier_hidden": (16,),
}


class Recorder(Logger):
    """A logger that keeps what is logged as (name, value, step)."""

    def __init__(self):
        self.rows = []
        super().__init__(exp_name="test", log_dir="")

    def _create_experiment(self):
        return None

    def log_scalar(self, name, value, step=None):
        self.rows.append((name, value, step))

    def log_video(self, name, video, step=None, **kwargs):
        raise NotImplementedError

    def log_hparams(self, cfg):
        raise NotImplementedError

    def log_histogram(self, name, data, **kwargs):
        raise NotImplementedError

    def __repr__(self):
        return "Recorder()"

    def values(self, name):
        return [value for logged, value, _ in self.rows if logged == name]


@pytest.fixture
def recorder():
    return Recorder()


@pytest.fixture
def make_agent():
    return lambda **changes: LS3Agent(action_dim=2, **(SIZES | changes))


@pytest.fixture
def episode():
    """Makes an episode whose pixels are one grey, or noise; ``constraint`` or ``success`` names flags that rise."""

    def make(steps=9, *, grey=None, actions=None, **flags):
        frames = (
            torch.randint(256, (steps + 1, 3, 64, 64), dtype=torch.uint8)
            if grey is None
            else torch.full((steps + 1, 3, 64, 64), grey, dtype=torch.uint8)
        )
        reached = {"pixels": frames[1:], "reward": -torch.ones(steps, 1)}
        for name in ("constraint", "success"):
            first = flags.get(name, steps)
            reached[name] = torch.arange(steps).unsqueeze(-1) >= first
        actions = torch.zeros(steps, 2) if actions is None else actions
        return TensorDict({"pixels": frames[:-1], "action": actions, "next": reached}, [steps])

    return make
