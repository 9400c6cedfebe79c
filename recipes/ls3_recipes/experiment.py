"""One run of any algorithm: what is carried out, part by part, and what each part leaves on the disk."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.console import console, print_summary
from ls3_recipes.decided import decided
from ls3_recipes.device import choose_device, hardware
from ls3_recipes.figures import Figures, best_update, episode_figures, means_of, summarise
from ls3_recipes.interrupts import Interrupts
from ls3_recipes.offline_data import Offline, collected_data, given_data, tell_of_eviction
from ls3_recipes.options import as_dict
from ls3_recipes.plots.agent import plot_reconstructions
from ls3_recipes.plots.run import pictures_of_run
from ls3_recipes.plots.style import draw
from ls3_recipes.progress import HeldRandomState, Progress, Worlds
from ls3_recipes.resume import begun_with, open_folder
from ls3_recipes.rollout import make_env, run_episodes, tick, whole_episodes
from ls3_recipes.run_settings import RunSettings
from ls3_recipes.run_state import RunState
from ls3_recipes.seeding import seeds
from ls3_recipes.together import require_room, require_tools
from ls3_recipes.tracker import make_tracker
from ls3_torchrl.data import Tag, load_episodes, save_episodes
from ls3_torchrl.files import save_atomically
from ls3_torchrl.trainers import Stateful
from ls3_torchrl.trainers.progress import progress_bar
from ls3_torchrl.trainers.steps import log_scalars

#: Of the online episodes, what figures and pictures need beyond what is learnt from.
_KEPT = ("state", ("next", "state"), ("next", "done"))


class Experiment:
    """One run: its parts in the order of the protocol, each leaving what the next ones need.

    The constructor finds all that can be wrong with the settings, and does no work.

    Args:
        settings: of the run.
        interrupts: what asks it to stop.
    """

    def __init__(self, settings: RunSettings, interrupts: Interrupts) -> None:
        self.device = choose_device(settings.device)
        self.begun = begun_with(settings)
        self.settings, self.seed = decided(settings, self.device, self.begun), seeds(settings.seed)
        settings = self.settings
        self.interrupts = interrupts
        assert settings.threads is not None
        torch.set_num_threads(settings.threads)
        torch.manual_seed(self.seed["learning"])
        self.env = make_env(settings.task, settings.online.episodes_per_update, self.seed["online"], self.device)
        self.horizon: int = self.env.base_env.horizon
        require_tools(settings, self.env.observation_spec["pixels"].shape[-3], self.horizon)
        self.algorithm = ALGORITHMS[settings.algorithm].load()(settings, self.env, self.device)
        self.algorithm.prepare(self.env)
        self.buffer = self.algorithm.make_buffer(self.device)
        self.offline: Offline = {}
        if settings.data is not None:
            needs, name = self.algorithm.needs, self.algorithm.name
            self.offline = given_data(settings.data, settings.task, self.env.action_spec, needs, name)
        require_room(settings, self.offline, self.horizon)
        self.online: list[Figures] = []
        self.tracks: list[torch.Tensor] = []
        self.progress = Progress()
        self.under_way = False  # all that it needs is there
        self.random = HeldRandomState()

    def start(self) -> None:
        """Make the run's folder, or go back to the one in which it was cut off."""
        self.folder = open_folder(self.settings)
        if self.settings.tracker is not None:
            tracker = make_tracker(self.settings.tracker, self.folder.path, as_dict(self.settings))
            self.folder.logger.follow(tracker)
        parts: dict[str, Stateful] = {
            "progress": self.progress,
            "worlds": Worlds(self.env),
            "log": self.folder.logger,
            "random": self.random,
            "algorithm": self.algorithm,
        }
        self.state = RunState(self.folder.states, parts, self.interrupts, self.settings.checkpoint_minutes)

    def collect(self) -> None:
        """Collect the demonstrations, unless they are there, and fill the buffer."""
        settings, path = self.settings, self.folder.path / "demonstrations"
        with self.progress.timed("demonstrations"):
            if not self.offline:
                self.offline = collected_data(path, settings.task, self.seed["demonstrations"], settings.seed)
            for tag, episodes in self.algorithm.offline_data(self.offline).items():
                self.buffer.add(episodes, tag)
        tell_of_eviction(self.buffer, settings.online.updates * settings.online.episodes_per_update * self.horizon)
        self.algorithm.begin(self.buffer, self.folder.logger, self.horizon, self.state.after_step)

    def resume(self) -> None:
        """Take up the state that was saved last, and the episodes that were collected until then."""
        if not self.state.load():
            self.folder.logger.restart()
        checkpoint = self.begun.get("vae", {}).get("checkpoint")
        if checkpoint is not None and self.settings.vae.checkpoint is None and "vae" not in self.progress.phases:
            raise FileNotFoundError(f"vae.checkpoint={checkpoint} is gone, and was not taken over yet. Restore it.")
        if "vae" in self.progress.phases:
            self.algorithm.encode()
        for update in range(1, self.progress.collected + 1):
            episodes = load_episodes(self.folder.episodes(update))[Tag.ONLINE]
            self._remember(episodes)
            self.buffer.add(episodes, Tag.ONLINE)
        self.under_way = True

    def train_offline(self, only: str | None = None) -> None:
        """Carry out the algorithm's offline phases, or one of them."""
        for phase, train in self.algorithm.phases().items():
            if phase not in self.progress.phases and only in (None, phase):
                self.random.release()
                with self.interrupts.deferred():
                    with self.progress.timed(phase):
                        train()
                    if phase == "vae":  # what follows does not depend on whether it was trained here
                        torch.manual_seed(self.seed["models"])
                    self.progress.phases.append(phase)
                    self.state.save()
        if self.progress.collected == 0 and only is None:
            self.algorithm.save(self.folder.agent(0))

    def keep_vae(self) -> Path:
        """Leave the trained VAE alone, for other runs."""
        agent = self.algorithm.vae_agent
        if agent is None:
            raise ValueError(f"{self.algorithm.name} has no VAE with these settings: its networks read images.")
        path = agent.save(self.folder.path / "vae.pt", stage="vae")
        draw({"reconstructions.png": lambda: plot_reconstructions(self.folder.path, agent, self.offline)})
        self.folder.write_json("summary.json", {"vae": str(path), "minutes": self.folder.minutes})
        self.folder.states.remove()
        (self.folder.path / "checkpoints").rmdir()
        return path

    def improve_online(self) -> None:
        """Collect episodes with the policy and learn from them, round by round."""
        updates, frames = self.settings.online.updates, self.settings.online.episodes_per_update * self.horizon
        left = updates - self.progress.collected
        bar = progress_bar(self.horizon, "Planning")

        def after_step(*_: object) -> None:
            tick(bar)
            self.interrupts.check()  # a signal that came while C code called Python was swallowed there

        ticking = self.algorithm.policy.register_forward_hook(after_step)
        if self.progress.collected == 0:
            self.random.release()  # that state was saved before there was a collector
        rounds = iter(self._collector(frames, left)) if left else iter(())
        self.random.release()
        for update in range(self.progress.updated + 1, updates + 1):
            if update > self.progress.collected:
                bar.reset(total=self.horizon)
                bar.set_description_str(f"{f'Episodes, update {update}/{updates}':<24}")
                with self.progress.timed("planning"):
                    episodes = whole_episodes(next(rounds))
                with self.interrupts.deferred():
                    self._keep_episodes(update, episodes)
            with self.interrupts.deferred():
                with self.progress.timed("updates"):
                    self.algorithm.update()
                self.algorithm.save(self.folder.agent(update))
                self.folder.thin_out_agents(updates, update, best_update(self.online))
                self.progress.updated = update
                self.state.save()
        ticking.remove()
        bar.close()

    def _collector(self, frames: int, rounds: int) -> Collector:
        return Collector(
            self.env,
            self.algorithm.policy,
            frames_per_batch=frames,
            total_frames=rounds * frames,
            device=self.device,
        )

    def _keep_episodes(self, update: int, episodes: TensorDictBase) -> None:
        """Bring the episodes of a round to the disk, before anything is learnt from them."""
        path = self.folder.episodes(update)
        if path.exists():  # of a process that ended before its state was saved: they are collected again
            shutil.rmtree(path)
        kept = episodes.select(*self.buffer.keys.required, *self.buffer.extra_keys, *_KEPT, strict=False)
        save_episodes({Tag.ONLINE: kept}, path, task=self.settings.task.name, seed=self.settings.seed)
        self._record(update, episodes)
        self.buffer.add(kept, Tag.ONLINE)
        self.progress.collected = update
        self.state.save()

    def _record(self, update: int, episodes: TensorDictBase) -> None:
        """Tell how the episodes of a round went."""
        means = means_of(self._remember(episodes))
        step = update * self.settings.online.episodes_per_update
        log_scalars(self.folder.logger, "online", step, means | self.algorithm.describe(episodes))
        console.print(
            f"  update {update}: return {means['mean_return']:.1f}, success {means['mean_success']:.0%}, "
            f"violation {means['mean_violation']:.0%}"
        )

    def _remember(self, episodes: TensorDictBase) -> Figures:
        """Keep how the episodes of a round went."""
        figures = episode_figures(episodes)
        self.online.append(figures)
        self.tracks.append(episodes["next", "state"].cpu())
        return figures

    def select(self) -> None:
        """Keep the agent whose online episodes went best: fewest violations, then the highest return."""
        if self.online:
            # An agent that acted, and is known by its episodes; the last one never did.
            best = best_update(self.online)
            self.algorithm.restore(self.folder.agent(best))
            console.print(f"agent.pt is {self.folder.agent(best).name}, whose episodes went best")
        self.agent_file = self.algorithm.save(self.folder.path / "agent.pt").name

    def evaluate(self) -> None:
        """Let the agent act without exploring, and ask what it has learnt."""
        settings = self.settings
        with self.progress.timed("evaluation"):
            env = make_env(settings.task, settings.evaluation.episodes, self.seed["evaluation"], self.device)
            self.algorithm.prepare(env)
            self.evaluation = run_episodes(env, self.algorithm.policy, what="Evaluation")
        self.interrupts.check()
        with self.progress.timed("probe"):
            self.probe = self.algorithm.diagnose(self.offline, self.evaluation)

    def finish(self) -> dict:
        """Leave the summary, then pictures, then both."""
        summary = self._summary()
        self._write(summary)
        if self.settings.pictures:
            with self.progress.timed("pictures"):
                failed = self._draw()
            summary |= {"failed_pictures": failed} if failed else {}
            self._write(summary)
        self.folder.states.remove()
        print_summary(summary, self.folder.path)
        return summary

    def _draw(self) -> dict[str, str]:
        """Draw all pictures; those that failed, with the reasons."""
        folder = self.folder.path
        save_atomically(self.tracks, folder / "online_tracks.pt")
        check = self.interrupts.check  # between pictures: C code swallows what a signal raises below it
        failed = draw(pictures_of_run(folder, self.settings.task, self.offline, self.tracks, self.evaluation), check)
        return failed | draw(self.algorithm.pictures(folder, self.offline, self.evaluation), check)

    def _write(self, summary: dict) -> None:
        summary["minutes"] = self.folder.minutes
        summary |= self.progress.spent()
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
