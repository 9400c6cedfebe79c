"""The protocol that every algorithm follows: demonstrations, offline training, online improvement, evaluation."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.console import console, print_summary
from ls3_recipes.device import choose_device, hardware
from ls3_recipes.figures import Figures, best_update, episode_figures, means_of, summarise
from ls3_recipes.options import as_dict
from ls3_recipes.plots.run import pictures_of_run
from ls3_recipes.plots.style import draw
from ls3_recipes.rollout import collect_demonstrations, make_env, run_episodes, tick, whole_episodes
from ls3_recipes.run_folder import RunFolder, require_new
from ls3_recipes.run_settings import RunSettings
from ls3_recipes.together import require_room, require_tools
from ls3_torchrl.data import Tag, check_datasets, load_episodes, save_episodes
from ls3_torchrl.trainers.learner import log_scalars
from ls3_torchrl.trainers.progress import progress_bar

Offline = dict[Tag, TensorDictBase]


def run_experiment(settings: RunSettings) -> dict:
    """Follow the protocol from demonstrations to pictures.

    Args:
        settings: of the run; an instance of its algorithm's ``settings_class``.

    Returns:
        What is written to ``summary.json``.

    Raises:
        ValueError, FileNotFoundError, FileExistsError: for settings, data or folders that cannot be used; before any
            work is done.
    """
    experiment = Experiment(settings)
    experiment.start()
    experiment.collect()
    experiment.train_offline()
    experiment.improve_online()
    experiment.select()
    experiment.evaluate()
    return experiment.finish()


def seeds(seed: int) -> dict[str, int]:
    """Seeds of the parts of a run, far apart, so that no two share a random stream."""
    names = ("demonstrations", "online", "evaluation", "learning")
    return {name: 10_000 * seed + 1_000 * i for i, name in enumerate(names)}


class Experiment:
    """One run: its parts in the order of :func:`run_experiment`, each leaving what the next ones need.

    The constructor finds all that can be wrong with the settings, and does no work.

    Args:
        settings: of the run.
    """

    def __init__(self, settings: RunSettings) -> None:
        require_new(settings.output)
        self.settings, self.seed = settings, seeds(settings.seed)
        self.device = choose_device(settings.device)
        if settings.threads:
            torch.set_num_threads(settings.threads)
        torch.manual_seed(self.seed["learning"])
        self.env = make_env(settings.task, settings.online.episodes_per_update, self.seed["online"], self.device)
        self.horizon: int = self.env.base_env.horizon
        require_tools(settings, self.env.observation_spec["pixels"].shape[-3], self.horizon)
        self.algorithm = ALGORITHMS[settings.algorithm](settings, self.env, self.device)
        self.algorithm.prepare(self.env)
        self.buffer = self.algorithm.make_buffer(self.device)
        self.offline: Offline = self._given_data() if settings.data else {}
        require_room(settings, self.offline, self.horizon)
        self.online: list[Figures] = []
        self.tracks: list[torch.Tensor] = []
        self.seconds: dict[str, float] = {}

    def _given_data(self) -> Offline:
        """The offline data that the settings name."""
        assert self.settings.data is not None
        offline = load_episodes(self.settings.data, task=self.settings.task.name)
        for tag in self.algorithm.needs:
            if tag not in offline:
                raise ValueError(
                    f"{self.settings.data} has no {tag.name.lower()} episodes, which {self.algorithm.name} needs. "
                    "Collect them first."
                )
        try:
            check_datasets(offline, action_spec=self.env.action_spec)
        except (ValueError, TypeError, KeyError) as error:
            raise type(error)(f"data={self.settings.data}: {error}") from error
        return offline

    @contextmanager
    def _timed(self, phase: str) -> Iterator[None]:
        """Add the block's wall-clock seconds to those of a phase."""
        start = time.perf_counter()
        yield
        self.seconds[phase] = self.seconds.get(phase, 0.0) + time.perf_counter() - start

    def start(self) -> None:
        """Make the run's folder."""
        self.folder = RunFolder(self.settings.output, as_dict(self.settings))

    def collect(self) -> None:
        """Collect the demonstrations, unless they were given, and fill the buffer."""
        task, seed = self.settings.task, self.settings.seed
        with self._timed("demonstrations"):
            if not self.offline:
                with torch.random.fork_rng():  # what is learnt does not depend on whether the data were there already
                    collected = collect_demonstrations(task, self.seed["demonstrations"])
                path = save_episodes(collected, self.folder.path / "demonstrations", task=task.name, seed=seed)
                self.offline = load_episodes(path)  # from the disk from now on: there may be more than memory
            for tag, episodes in self.algorithm.offline_data(self.offline).items():
                self.buffer.add(episodes, tag)

    def train_offline(self) -> None:
        """Carry out the algorithm's offline phases."""
        self.algorithm.begin(self.buffer, self.folder.logger, self.horizon)
        for phase, train in self.algorithm.phases().items():
            with self._timed(phase):
                train()
        self.algorithm.save(self.folder.checkpoint(0))

    def improve_online(self) -> None:
        """Collect episodes with the policy and learn from them, round by round."""
        updates, frames = self.settings.online.updates, self.settings.online.episodes_per_update * self.horizon
        if updates == 0:
            return
        bar = progress_bar(self.horizon, "Planning")
        ticking = self.algorithm.policy.register_forward_hook(lambda *_: tick(bar))
        collector = Collector(
            self.env,
            self.algorithm.policy,
            frames_per_batch=frames,
            total_frames=updates * frames,
            device=self.device,
        )
        rounds = iter(collector)
        for update in range(1, updates + 1):
            bar.reset(total=self.horizon)
            bar.set_description_str(f"{f'Episodes, update {update}/{updates}':<24}")
            with self._timed("planning"):
                episodes = whole_episodes(next(rounds))
            self._record(update, episodes)
            self.buffer.add(episodes, Tag.ONLINE)
            with self._timed("updates"):
                self.algorithm.update()
            self.algorithm.save(self.folder.checkpoint(update))
        ticking.remove()
        bar.close()
        collector.shutdown()

    def _record(self, update: int, episodes: TensorDictBase) -> None:
        """Keep and tell how the episodes of a round went."""
        figures = episode_figures(episodes)
        self.online.append(figures)
        self.tracks.append(episodes["next", "state"].cpu())
        means = means_of(figures)
        step = update * self.settings.online.episodes_per_update
        log_scalars(self.folder.logger, "online", step, means | self.algorithm.describe(episodes))
        console.print(
            f"  update {update}: return {means['mean_return']:.1f}, success {means['mean_success']:.0%}, "
            f"violation {means['mean_violation']:.0%}"
        )

    def select(self) -> None:
        """Keep the agent: the last one, or the one whose episodes went best."""
        if self.settings.online.select == "best" and self.online:
            # An agent that acted, and is known by its episodes; the last one never did.
            best = best_update(self.online)
            self.algorithm.restore(self.folder.checkpoint(best))
            console.print(f"agent.pt is the agent of update {best + 1}, whose episodes went best")
        self.agent_file = self.algorithm.save(self.folder.path / "agent.pt").name

    def evaluate(self) -> None:
        """Let the agent act without exploring, and ask what it has learnt."""
        settings = self.settings
        with self._timed("evaluation"):
            env = make_env(settings.task, settings.evaluation.episodes, self.seed["evaluation"], self.device)
            self.algorithm.prepare(env)
            self.evaluation = run_episodes(env, self.algorithm.policy, what="Evaluation")
        with self._timed("probe"):
            self.probe = self.algorithm.diagnose(self.offline, self.evaluation)

    def finish(self) -> dict:
        """Leave the summary, then pictures, then both."""
        summary = self._summary()
        self._write(summary)
        if self.settings.pictures:
            with self._timed("pictures"):
                failed = self._draw()
            summary |= {"failed_pictures": failed} if failed else {}
            self._write(summary)
        self.folder.close()
        print_summary(summary, self.folder.path)
        return summary

    def _draw(self) -> dict[str, str]:
        """Draw all pictures; those that failed, with the reasons."""
        folder = self.folder.path
        torch.save(self.tracks, folder / "online_tracks.pt")
        failed = draw(pictures_of_run(folder, self.settings.task, self.offline, self.tracks, self.evaluation))
        return failed | draw(self.algorithm.pictures(folder, self.offline, self.evaluation))

    def _write(self, summary: dict) -> None:
        summary["minutes"] = self.folder.minutes
        summary["seconds"] = {name: round(value, 1) for name, value in self.seconds.items()}
        self.folder.write_json("summary.json", summary)

    def _summary(self) -> dict:
        return {
            "algorithm": self.algorithm.name,
            "task": self.settings.task.name,
            "preset": self.settings.preset,
            "seed": self.settings.seed,
            "minutes": 0.0,
            "demonstrations": summarise([episode_figures(self.offline[Tag.SUCCESS])]),
            "probe": self.probe,
            **({"online": summarise(self.online)} if self.online else {}),
            "evaluation": summarise([episode_figures(self.evaluation)]),
            "hardware": hardware(self.device),
            "agent": self.agent_file,
        }
