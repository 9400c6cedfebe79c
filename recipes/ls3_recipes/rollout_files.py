"""The files that tell how the agent of every update did."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ls3_recipes.run_files import read_json


def number_of(agent: Path) -> int:
    """The update that an agent's file is of."""
    return int(agent.stem.removeprefix("agent_"))


def file_of(run: str | Path, agent: Path) -> Path:
    """Where it is kept how an agent did."""
    return Path(run) / "rollouts" / f"{agent.stem}.json"


def agents_left(run: str | Path, episodes: int) -> Iterator[Path]:
    """The agents of a run that have not acted in so many episodes."""
    for agent in sorted(Path(run).glob("checkpoints/agent_*.pt")):
        file = file_of(run, agent)
        if not file.is_file() or len(read_json(file).get("return", [])) != episodes:
            yield agent
