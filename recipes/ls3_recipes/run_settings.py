"""What can be set in every run, whatever learns: task, data, VAE, number of episodes, evaluation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import ls3_envs
from ls3_recipes.options import from_signatures
from ls3_torchrl._checks import require_at_least, require_choice
from ls3_torchrl.agent import AgentArchitecture
from ls3_torchrl.data import TaggedReplayBuffer
from ls3_torchrl.trainers import VAEOptions


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
        require_choice(self.name, tuple(ls3_envs.DOMAINS), "name")
        for name in ("horizon", "offline_episodes"):
            if getattr(self, name) is not None:
                require_at_least(getattr(self, name), 1, name)


@dataclass(frozen=True, kw_only=True)
class EpisodeSettings:
    """The episodes of online improvement.

    Args:
        updates: rounds of episodes, each followed by an update; 0 for offline training alone.
        episodes_per_update: collected side by side in each round.
        select: ``agent.pt`` is the last agent, or the best, by violations and then return of its own online episodes.
    """

    updates: int = 25
    episodes_per_update: int = 10
    select: Literal["last", "best"] = "last"

    def __post_init__(self) -> None:
        """Refuse numbers that no run can have."""
        require_at_least(self.updates, 0, "updates")
        require_at_least(self.episodes_per_update, 1, "episodes_per_update")
        require_choice(self.select, ("last", "best"), "select")


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """The episodes in which the trained agent is evaluated."""

    episodes: int = 20

    def __post_init__(self) -> None:
        """Refuse an evaluation of nothing."""
        require_at_least(self.episodes, 1, "episodes")


#: The networks' sizes; what the environment decides is not set.
AgentSettings = from_signatures(
    "AgentSettings",
    "The arguments of :class:`~ls3_torchrl.agent.AgentArchitecture` that the environment does not decide.",
    AgentArchitecture,
    without=("action_dim", "in_channels"),
)

BufferSettings = from_signatures(
    "BufferSettings",
    "The arguments of :class:`~ls3_torchrl.data.TaggedReplayBuffer` that matter to every algorithm.",
    TaggedReplayBuffer,
    only=("capacity", "gamma", "success_tail", "dynamics_after_violation"),
)


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """What every run has.

    Args:
        algorithm: what learns; a name in ``ls3_recipes.algorithms.ALGORITHMS``.
        preset: how much effort, as the files in ``conf/preset`` say.
        seed: of everything.
        output: the run's folder; one that exists is never written into.
        data: a folder of episodes made by ``ls3 collect``; ``None`` collects them anew.
        scratch_dir: memory-map the replay buffer in this folder instead of holding it in memory.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        threads: intra-op threads; ``None`` leaves PyTorch's choice.
        pictures: leave pictures in the run's folder.
        task: what is learnt.
        agent: sizes of the networks. To a baseline that reads latents, all of them matter: it makes the whole agent, so
            that with the same seed it draws the same random numbers, and the VAE is LS³'s bit for bit.
        vae: equation (1).
        buffer: what is kept of episodes; ``dynamics_after_violation`` matters to a baseline by the prediction term of
            the VAE alone.
        online: how many episodes.
        evaluation: in how many episodes the agent is evaluated.
    """

    algorithm: str
    preset: str
    output: str
    seed: int = 0
    data: str | None = None
    scratch_dir: str | None = None
    device: str = "auto"
    threads: int | None = None
    pictures: bool = True
    task: TaskSettings
    agent: AgentSettings  # type: ignore[valid-type]
    vae: VAEOptions
    buffer: BufferSettings  # type: ignore[valid-type]
    online: EpisodeSettings
    evaluation: EvaluationSettings

    @property
    def unread(self) -> dict[str, str]:
        """Sections that nothing reads as the settings are, and the setting that would change that."""
        return {}
