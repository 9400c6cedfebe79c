"""How long environments and buffer take."""

from __future__ import annotations

import time

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded

import ls3_envs
from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.benchmark.timing import Bench
from ls3_recipes.options import as_dict
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, TaggedReplayBuffer


def time_environment_steps(bench: Bench, domain: str, num_envs: int, device: torch.device) -> None:
    """Steps of a domain with pixels, and how many of them a second of one core makes."""
    env = ls3_envs.make(domain, num_envs=num_envs, seed=0, device=device)
    td = env.rand_action(env.reset())
    busy, steps = time.process_time(), 0

    def step() -> None:
        nonlocal steps
        steps += num_envs
        env.base_env._clock.zero_()  # no episode ends here
        env.step(td)

    bench.time(f"step with pixels, {domain}, each of {num_envs}", step, per=num_envs)
    bench.rows[-1]["per_cpu_second"] = steps / (time.process_time() - busy)


def time_sampling(bench: Bench, preset: LS3Settings, spec: Bounded, episodes: TensorDictBase) -> None:
    """Batches of a filled buffer."""
    agent = LS3Agent(action_spec=spec, in_channels=episodes["pixels"].shape[-3], **as_dict(preset.agent))
    buffer = TaggedReplayBuffer(2000, latent_dim=agent.architecture.latent_dim)
    buffer.add(episodes, Tag.SUCCESS)
    buffer.encode(agent.encoder)
    bench.time("sampling 256 transitions for each of 5 members", lambda: buffer.sample(256, members=5))
