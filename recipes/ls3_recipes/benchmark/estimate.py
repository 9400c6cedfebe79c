"""How long a whole run would take: measured costs of its steps, times how many of them its settings ask for."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeAlias

import torch
from torchrl.envs import TransformedEnv

import ls3_envs
from ls3_recipes.algorithms.ls3 import LS3
from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.benchmark.environments import time_environment_steps
from ls3_recipes.benchmark.planning import permissive
from ls3_recipes.benchmark.tables import Section, milliseconds
from ls3_recipes.benchmark.workbench import Workbench, preset_settings
from ls3_torchrl.data import Tag, TaggedReplayBuffer
from ls3_torchrl.trainers import LS3Trainer, VAETrainer

#: A phase of a run, and the step that it repeats.
Step: TypeAlias = tuple[str, str]
#: Learners: names in LS3Trainer, and the options that hold how many steps they take.
_LEARNERS = {
    "dynamics": "dynamics_steps",
    "value": "value_steps",
    "value_td": "value_td_steps",
    "safe_set": "classifier_steps",
    "constraint": "classifier_steps",
    "goal": "classifier_steps",
}
#: Demonstrations of each kind that are measured, steps of the VAE, and of each learner alone.
_EPISODES, _VAE_STEPS, _LEARNER_STEPS = 20, 20, 60
#: Gradient steps that are worth forked processes, which a scaled-down phase must have as well.
_ENOUGH = 400


def counts(settings: LS3Settings, horizon: int, frames: Mapping[str, float]) -> dict[Step, int]:
    """How many steps of each kind a run takes.

    Args:
        settings: of the run, as the recipe composes them.
        horizon: of its environment, T.
        frames: that an episode of each kind of offline data leaves in the buffer.

    Returns:
        By phase and kind of step; those of the learners are called as in :class:`~ls3_torchrl.trainers.LS3Trainer`.
    """
    kinds, task, vae, online = ls3_envs.domain(settings.task.name).offline, settings.task, settings.vae, settings.online
    episodes = {kind: task.offline_episodes or data.episodes for kind, data in kinds.items()}
    trained = vae.checkpoint is None
    played = online.updates * online.episodes_per_update
    out: dict[Step, int] = {("data", f"{kind} episode"): count for kind, count in episodes.items()}
    out["VAE", "VAE step"] = vae.steps if trained else 0
    passes = 2 if trained and vae.prediction_weight else 1  # the frames are encoded again in the latents' own units
    out["VAE", "frame encoded"] = passes * round(sum(count * frames[kind] for kind, count in episodes.items()))
    for name, option in _LEARNERS.items():
        if hasattr(settings.offline, option):
            out["offline", name] = getattr(settings.offline, option)
    out["planning", "world-step planned"] = out["planning", "world-step simulated"] = played * horizon
    out["planning", "frame encoded"] = played * (horizon + 1)
    for name, option in _LEARNERS.items():
        if hasattr(online, option):
            out["updates", name] = online.updates * getattr(online, option)
    evaluated = settings.evaluation.episodes * horizon
    out["evaluation", "world-step planned"] = out["evaluation", "world-step simulated"] = evaluated
    return out


class Costs:
    """Measures the seconds of one step of each kind, with what a run would have made.

    Args:
        work: stopwatch and settings of the benchmark.
        settings: of the run.
    """

    def __init__(self, work: Workbench, settings: LS3Settings) -> None:
        self.work, self.settings = work, settings
        self.seconds: dict[Step, float] = {}
        options = {} if settings.task.horizon is None else {"horizon": settings.task.horizon}
        self._options: dict[str, Any] = {"seed": 0, "device": work.device, **options}
        env = self._make_env(settings.online.episodes_per_update)
        self.horizon: int = env.base_env.horizon
        torch.manual_seed(0)
        self.algorithm = LS3(settings, env, work.device)
        self.buffer: TaggedReplayBuffer = self.algorithm.make_buffer(work.device)
        self.frames = self._collect()

    def _make_env(self, worlds: int) -> TransformedEnv:
        return ls3_envs.make(self.settings.task.name, num_envs=worlds, **self._options)

    def measure(self) -> dict[Step, float]:
        """All of them; those of the learners alone, and with the others of their phase as ``"all"``."""
        self._time_vae()
        self._time_learners()
        for phase, worlds in (
            ("planning", self.settings.online.episodes_per_update),
            ("evaluation", self.settings.evaluation.episodes),
        ):
            self._time_worlds(phase, worlds)
        return self.seconds

    def _collect(self) -> dict[str, float]:
        """Demonstrations of every kind, and the frames that an episode leaves in the buffer."""
        frames = {}
        for kind, data in ls3_envs.domain(self.settings.task.name).offline.items():
            count = min(self.settings.task.offline_episodes or data.episodes, _EPISODES)
            start, before = time.perf_counter(), len(self.buffer.frames)
            episodes = ls3_envs.collect_offline(self.settings.task.name, kind, episodes=count, seed=0)
            self.seconds["data", f"{kind} episode"] = (time.perf_counter() - start) / count
            self.buffer.add(episodes, Tag.parse(kind))
            frames[kind] = (len(self.buffer.frames) - before) / count
        return frames

    def _time_vae(self) -> None:
        """A scaled-down run of the VAE, whose terms rise and fall as in a whole one."""
        moments: list[tuple[int, float]] = []
        steps = min(self.settings.vae.steps, _VAE_STEPS)
        options = dataclasses.replace(self.settings.vae, steps=steps, checkpoint=None)
        vae = VAETrainer(self.algorithm.agent, self.buffer, options, progress=False)
        vae.after_step = lambda: moments.append((vae.steps, time.perf_counter()))
        with _silent():
            vae.train()
        taken, encoded = moments[:steps], moments[steps - 1 :]
        if len(taken) > 1:  # the first one also makes what is made once
            self.seconds["VAE", "VAE step"] = (taken[-1][1] - taken[0][1]) / (len(taken) - 1)
        start = time.perf_counter()
        vae.encode()
        each = (time.perf_counter() - start) / len(self.buffer.frames)
        assert encoded
        self.seconds["VAE", "frame encoded"] = self.seconds["planning", "frame encoded"] = each

    def _time_learners(self) -> None:
        trainer, training = self._trainer(), self.settings.training
        alone = {}
        for name, learner in trainer.learners.items():
            learner.train(2, name)
            start = time.perf_counter()
            learner.train(_LEARNER_STEPS, name)
            alone[name] = (time.perf_counter() - start) / _LEARNER_STEPS
        for phase, options in (("offline", training.offline), ("updates", training.online)):
            steps = {name: getattr(options, option) for name, option in _LEARNERS.items() if hasattr(options, option)}
            self.seconds |= {(phase, name): alone[name] for name in steps}
            self.seconds[phase, "all"] = self._time_phase(phase, options, alone, steps)

    def _time_phase(self, phase: str, options: Any, alone: Mapping[str, float], steps: Mapping[str, int]) -> float:
        """Seconds of a step in a scaled-down phase, with its learners side by side as in a run."""
        whole, total = sum(alone[name] * count for name, count in steps.items()), sum(steps.values())
        if not total:
            return 0.0
        fraction = min(1.0, max(5.0 * self.work.settings.seconds / whole, _ENOUGH / total))
        names = {_LEARNERS[name] for name in steps}
        scaled = {name: max(round(fraction * getattr(options, name)), 1) for name in names if getattr(options, name)}
        options = dataclasses.replace(options, **scaled)
        trainer = self._trainer(**{"offline" if phase == "offline" else "online": options})
        start = time.perf_counter()
        (trainer.train_offline if phase == "offline" else trainer.update)()
        return (time.perf_counter() - start) / sum(getattr(options, _LEARNERS[name]) for name in steps)

    def _trainer(self, **changes: Any) -> LS3Trainer:
        training = dataclasses.replace(self.settings.training, **changes)
        return LS3Trainer(self.algorithm.agent, self.buffer, training, progress=False)

    def _time_worlds(self, phase: str, worlds: int) -> None:
        """Steps of worlds side by side: the plans of one batch, and the simulation."""
        name, bench = self.settings.task.name, self.work.bench
        permissive(self.algorithm.agent)  # otherwise plans end early, or start again
        one, env = self._make_env(1), self._make_env(worlds)
        with torch.no_grad():
            for world in (one, env):
                self.algorithm.prepare(world)
            self.algorithm.policy(one.reset())  # what is made once
            start = env.reset()
            what = f"{phase}: plan, {self.settings.preset}, each of {worlds}"
            self.seconds[phase, "world-step planned"] = bench.time(
                what, lambda: self.algorithm.policy(start.copy()), per=worlds, once=True
            )
        time_environment_steps(bench, name, worlds, self.work.device)
        self.seconds[phase, "world-step simulated"] = bench.rows[-1]["median_ms"] / 1e3


@contextmanager
def _silent() -> Iterator[None]:
    """Say nothing of a VAE that was hardly trained."""
    logger = logging.getLogger("ls3_torchrl.trainers.vae")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def estimate(work: Workbench) -> dict[str, Any]:
    """How long a run of the preset ``settings.estimate`` would take on this machine.

    Returns:
        ``rows``, each with ``phase``, ``step``, ``count``, ``ms``, ``hours`` and whether it is ``summed``: learners
        alone are not, since they work side by side; and the sum, ``hours``.
    """
    settings = preset_settings(work.settings.task, work.settings.estimate)
    costs = Costs(work, settings)
    seconds, rows = costs.measure(), []
    many = counts(settings, costs.horizon, costs.frames)
    for (phase, step), count in many.items():
        learner = step in _LEARNERS
        rows.append(_row(phase, step, count, seconds.get((phase, step), 0.0), summed=not learner))
        if learner and step == list(_LEARNERS)[-1]:
            together = sum(n for (other, name), n in many.items() if other == phase and name in _LEARNERS)
            rows.append(_row(phase, "all", together, seconds[phase, "all"], summed=True))
    hours = sum(row["hours"] for row in rows if row["summed"])
    return {"preset": settings.preset, "task": settings.task.name, "rows": rows, "hours": hours}


def _row(phase: str, step: str, count: int, seconds: float, *, summed: bool) -> dict[str, Any]:
    hours = count * seconds / 3600.0
    return {"phase": phase, "step": step, "count": count, "ms": 1e3 * seconds, "hours": hours, "summed": summed}


def estimate_section(found: dict[str, Any]) -> Section:
    """A line for each kind of step, and the sum."""
    lines = []
    for row in found["rows"]:
        hours = f"{row['hours']:.3f}"
        step = "all, side by side" if row["step"] == "all" else row["step"].replace("_", " ")
        cost = milliseconds(row["ms"])[0] if row["ms"] else "0"
        lines.append((row["phase"], step, f"{row['count']:,}", cost, hours if row["summed"] else f"({hours})"))
    lines.append(("total", "", "", "", f"{found['hours']:.2f}"))
    caption = (
        f"{found['task']}, preset {found['preset']}; plans of which every candidate is feasible, the most work; in "
        "parentheses: learners alone on one core, in the line below them side by side. Start-up, probe and pictures "
        "are not in it"
    )
    return Section(f"Estimate for {found['preset']}", ("phase", "step", "count", "ms each", "hours"), lines, caption)
