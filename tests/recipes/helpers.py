"""What the tests of the recipes' training share: a run folder that only remembers, agents, and an episode of noise."""

import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from ls3_torchrl import LS3Agent
from settings import agent_options


class Silent:
    """A run folder that keeps what is logged."""

    def __init__(self):
        self.rows = []

    def log(self, phase, step, **values):
        self.rows.append((phase, step, values))


def make_agent(config):
    return LS3Agent(**agent_options(config, Bounded(low=-3.0, high=3.0, shape=(2,))), action_dim=2)


def noisy_episode() -> TensorDict:
    """Seven steps of random images and actions."""
    pixels = torch.randint(256, (8, 3, 64, 64), dtype=torch.uint8)
    step = {"reward": -torch.ones(7, 1), "pixels": pixels[1:]}
    step |= {k: torch.zeros(7, 1, dtype=torch.bool) for k in ("constraint", "success")}
    return TensorDict({"pixels": pixels[:-1], "action": torch.randn(7, 2), "next": step}, [7])
