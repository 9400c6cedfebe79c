"""What can be set in every run, whatever learns: task, data, VAE, number of episodes, evaluation."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal

from ls3_envs.registry import DOMAINS
from ls3_recipes.options import from_signatures
from ls3_torchrl._values import require_at_least, require_choice, require_positive
from ls3_torchrl.options.agent import AgentArchitecture
from ls3_torchrl.options.buffer import BufferOptions
from ls3_torchrl.options.training import VAEOptions

#: The parts of a run have seeds of their own, up to ten thousand times as large.
_LARGEST_SEED = 10**14
#: Settings that can be changed when a run goes on: where things lie, and not what it does.
CHANGEABLE = ("data", "scratch_dir", "checkpoint_minutes", "pictures", "tracker")


@dataclass(frozen=True, kw_only=True)
class TaskSettings:
    """What is learnt.

    Args:
        name: a domain of ``ls3_envs``.
        horizon: steps of an episode; the domain's own when ``None``.
        offline_episodes: of each kind of offline data; the paper's numbers when ``None``.
    """

    name: str
    horizon: int | None = None
    offline_episodes: int | None = None

    def __post_init__(self) -> None:
        """Refuse unknown domains and empty episodes."""
        require_choice(self.name, tuple(DOMAINS), "name")
        for name in ("horizon", "offline_episodes"):
            if getattr(self, name) is not None:
                require_at_least(getattr(self, name), 1, name)


@dataclass(frozen=True, kw_only=True)
class EpisodeSettings:
    """The episodes of online improvement.

    Args:
        updates: rounds of episodes, each followed by an update; 0 for offline training alone. ``agent.pt`` is the agent
            whose own round went best, by violations and then return; the one after the last update has none.
        episodes_per_update: collected side by side in each round.
    """

    updates: int = 25
    episodes_per_update: int = 10

    def __post_init__(self) -> None:
        """Refuse numbers that no run can have."""
        require_at_least(self.updates, 0, "updates")
        require_at_least(self.episodes_per_update, 1, "episodes_per_update")


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """The episodes in which the trained agent is evaluated."""

    episodes: int = 20

    def __post_init__(self) -> None:
        """Refuse an evaluation of nothing."""
        require_at_least(self.episodes, 1, "episodes")


def require_seed(seed: int, name: str = "seed") -> int:
    """Return a seed that every random stream can start from; raise ``ValueError`` otherwise."""
    if not 0 <= seed <= _LARGEST_SEED:
        raise ValueError(f"{name} must lie between 0 and {_LARGEST_SEED}, got {seed}.")
    return seed


def require_path(path: str | None, name: str) -> None:
    """Raise ``ValueError`` for a path that names nothing."""
    if path is not None and (not path.strip() or "\0" in path):
        raise ValueError(f"{name} must be the path of a file or folder, got {path!r}.")


def require_threads(threads: int | None) -> None:
    """Raise ``ValueError`` for a number of threads that nothing can run on."""
    if threads is not None and threads < 1:
        raise ValueError(f"threads must be at least 1, or null for PyTorch's own choice; got {threads}.")


def require_device_name(name: str) -> None:
    """Raise ``ValueError`` for what is no name of a device; whether it is there is seen when it is used."""
    if not re.fullmatch(r"auto|cpu|cuda(:[0-9]{1,4})?", name):
        raise ValueError(f"device must be auto, cpu, cuda or cuda:N, got {name!r}.")


def _check_architecture(action_scale: Any, **sizes: Any) -> None:
    AgentArchitecture(action_dim=1, **sizes)
    for scale in action_scale if isinstance(action_scale, tuple) else (action_scale,):
        if scale != "box":
            require_positive(scale, "action_scale")


#: The networks' sizes; what the environment decides is not set.
AgentSettings = from_signatures(
    "AgentSettings",
    "The arguments of :class:`~ls3_torchrl.agent.AgentArchitecture` that the environment does not decide.",
    AgentArchitecture,
    without=("action_dim", "in_channels"),
    types={"action_scale": float | tuple[float, ...] | Literal["box"]},
    check=_check_architecture,
)


def require_within(steps: int, episode: int, name: str) -> None:
    """Raise ``ValueError`` for more steps than an episode has."""
    if steps > episode:
        raise ValueError(
            f"{name} must not exceed the {episode} steps of an episode, got {steps}. Lower it, or raise task.horizon."
        )


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """What every run has.

    Args:
        algorithm: what learns; a name in ``ls3_recipes.algorithms.ALGORITHMS``.
        preset: how much effort, as the files in ``conf/preset`` say.
        seed: of everything.
        output: the run's folder; a run that was cut off there goes on. ``None`` for one below ``runs/``.
        checkpoint_minutes: above 0; while training, the run's state is saved this often; also after every round of
            episodes and every update.
        data: a folder of episodes made by ``ls3 collect``; ``None`` collects them anew.
        scratch_dir: memory-map the replay buffer in this folder instead of holding it in memory.
        device: ``"auto"``, ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        threads: intra-op threads, at least 1; ``None`` for PyTorch's choice, which is kept for the whole run.
        pictures: leave pictures in the run's folder.
        tracker: ``"wandb"`` for metrics on Weights & Biases as well; offline with ``WANDB_MODE=offline``.
        task: what is learnt.
        agent: sizes of the networks. To a baseline that reads latents, all of them matter: it makes the whole agent, so
            that with the same seed it draws the same random numbers, and the VAE is LS³'s bit for bit.
        vae: equation (1).
        buffer: what is kept of episodes.
        online: how many episodes.
        evaluation: in how many episodes the agent is evaluated.
    """

    algorithm: str
    preset: str
    output: str | None = None
    checkpoint_minutes: float = 3.0
    seed: int = 0
    data: str | None = None
    scratch_dir: str | None = None
    device: str = "auto"
    threads: int | None = None
    pictures: bool = True
    tracker: Literal["wandb"] | None = None
    task: TaskSettings
    agent: AgentSettings  # type: ignore[valid-type]
    vae: VAEOptions
    buffer: BufferOptions
    online: EpisodeSettings
    evaluation: EvaluationSettings

    def __post_init__(self) -> None:
        """Refuse what no run can have."""
        require_seed(self.seed)
        for name in ("output", "data", "scratch_dir"):
            require_path(getattr(self, name), name)
        require_device_name(self.device)
        require_threads(self.threads)
        require_positive(self.checkpoint_minutes, "checkpoint_minutes")

    def require_horizon(self, steps: int) -> None:
        """Raise ``ValueError`` for a setting that does not fit episodes of so many steps."""
        vae = self.vae
        if vae.prediction_weight and vae.checkpoint is None and not self.unread.get("vae"):
            require_within(vae.prediction_horizon, steps, "vae.prediction_horizon")

    @property
    def unread(self) -> dict[str, str]:
        """Sections that nothing reads as the settings are, and the setting that would change that."""
        return {}
