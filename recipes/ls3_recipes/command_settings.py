"""What can be set of the commands beside ``ls3 train``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, make_dataclass, replace
from typing import Any, Literal, get_type_hints

from ls3_envs.registry import DOMAINS
from ls3_recipes.options import as_dict
from ls3_recipes.run_settings import TaskSettings, require_device_name, require_path, require_seed, require_threads
from ls3_recipes.typed import did_you_mean
from ls3_torchrl._values import require_at_least, require_choice, require_positive
from ls3_torchrl.options.planner import PlannerOptions


@dataclass(frozen=True, kw_only=True)
class CollectSettings:
    """What is collected, and where it goes.

    Args:
        task: whose episodes.
        seed: of environments and demonstrators.
        output: a folder that does not exist yet.
    """

    task: TaskSettings
    seed: int = 0
    output: str

    def __post_init__(self) -> None:
        """Refuse what cannot be collected."""
        require_seed(self.seed)
        require_path(self.output, "output")
        if self.task.horizon is not None:
            raise ValueError(
                f"task.horizon matters to ls3 train alone, got {self.task.horizon}: offline episodes have the domain's "
                "own length. Leave it out."
            )


#: In place of a setting, the one that the run has.
AS_TRAINED = "as trained"
#: Each planner setting in place of the run's.
PlannerChanges = make_dataclass(
    "PlannerChanges",
    [
        (name, hint | Literal["as trained"], field(default=AS_TRAINED))
        for name, hint in get_type_hints(PlannerOptions).items()
    ],
    frozen=True,
)


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings:
    """What is evaluated, and how.

    Args:
        run: folder of a finished run.
        agent: file in it; without ``run``, the task whose agent comes with this package.
        policy: ``"trained"``, the run's own, or ``"random"``, uniform actions on its task.
        filter: folder of a run of LS³ on the same task, or that task's name for the agent that comes with this
            package; its model lets the policy's actions through or replaces them
            (:class:`~ls3_torchrl.planners.SafeSetFilter`); ``None`` for none.
        episodes: side by side.
        seed: of the environments.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        output: a folder that does not exist yet.
        planner: settings in place of the run's, for LS³ alone; where there is a filter, in place of the filter's.
    """

    run: str
    agent: str = "agent.pt"
    policy: Literal["trained", "random"] = "trained"
    filter: str | None = None
    episodes: int = 20
    seed: int = 12345
    device: str = "auto"
    output: str
    planner: PlannerChanges = field(default_factory=PlannerChanges)  # type: ignore[valid-type]

    def __post_init__(self) -> None:
        """Refuse an evaluation of nothing."""
        require_at_least(self.episodes, 1, "episodes")
        require_seed(self.seed)
        require_device_name(self.device)
        require_choice(self.policy, ("trained", "random"), "policy")
        for name in ("run", "agent", "output", *(() if self.filter is None else ("filter",))):
            require_path(getattr(self, name), name)

    @property
    def planner_changes(self) -> dict[str, Any]:
        """The planner's settings that differ from the run's."""
        return {name: value for name, value in as_dict(self.planner).items() if value != AS_TRAINED}


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings:
    """Whose thresholds are calibrated, and how.

    Args:
        run: folder of a finished run of LS³.
        agent: file in it; without ``run``, the task whose agent comes with this package.
        alpha: largest shares of violations that may be missed, each in (0, 1).
        episodes: violating ones to collect; one half finds the thresholds, the other tests them.
        data: a folder of episodes made by ``ls3 collect``, that the run has not learnt from, in place of these.
        seed: of the violations, and of how they are halved.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        output: a folder that does not exist yet.
    """

    run: str
    agent: str = "agent.pt"
    alpha: tuple[float, ...] = (0.01, 0.05, 0.1, 0.2)
    episodes: int = 400
    data: str | None = None
    seed: int = 54321
    device: str = "auto"
    output: str

    def __post_init__(self) -> None:
        """Refuse what bounds nothing."""
        if not self.alpha or not all(0.0 < alpha < 1.0 for alpha in self.alpha):
            raise ValueError(f"alpha must hold numbers between 0 and 1, such as [0.05,0.1]; got {list(self.alpha)}.")
        require_at_least(self.episodes, 2, "episodes")
        require_seed(self.seed)
        require_device_name(self.device)
        for name in ("run", "agent", "data", "output"):
            require_path(getattr(self, name), name)


@dataclass(frozen=True, kw_only=True)
class ReportSettings:
    """What is reported, and where it goes.

    Args:
        runs: folders of runs, or with runs below them; one alone need not be a list.
        title: of the page.
        output: a folder that does not exist yet.
    """

    runs: tuple[str, ...] | str = ()
    title: str = "Runs"
    output: str

    def __post_init__(self) -> None:
        """Take a single folder as a list of one, and refuse none."""
        if isinstance(self.runs, str):
            object.__setattr__(self, "runs", (self.runs,))
        if not self.runs:
            raise ValueError("No runs: pass their folders, or one that holds them: ls3 report FOLDER [FOLDER ...].")
        for path in (*self.runs, self.output):
            require_path(path, "output" if path is self.output else "runs")


@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """Which runs, where they are carried out, and what is made of them.

    Args:
        title: of the report.
        arms: arguments of ``ls3 train`` for each; several values of a setting are as many runs.
        settings: arguments for all arms.
        rollouts: episodes in which the agent of every update is evaluated; 0 for none.
        output: a folder; a sweep that was begun there goes on.
        launcher: of ``hydra/launcher``.
    """

    title: str = "Runs"
    arms: tuple[tuple[str, ...], ...] = ((),)
    settings: tuple[str, ...] = ()
    rollouts: int = 0
    output: str
    launcher: Any = None

    def __post_init__(self) -> None:
        """Refuse a sweep of nothing."""
        require_at_least(self.rollouts, 0, "rollouts")
        require_path(self.output, "output")
        if not self.arms:
            raise ValueError("arms must hold at least one list of arguments, got none: arms=[[]] is a run as it is.")


#: Figures of cost as work grows.
GROWING = ("candidates", "particles", "horizon", "worlds", "episodes", "images")
#: All figures, in the order in which they are measured.
FIGURES = ("planning", "updates", "vae", "environments", "buffer", *GROWING, "estimate", "kernels", "runs")


@dataclass(frozen=True, kw_only=True)
class BenchmarkSettings:
    """What is timed.

    Args:
        figures: which of :data:`FIGURES`; all when ``None``.
        task: whose images and actions.
        presets: whose planners and updates are timed; cost as work grows is that of the first.
        domains: whose steps with pixels are timed; all when ``None``.
        batches: environments planned for at once, and stepped at once.
        estimate: the preset of which the time of a whole run is estimated.
        runs: presets of which whole runs are timed; one of ``paper`` takes hours.
        agent: a trained ``agent.pt``, to see what bf16 changes in its plans with each preset's planner.
        states: images of demonstrations that it plans from.
        seconds: at least, for each figure.
        smoke: everything at its smallest, to see that it works: presets, domains, batches, runs and seconds.
        reference: also time the reference, which takes most of the time.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        threads: intra-op threads; ``None`` leaves PyTorch's choice.
        output: a folder that does not exist yet.
    """

    figures: tuple[str, ...] | None = None
    task: str = "navigation"
    presets: tuple[str, ...] = ("cpu", "paper")
    domains: tuple[str, ...] | None = None
    batches: tuple[int, ...] = (1, 8, 32)
    estimate: str = "paper"
    runs: tuple[str, ...] = ("smoke",)
    agent: str | None = None
    states: int = 100
    seconds: float = 2.0
    smoke: bool = False
    reference: bool = True
    device: str = "auto"
    threads: int | None = None
    output: str

    def __post_init__(self) -> None:
        """Refuse what cannot be timed; encoder and buffer are timed at the first preset's sizes."""
        _require_figures(self.figures)
        for name, example in (("presets", "cpu"), ("batches", "1"), ("runs", "cpu")):
            if not getattr(self, name):
                raise ValueError(f"{name} must name at least one, such as {name}=[{example}]; got none.")
        require_choice(self.task, tuple(DOMAINS), "task")
        for domain in self.domains or ():
            require_choice(domain, tuple(DOMAINS), "domains")
        for batch in self.batches:
            require_at_least(batch, 1, "batches")
        require_at_least(self.states, 1, "states")
        require_positive(self.seconds, "seconds")
        require_device_name(self.device)
        require_threads(self.threads)
        for name in ("output", "agent"):
            require_path(getattr(self, name), name)

    @property
    def chosen(self) -> tuple[str, ...]:
        """The figures that are asked for, in the order of :data:`FIGURES`."""
        return tuple(name for name in FIGURES if self.figures is None or name in self.figures)

    def at_their_size(self) -> BenchmarkSettings:
        """These settings, with ``smoke`` carried out."""
        if not self.smoke:
            return self
        one = ("smoke",)
        small = {"presets": one, "runs": one, "estimate": "smoke", "batches": (1, 2), "domains": (self.task,)}
        return replace(self, **small, seconds=0.01)  # type: ignore[arg-type]


def _require_figures(figures: Iterable[str] | None) -> None:
    if figures is None:
        return
    unknown = [name for name in figures if name not in FIGURES]
    if unknown or not tuple(figures):
        hint = did_you_mean(unknown[0], FIGURES) if unknown else ""
        got = ", ".join(map(repr, unknown)) or "none"
        raise ValueError(
            f"figures must be some of {', '.join(FIGURES)}; got {got}{hint or '.'} "
            f"Write figures=[{FIGURES[0]},{FIGURES[1]}], for example, or leave it out to measure all."
        )
