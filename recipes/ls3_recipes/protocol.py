"""The protocol that every algorithm follows: demonstrations, offline training, online improvement, evaluation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

import pictures
from common import (
    RunFolder,
    choose_device,
    console,
    episode_figures,
    hardware,
    print_summary,
    progress,
    summarise,
    tick,
    timed,
)
from ls3_torchrl.data import Tag, TaggedReplayBuffer, load_episodes, save_episodes
from rollout import collect_demonstrations, make_env, run_episodes, whole_episodes


class Algorithm(ABC):
    """What the protocol asks of an algorithm.

    Everything that can be wrong with the settings is found in the constructor, before time is spent.

    Args:
        config: the recipe's configuration.
        env: the environment that it will act in.
        device: of its networks.
    """

    #: As in the configuration's ``algorithm``.
    name: str
    #: Tags of the offline data that it cannot do without.
    needs: tuple[Tag, ...] = (Tag.SUCCESS,)
    config: DictConfig
    #: What acts; writes ``action``.
    policy: TensorDictModuleBase

    @abstractmethod
    def __init__(self, config: DictConfig, env: TransformedEnv, device: torch.device) -> None: ...

    def prepare(self, env: TransformedEnv) -> None:  # noqa: B027
        """Append what the policy needs of an environment."""

    def offline_data(self, offline: dict[Tag, TensorDictBase]) -> dict[Tag, TensorDictBase]:
        """The offline episodes as the buffer takes them."""
        return offline

    def make_buffer(self, device: torch.device, **labels: Any) -> TaggedReplayBuffer:
        """An empty buffer; ``labels`` are options of its own about what is kept of an episode."""
        config = self.config
        return TaggedReplayBuffer(
            config.task.buffer_capacity,
            latent_dim=config.agent.latent_dim,
            gamma=config.loss.gamma,
            success_tail=config.loss.success_tail,
            scratch_dir=config.scratch_dir,
            device=device,
            **labels,
        )

    @abstractmethod
    def begin(self, buffer: TaggedReplayBuffer, run: RunFolder, horizon: int) -> None:
        """Make the learners, on a buffer that holds the offline data."""

    @abstractmethod
    def phases(self) -> dict[str, Callable[[], None]]:
        """What is trained offline: the phases' names, and what carries them out, in their order."""

    @abstractmethod
    def train_online(self) -> None:
        """Learn from all data, after new episodes."""

    def describe(self, episodes: TensorDictBase) -> dict[str, float]:
        """Figures of the policy's own about episodes that it acted in, for the metrics."""
        return {}

    def diagnose(self, offline: dict[Tag, TensorDictBase], evaluation: TensorDictBase) -> dict[str, float]:
        """Figures about what it has learnt, for the summary."""
        return {}

    @abstractmethod
    def save(self, path: Path) -> Path:
        """Write all networks to one file."""

    @abstractmethod
    def restore(self, path: Path) -> None:
        """Take the networks of a file."""

    def draw(  # noqa: B027
        self,
        folder: Path,
        offline: dict[Tag, TensorDictBase],
        tracks: list[torch.Tensor],
        evaluation: TensorDictBase,
    ) -> None:
        """Pictures of its own, beside those that every run leaves."""


def seeds(seed: int) -> dict[str, int]:
    """Seeds of the parts of a run, far apart, so that no two share a random stream."""
    names = ("demonstrations", "online", "evaluation", "learning")
    return {name: 10_000 * seed + 1_000 * i for i, name in enumerate(names)}


def best_update(online: list[dict[str, torch.Tensor]]) -> int:
    """Number of the update whose episodes violated least and, among those, returned most; the later of equals."""
    ranks = [
        (-float(figures["violation"].float().mean()), float(figures["return"].float().mean()), update)
        for update, figures in enumerate(online)
    ]
    return max(ranks)[-1]


def follow(config: DictConfig, algorithm_class: type[Algorithm]) -> dict:
    """Follow the protocol from demonstrations to pictures.

    Args:
        config: the resolved configuration of the recipe.
        algorithm_class: what learns and acts.

    Returns:
        What is written to ``summary.json``.
    """
    device = choose_device(config.device)
    if config.threads:
        torch.set_num_threads(config.threads)
    seed = seeds(config.seed)
    torch.manual_seed(seed["learning"])

    env = make_env(config, config.online.episodes_per_update, seed["online"], device)
    algorithm = algorithm_class(config, env, device)
    algorithm.prepare(env)
    offline = load_episodes(config.data, task=config.task.name) if config.data else None
    for tag in algorithm.needs:
        if offline is not None and tag not in offline:
            raise ValueError(
                f"{config.data} has no {tag.name.lower()} episodes, which {algorithm.name} needs. Collect them first."
            )
    run = RunFolder(config.output, config)
    seconds: dict[str, float] = {}

    with timed(seconds, "demonstrations"):
        if offline is None:
            with torch.random.fork_rng():  # what is learnt does not depend on whether the data were there already
                offline = collect_demonstrations(config, seed["demonstrations"])
            folder = save_episodes(offline, run.path / "demonstrations", task=config.task.name, seed=config.seed)
            offline = load_episodes(folder)  # from the disk from now on: there may be more pictures than memory
        buffer = algorithm.make_buffer(device)
        for tag, episodes in algorithm.offline_data(offline).items():
            buffer.add(episodes, tag)
    demonstrations = [episode_figures(offline[Tag.SUCCESS])]
    horizon, worlds = env.base_env.horizon, config.online.episodes_per_update
    algorithm.begin(buffer, run, horizon)
    for phase, train in algorithm.phases().items():
        with timed(seconds, phase):
            train()
    algorithm.save(run.path / "checkpoints" / "agent_000.pt")

    online, tracks = [], []
    updates = config.online.updates
    bar = progress(horizon * max(updates, 1), "Planning", "step")
    ticking = algorithm.policy.register_forward_hook(lambda *_: tick(bar))
    if updates > 0:
        collector = Collector(
            env,
            algorithm.policy,
            frames_per_batch=worlds * horizon,
            total_frames=updates * worlds * horizon,
            device=device,
        )
        rounds = iter(collector)
    for update in range(updates):
        bar.reset(total=horizon)
        bar.set_description_str(f"{f'Episodes, update {update + 1}/{updates}':<24}")
        with timed(seconds, "planning"):
            episodes = whole_episodes(next(rounds))
        figures = episode_figures(episodes)
        online.append(figures)
        tracks.append(episodes["next", "state"].cpu())
        scores = {f"mean_{name}": float(value.float().mean()) for name, value in figures.items()}
        run.log("online", (update + 1) * worlds, **scores, **algorithm.describe(episodes))
        console.print(
            f"  update {update + 1}: return {scores['mean_return']:.1f}, success {scores['mean_success']:.0%}, "
            f"violation {scores['mean_violation']:.0%}"
        )
        buffer.add(episodes, Tag.ONLINE)
        with timed(seconds, "updates"):
            algorithm.train_online()
        algorithm.save(run.path / "checkpoints" / f"agent_{update + 1:03d}.pt")
    ticking.remove()
    bar.close()
    if updates > 0:
        collector.shutdown()
    if config.online.select == "best" and online:
        # An agent that acted, and is known by its episodes; the last one never did.
        best = best_update(online)
        algorithm.restore(run.path / "checkpoints" / f"agent_{best:03d}.pt")
        console.print(f"agent.pt is the agent of update {best + 1}, whose episodes went best")
    path = algorithm.save(run.path / "agent.pt")

    with timed(seconds, "evaluation"):
        world = make_env(config, config.evaluation.episodes, seed["evaluation"], device)
        algorithm.prepare(world)
        evaluation = run_episodes(world, algorithm.policy, what="Evaluation")
    with timed(seconds, "probe"):
        probed = algorithm.diagnose(offline, evaluation)
    summary = {
        "algorithm": algorithm.name,
        "task": config.task.name,
        "preset": config.preset,
        "seed": config.seed,
        "minutes": 0.0,
        "demonstrations": summarise(demonstrations),
        "probe": probed,
        **({"online": summarise(online)} if online else {}),
        "evaluation": summarise([episode_figures(evaluation)]),
        "hardware": hardware(device),
        "agent": path.name,
    }
    if config.pictures:
        with timed(seconds, "pictures"):
            torch.save(tracks, run.path / "online_tracks.pt")
            pictures.draw_run(run.path, config, offline, tracks, evaluation)
            algorithm.draw(run.path, offline, tracks, evaluation)
    summary["minutes"] = round(run.seconds / 60, 2)
    summary["seconds"] = {name: round(value, 1) for name, value in seconds.items()}
    run.write_json("summary.json", summary)
    run.close()
    print_summary(summary, run.path)
    return summary
