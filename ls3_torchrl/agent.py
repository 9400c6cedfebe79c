"""LS3Agent: all of LS³'s networks together, in one file on disk."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn
from torchrl.data import TensorSpec

from ls3_torchrl._checks import require_at_least
from ls3_torchrl.files import save_atomically
from ls3_torchrl.modules import (
    ConstraintEstimator,
    EnsembleDynamics,
    GoalEstimator,
    PixelDecoder,
    PixelEncoder,
    SafeSet,
    ValueEnsemble,
)
from ls3_torchrl.planners import LatentEnv, LS3Planner

FORMAT = "ls3_torchrl.agent"
VERSION = 1


@dataclass(frozen=True)
class AgentArchitecture:
    """What an agent is built from; stored beside its weights. Arguments as for :class:`LS3Agent`."""

    action_dim: int
    in_channels: int = 3
    latent_dim: int = 32
    num_dynamics: int = 5
    num_values: int = 5
    dynamics_hidden: tuple[int, ...] = (128, 128)
    value_hidden: tuple[int, ...] = (256, 256, 256)
    classifier_hidden: tuple[int, ...] = (256, 256, 256)
    initial_value: float = 0.0
    propagation: Literal["ts1", "tsinf"] = "ts1"
    control_affine: bool = False
    action_scale: float | tuple[float, ...] = 1.0
    background: bool = False


class LS3Agent(nn.Module):
    """Encoder, decoder, dynamics, value, safe set, constraint and goal; the paper's sizes by default.

    Args:
        action_dim: A.
        in_channels: C, 3 × stacked frames.
        latent_dim: D.
        num_dynamics: members of the dynamics ensemble.
        num_values: members of the value ensemble.
        dynamics_hidden: hidden layers of f_dyn.
        value_hidden: hidden layers of V.
        classifier_hidden: hidden layers of f_S, f_C and f_G.
        initial_value: where the value networks' output biases start.
        propagation: ``"ts1"`` or ``"tsinf"``.
        control_affine: the dynamics' change of the latent is affine in the action.
        action_scale: unit of the actions in the dynamics, one number or one for each of A.
        background: the decoder draws on top of a fixed image.

    Raises:
        ValueError: for sizes below 1 or an unknown propagation; by :meth:`load`, for a file that is no agent,
            of another version, or of another shape.

    Example:
        >>> import tempfile
        >>> from torchrl.data import Bounded
        >>> agent = LS3Agent(action_dim=2, latent_dim=8)
        >>> policy = agent.planner(Bounded(low=-3.0, high=3.0, shape=(2,)), num_candidates=50, num_elites=5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = agent.save(f"{folder}/agent.pt")
        ...     LS3Agent.load(path).architecture.latent_dim
        8
    """

    def __init__(
        self,
        action_dim: int,
        *,
        in_channels: int = 3,
        latent_dim: int = 32,
        num_dynamics: int = 5,
        num_values: int = 5,
        dynamics_hidden: Sequence[int] = (128, 128),
        value_hidden: Sequence[int] = (256, 256, 256),
        classifier_hidden: Sequence[int] = (256, 256, 256),
        initial_value: float = 0.0,
        propagation: Literal["ts1", "tsinf"] = "ts1",
        control_affine: bool = False,
        action_scale: float | Sequence[float] = 1.0,
        background: bool = False,
    ) -> None:
        super().__init__()
        for name, size in (
            ("action_dim", action_dim),
            ("in_channels", in_channels),
            ("latent_dim", latent_dim),
        ):
            require_at_least(size, 1, name)
        self.architecture = AgentArchitecture(
            action_dim=action_dim,
            in_channels=in_channels,
            latent_dim=latent_dim,
            num_dynamics=num_dynamics,
            num_values=num_values,
            dynamics_hidden=tuple(dynamics_hidden),
            value_hidden=tuple(value_hidden),
            classifier_hidden=tuple(classifier_hidden),
            initial_value=initial_value,
            propagation=propagation,
            control_affine=control_affine,
            action_scale=tuple(action_scale) if isinstance(action_scale, Sequence) else action_scale,
            background=background,
        )
        self.encoder = PixelEncoder(in_channels, latent_dim)
        self.decoder = PixelDecoder(in_channels, latent_dim, background=background)
        self.dynamics = EnsembleDynamics(
            latent_dim,
            action_dim,
            num_members=num_dynamics,
            hidden=dynamics_hidden,
            propagation=propagation,
            control_affine=control_affine,
            action_scale=action_scale,
        )
        self.value = ValueEnsemble(latent_dim, num_members=num_values, hidden=value_hidden, initial_value=initial_value)
        self.safe_set = SafeSet(latent_dim, hidden=classifier_hidden)
        self.constraint = ConstraintEstimator(latent_dim, hidden=classifier_hidden)
        self.goal = GoalEstimator(latent_dim, hidden=classifier_hidden)

    def planner(self, action_spec: TensorSpec, **options: Any) -> LS3Planner:
        """The policy: an :class:`~ls3_torchrl.planners.LS3Planner` over this agent's networks.

        Args:
            action_spec: bounds of one action, shape ``[A]``; a batched spec's first row is taken.
            options: passed on to the planner.
        """
        while len(action_spec.shape) > 1:
            action_spec = action_spec[0]
        device = next(self.parameters()).device
        env = LatentEnv(self.dynamics, self.constraint, self.goal, action_spec=action_spec, device=device)
        return LS3Planner(env, self.value, self.safe_set, self.encoder, **options)

    def save(self, path: str | Path) -> Path:
        """Write architecture and weights to one file; a half-written file never takes its place."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "architecture": dataclasses.asdict(self.architecture),
            "state_dict": self.state_dict(),
        }
        return save_atomically(content, path)

    @classmethod
    def load(cls, path: str | Path, *, device: torch.device | str = "cpu", **expected: Any) -> LS3Agent:
        """Read an agent written by :meth:`save`.

        Args:
            path: the file.
            device: where its parameters go.
            expected: arguments of the constructor that the file must agree with, e.g. ``action_dim=2``.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"There is no agent at {path}.")
        advice = f"{path} is not an agent file ({FORMAT}), or is damaged. Pass a file written by LS3Agent.save()."
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
        except (EOFError, RuntimeError, pickle.UnpicklingError) as error:
            raise ValueError(advice) from error
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(advice)
        if content.get("version") != VERSION:
            raise ValueError(
                f"{path} has version {content.get('version')}, but this library reads version {VERSION}. "
                "Train again, or install the library version that wrote it."
            )
        architecture = content["architecture"]
        # Configurations have lists where the file has tuples.
        wanted = {
            name: tuple(v) if isinstance(v, Sequence) and not isinstance(v, str) else v for name, v in expected.items()
        }
        differing = {
            name: (architecture.get(name), value) for name, value in wanted.items() if architecture.get(name) != value
        }
        if differing:
            words = ", ".join(f"{name} {there} instead of {other}" for name, (there, other) in differing.items())
            raise ValueError(f"{path} holds an agent of another shape: {words}. Choose a matching checkpoint.")
        agent = cls(**architecture).to(device)
        try:
            agent.load_state_dict(content["state_dict"])
        except RuntimeError as error:
            raise ValueError(f"{path} does not fit its own architecture; the file is damaged: {error}") from error
        return agent
