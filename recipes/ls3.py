"""LS³ end to end: demonstrations, offline training, online improvement, evaluation, pictures."""

from __future__ import annotations

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.collectors import Collector

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
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, TaggedReplayBuffer, load_episodes, save_episodes
from ls3_torchrl.planners import describe_plan
from probe import StateProbe
from rollout import collect_demonstrations, make_env, run_episodes, whole_episodes
from settings import check_settings
from training import Training


def seeds(seed: int) -> dict[str, int]:
    """Seeds of the parts of a run, far apart, so that no two share a random stream."""
    names = ("demonstrations", "online", "evaluation", "learning")
    return {name: 10_000 * seed + 1_000 * i for i, name in enumerate(names)}


def probe(agent: LS3Agent, offline: list[TensorDictBase], evaluation: TensorDictBase, horizon: int) -> dict[str, float]:
    """How well latents and imagination know the simulator's state, where the episodes keep it (and are long enough)."""
    episodes = [*offline, evaluation]
    if any(part.get("state", None) is None for part in episodes) or evaluation.shape[1] < horizon:
        return {}
    latents = StateProbe(agent, offline)
    # What was imagined on the agent's own way is read by a probe that has seen the way.
    imagined = StateProbe(agent, episodes).imagination_error(evaluation, horizon=horizon)
    return {"state_error": round(latents.error, 3), f"imagined_{horizon}_steps_error": round(imagined, 3)}


def best_update(online: list[dict[str, torch.Tensor]]) -> int:
    """Number of the update whose episodes violated least and, among those, returned most; the later of equals."""
    ranks = [
        (-float(figures["violation"].float().mean()), float(figures["return"].float().mean()), update)
        for update, figures in enumerate(online)
    ]
    return max(ranks)[-1]


def train(config: DictConfig) -> dict:
    """Run the recipe.

    Args:
        config: the resolved configuration of ``conf/ls3.yaml``.

    Returns:
        What is written to ``summary.json``.
    """
    check_settings(config)
    device = choose_device(config.device)
    if config.threads:
        torch.set_num_threads(config.threads)
    seed = seeds(config.seed)
    torch.manual_seed(seed["learning"])

    # Everything that can be wrong with the settings is found here, before time is spent.
    env = make_env(config, config.online.episodes_per_update, seed["online"], device)
    action_spec = env.action_spec
    agent = LS3Agent(
        action_dim=action_spec.shape[-1],
        in_channels=env.observation_spec["pixels"].shape[-3],
        **config.agent,
    ).to(device)
    planner = agent.planner(action_spec, **config.planner)
    env.append_transform(planner.primer())
    offline = load_episodes(config.data, task=config.task.name) if config.data else None
    for tag in (Tag.SUCCESS, Tag.CONSTRAINT):
        if offline is not None and tag not in offline:
            raise ValueError(f"{config.data} has no {tag.name.lower()} episodes, which LS3 needs. Collect them first.")
    run = RunFolder(config.output, config)
    seconds: dict[str, float] = {}

    with timed(seconds, "demonstrations"):
        if offline is None:
            offline = collect_demonstrations(config, seed["demonstrations"])
            folder = save_episodes(offline, run.path / "demonstrations", task=config.task.name, seed=config.seed)
            offline = load_episodes(folder)  # from the disk from now on: there may be more pictures than memory
        buffer = TaggedReplayBuffer(
            config.task.buffer_capacity,
            latent_dim=config.agent.latent_dim,
            gamma=config.loss.gamma,
            continue_failures=config.loss.continue_failures,
            scratch_dir=config.scratch_dir,
            device=device,
        )
        for tag, episodes in offline.items():
            buffer.add(episodes, tag)
    demonstrations = [episode_figures(offline[Tag.SUCCESS])]
    horizon, worlds = env.base_env.horizon, config.online.episodes_per_update
    training = Training(agent, buffer, config, run, horizon=horizon)
    with timed(seconds, "vae"):
        training.train_vae()
    with timed(seconds, "offline"):
        training.train_offline()
    agent.save(run.path / "checkpoints" / "agent_000.pt")

    online, tracks = [], []
    updates = config.online.updates
    bar = progress(horizon * max(updates, 1), "Planning", "step")
    ticking = planner.register_forward_hook(lambda *_: tick(bar))
    if updates > 0:
        collector = Collector(
            env,
            planner,
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
        run.log("online", (update + 1) * worlds, **scores, **describe_plan(episodes).to_dict())
        console.print(
            f"  update {update + 1}: return {scores['mean_return']:.1f}, success {scores['mean_success']:.0%}, "
            f"violation {scores['mean_violation']:.0%}"
        )
        buffer.add(episodes, Tag.ONLINE)
        with timed(seconds, "updates"):
            training.train_online()
        agent.save(run.path / "checkpoints" / f"agent_{update + 1:03d}.pt")
    ticking.remove()
    bar.close()
    if updates > 0:
        collector.shutdown()
    if config.online.select == "best" and online:
        # An agent that acted, and is known by its episodes; the last one never did.
        best = best_update(online)
        agent.load_state_dict(LS3Agent.load(run.path / "checkpoints" / f"agent_{best:03d}.pt").state_dict())
        console.print(f"agent.pt is the agent of update {best + 1}, whose episodes went best")
    path = agent.save(run.path / "agent.pt")

    with timed(seconds, "evaluation"):
        evaluation = run_episodes(
            config, planner, config.evaluation.episodes, seed["evaluation"], device, what="Evaluation"
        )
    with timed(seconds, "probe"):
        probed = probe(agent, list(offline.values()), evaluation, config.planner.horizon)
    summary = {
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
            pictures.draw_all(run.path, config, agent, planner, offline, tracks, evaluation)
    summary["minutes"] = round(run.seconds / 60, 2)
    summary["seconds"] = {name: round(value, 1) for name, value in seconds.items()}
    run.write_json("summary.json", summary)
    run.close()
    print_summary(summary, run.path)
    return summary


@hydra.main(version_base="1.3", config_path="conf", config_name="ls3")
def main(config: DictConfig) -> None:
    """Entry point."""
    train(config)


if __name__ == "__main__":
    main()
