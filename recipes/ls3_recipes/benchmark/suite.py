"""How long everything takes on this machine, compared with a plain fp32 eager path in the same run."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded

import ls3_envs
from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.benchmark.planning import agreement, time_plans
from ls3_recipes.benchmark.timing import Bench, matmul_peak, show
from ls3_recipes.benchmark.updates import time_updates, time_vae
from ls3_recipes.command_settings import BenchmarkSettings
from ls3_recipes.configuration import train_settings
from ls3_recipes.console import console
from ls3_recipes.device import choose_device, hardware
from ls3_recipes.options import as_dict
from ls3_recipes.run_files import require_new
from ls3_recipes.run_folder import RunFolder
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, TaggedReplayBuffer
from ls3_torchrl.trainers.learner import threads


def run_benchmark(settings: BenchmarkSettings) -> dict:
    """Run the benchmark.

    Returns:
        What is written to ``benchmark.json``.
    """
    device = choose_device(settings.device)
    require_new(settings.output)
    if settings.agent is not None:
        LS3Agent.load(settings.agent)
    if settings.threads:
        torch.set_num_threads(settings.threads)
    presets = [_preset(settings.task, name) for name in settings.presets]
    folder, bench = RunFolder.make(settings.output, as_dict(settings)), Bench(settings.seconds)
    peaks = {str(t).removeprefix("torch."): matmul_peak(bench, t, device) for t in (torch.float32, torch.bfloat16)}
    space = ls3_envs.make(settings.task, num_envs=1, seed=0).action_spec.space
    spec = Bounded(low=space.low[0], high=space.high[0], shape=space.low.shape[1:], device=device)
    episodes = ls3_envs.collect_offline(settings.task, "success", episodes=8, seed=0)
    _time_all(bench, settings, presets, spec, episodes, device)
    for row in bench.rows:
        if "gflops" in row:
            peak = peaks["bfloat16" if row["what"].endswith("bf16") else "float32"] / 1e9
            row["share_of_peak"] = row["gflops"] / peak
    out = {
        "agreement": _agreements(settings, presets, spec, episodes, device),
        "hardware": hardware(device),
        "peak_gflops": {name: peak / 1e9 for name, peak in peaks.items()},
        "rows": bench.rows,
    }
    folder.write_json("benchmark.json", out)
    folder.close()
    show(bench.rows, folder.path)
    return out


def _preset(task: str, preset: str) -> LS3Settings:
    settings = train_settings(f"task={task}", f"preset={preset}")
    assert isinstance(settings, LS3Settings)
    return settings


def _time_all(
    bench: Bench,
    settings: BenchmarkSettings,
    presets: Sequence[LS3Settings],
    spec: Bounded,
    episodes: TensorDictBase,
    device: torch.device,
) -> None:
    """Every figure, in the table's order."""
    for preset in presets:
        time_plans(bench, preset, spec, settings.batches, device, reference=settings.reference)
        with threads(1):  # as the trainers do
            time_updates(bench, preset, spec, device, reference=settings.reference)
    frames = episodes["pixels"].flatten(0, 1)
    time_vae(bench, presets[0], spec, frames, device, reference=settings.reference)
    for name in settings.domains or tuple(ls3_envs.DOMAINS):
        for num_envs in settings.batches:
            time_environment_steps(bench, name, num_envs, device)
    _time_sampling(bench, presets[0], spec, episodes)
    if settings.smoke:
        bench.time("whole smoke run", lambda: smoke_run(settings.task), once=True)


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


def _time_sampling(bench: Bench, preset: LS3Settings, spec: Bounded, episodes: TensorDictBase) -> None:
    agent = LS3Agent(action_spec=spec, in_channels=episodes["pixels"].shape[-3], **as_dict(preset.agent))
    buffer = TaggedReplayBuffer(2000, latent_dim=agent.architecture.latent_dim)
    buffer.add(episodes, Tag.SUCCESS)
    buffer.encode(agent.encoder)
    bench.time("sampling 256 transitions for each of 5 members", lambda: buffer.sample(256, members=5))


def smoke_run(task: str) -> None:
    """The whole recipe, from demonstrations to pictures, as a user starts it."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "ls3_recipes", "train", f"task={task}", "preset=smoke"]
        subprocess.run([*command, f"output={folder}/run"], check=True, capture_output=True)


def _agreements(
    settings: BenchmarkSettings,
    presets: Sequence[LS3Settings],
    spec: Bounded,
    episodes: TensorDictBase,
    device: torch.device,
) -> dict[str, Any]:
    """What bf16 changes in the plans of the trained agent, if one is given, by preset."""
    if settings.agent is None:
        return {}
    trained = LS3Agent.load(settings.agent, device=device)
    frames = episodes["pixels"].flatten(0, 1)
    frames = frames[torch.linspace(0, len(frames) - 1, settings.states).long()]
    found = {}
    for preset in presets:
        figures = found[preset.preset] = agreement(trained, as_dict(preset.planner), spec, frames)
        console.print(
            f"bf16 for fp32, planner of {preset.preset}: value off by {figures['value_error']:.2%} in the median, "
            f"other feasibility for {figures['feasibility']:.2%} of candidates"
        )
    return found
