"""LS3Agent: all of LS³'s networks together, in one file on disk, with what they were made for."""

from __future__ import annotations

import dataclasses
import inspect
import warnings
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec

from ls3_torchrl._checks import action_bounds, require_choice
from ls3_torchrl.files import load_verified, save_atomically
from ls3_torchrl.modules import (
    ConstraintEstimator,
    EnsembleDynamics,
    GoalEstimator,
    PixelDecoder,
    PixelEncoder,
    SafeSet,
    ValueEnsemble,
)
from ls3_torchrl.options.agent import AgentArchitecture, plain_of
from ls3_torchrl.planners import CrossEntropyMethod, LatentEnv, LS3Planner, Optimizer

FORMAT = "ls3_torchrl.agent"
VERSION = 2
#: The modules of an agent that can be given from outside, in the order of the paper.
PARTS = ("encoder", "decoder", "dynamics", "value", "safe_set", "constraint", "goal")
_PACKAGES = ("ls3-torchrl", "torch", "torchrl", "tensordict")
#: Settings that are gone, in files of before, and the value that is the only one now.
_REMOVED: dict[str, dict[str, Any]] = {
    "architecture": {"propagation": "ts1"},
    "planner": {
        "common_noise": True,
        "constraint_reduction": "max",
        "goal_reduction": "count",
        "min_std": 0.0,
        "pessimism": 0.0,
    },
}


def _storable(name: str, value: Any) -> Any:
    """A setting as a file can hold it."""
    plain = plain_of(value)
    for item in plain if isinstance(plain, tuple) else (plain,):
        if item is not None and type(item) not in (bool, int, float, str, tuple):
            raise ValueError(
                f"The planner setting {name} holds a {type(item).__name__}, which an agent file cannot keep. Give it "
                "as a number, text or tuple, or to planner() after loading."
            )
    return plain


def _one_action(spec: TensorSpec) -> Bounded:
    """The bounds of one action, ``[A]``, of a spec that may be batched."""
    low, high = (bound.cpu() for bound in action_bounds(spec))
    return Bounded(low=low, high=high, shape=low.shape, dtype=spec.dtype)


class LS3Agent(nn.Module):
    """Encoder, decoder, dynamics, value, safe set, constraint and goal, and the planner that acts by them.

    Every module can be one of your own: any that reads and writes what the agent's own does. With an encoder of your
    own there is no decoder unless you give one.

    Args:
        action_dim: A; taken from ``action_spec`` when ``None``.
        action_spec: bounds of an action, ``[A]`` or batched, that :meth:`planner` keeps to.
        planner: settings that :meth:`planner` uses unless others are given: the keyword arguments of
            :class:`~ls3_torchrl.planners.LS3Planner` and :class:`~ls3_torchrl.planners.CrossEntropyMethod`.
        task: name of what the agent is made for; kept in its file.
        encoder: from observations to ``loc`` and ``scale``, or just ``latent``.
        decoder: from ``latent`` to ``reco_pixels``.
        dynamics: f_dyn.
        value: V.
        safe_set: f_S.
        constraint: f_C.
        goal: f_G.
        architecture: sizes and forms of the modules that are not given: the fields of :class:`AgentArchitecture`.

    Raises:
        ValueError: for sizes out of range, or neither ``action_dim`` nor ``action_spec``; by :meth:`load`, for a file
            that is no agent, of another version, or of another shape.
        TypeError: for an unknown setting.

    Example:
        >>> import tempfile
        >>> agent = LS3Agent(action_spec=Bounded(low=-3.0, high=3.0, shape=(2,)), latent_dim=8)
        >>> policy = agent.planner(num_candidates=50, num_elites=5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = agent.save(f"{folder}/agent.pt")
        ...     LS3Agent.load(path).planner().optimizer.num_candidates
        50
    """

    # Any module that reads and writes what the agent's own does.
    encoder: Any
    decoder: Any
    dynamics: Any
    value: Any
    safe_set: Any
    constraint: Any
    goal: Any

    def __init__(
        self,
        action_dim: int | None = None,
        *,
        action_spec: TensorSpec | None = None,
        planner: Mapping[str, Any] | None = None,
        task: str | None = None,
        encoder: TensorDictModuleBase | None = None,
        decoder: TensorDictModuleBase | None = None,
        dynamics: TensorDictModuleBase | None = None,
        value: TensorDictModuleBase | None = None,
        safe_set: TensorDictModuleBase | None = None,
        constraint: TensorDictModuleBase | None = None,
        goal: TensorDictModuleBase | None = None,
        **architecture: Any,
    ) -> None:
        super().__init__()
        self.action_spec = None if action_spec is None else _one_action(action_spec)
        if action_dim is None:
            if self.action_spec is None:
                raise ValueError("LS3Agent needs action_dim, or an action_spec that it can be read from; got neither.")
            action_dim = self.action_spec.shape[-1]
        self.planner_settings = dict(planner or {})
        self.task = None if task is None else str(task)
        #: How far it was trained when its file was written, where the file says so.
        self.stage: str | None = None
        if isinstance(architecture.get("action_scale"), str):
            architecture["action_scale"] = self._half_range(architecture["action_scale"])
        self.architecture = shape = AgentArchitecture(action_dim, **architecture)
        given = dict(zip(PARTS, (encoder, decoder, dynamics, value, safe_set, constraint, goal), strict=True))
        #: Names of the modules that were given from outside.
        self.foreign = tuple(name for name, module in given.items() if module is not None)
        if encoder is None:
            encoder = PixelEncoder(shape.in_channels, shape.latent_dim)
            if decoder is None:
                decoder = PixelDecoder(shape.in_channels, shape.latent_dim, background=shape.background)
        self.encoder, self.decoder = encoder, decoder
        self.dynamics = self._make_dynamics() if dynamics is None else dynamics
        self.value = self._make_value() if value is None else value
        size, hidden = shape.latent_dim, shape.classifier_hidden
        self.safe_set = SafeSet(size, hidden=hidden) if safe_set is None else safe_set
        self.constraint = ConstraintEstimator(size, hidden=hidden) if constraint is None else constraint
        self.goal = GoalEstimator(size, hidden=hidden) if goal is None else goal

    def _half_range(self, word: str) -> list[float]:
        """What ``action_scale="box"`` stands for: half the actions' range."""
        require_choice(word, ("box",), "action_scale, where it is a word,")
        if self.action_spec is None:
            raise ValueError("action_scale='box' needs the actions' bounds: pass action_spec=env.action_spec.")
        space = self.action_spec.space
        return ((space.high - space.low) / 2).tolist()

    def _make_dynamics(self) -> EnsembleDynamics:
        shape = self.architecture
        return EnsembleDynamics(
            shape.latent_dim,
            shape.action_dim,
            num_members=shape.num_dynamics,
            hidden=shape.dynamics_hidden,
            control_affine=shape.control_affine,
            action_scale=shape.action_scale,
        )

    def _make_value(self) -> ValueEnsemble:
        shape = self.architecture
        return ValueEnsemble(
            shape.latent_dim,
            num_members=shape.num_values,
            hidden=shape.value_hidden,
        )

    def planner(
        self, action_spec: TensorSpec | None = None, *, optimizer: Optimizer | None = None, **settings: Any
    ) -> LS3Planner:
        """The policy: an :class:`~ls3_torchrl.planners.LS3Planner` over this agent's modules.

        Bounds and settings are remembered: a file written afterwards holds them, and its agent plans alike. An
        optimiser of one's own is not: pass it again.

        Args:
            action_spec: bounds of one action, shape ``[A]``; a batched spec's first row is taken. Those that the agent
                was made for when ``None``.
            optimizer: in place of the cross-entropy method, whose remembered settings are then left aside.
            settings: of the planner and the cross-entropy method, in place of those that the agent was made for.

        Raises:
            ValueError: when no bounds are known, or for settings out of range.
            TypeError: for an unknown setting.
        """
        spec = self.action_spec if action_spec is None else _one_action(action_spec)
        if spec is None:
            raise ValueError("The bounds of the actions are not known: pass planner(action_spec=env.action_spec).")
        remembered = self.planner_settings
        if optimizer is not None:
            cem = inspect.signature(CrossEntropyMethod).parameters
            remembered = {name: value for name, value in remembered.items() if name not in cem}
        device = next((parameter.device for parameter in self.parameters()), torch.device("cpu"))
        own = {} if hasattr(self.dynamics, "latent_dim") else {"latent_dim": self.architecture.latent_dim}
        model = LatentEnv(self.dynamics, self.constraint, self.goal, action_spec=spec, device=device, **own)
        policy = LS3Planner(
            model, self.value, self.safe_set, self.encoder, optimizer=optimizer, **(remembered | settings)
        )
        # Only what made a planner is remembered.
        self.action_spec, self.planner_settings = spec, self.planner_settings | settings
        return policy

    def save(self, path: str | Path, *, stage: str | None = None, compact: bool = False) -> Path:
        """Write weights and all that the agent was made for to one file; a half-written file never takes its place.

        Args:
            path: the file.
            stage: how far it is trained: ``"vae"`` for one of which the VAE is trained and nothing else, except for
                dynamics that are trained along with it. :class:`~ls3_torchrl.trainers.VAETrainer` takes these as well
                from such a file, and goes on as if it had trained both.
            compact: keep what acts alone, in a fifth of the space, to hand on: no decoder, and weights rounded to
                bfloat16, from which an agent is loaded that computes in float32.

        Raises:
            ValueError: for weights that are not finite, or a planner setting that a file cannot keep.
        """
        weights = self.state_dict()
        _require_finite(weights, f"The agent is not saved to {path}")
        if compact:
            weights = {name: _rounded(weight) for name, weight in weights.items() if not name.startswith("decoder.")}
        spec = self.action_spec
        content = {
            "format": FORMAT,
            "version": VERSION,
            "architecture": dataclasses.asdict(self.architecture),
            "foreign": [name for name in self.foreign if not (compact and name == "decoder")],
            "action_spec": None if spec is None else {"low": spec.space.low.cpu(), "high": spec.space.high.cpu()},
            "planner": {name: _storable(name, value) for name, value in self.planner_settings.items()},
            "task": self.task,
            "stage": stage,
            "compact": compact,
            "decoder": self.decoder is not None and not compact,
            "versions": _versions(),
            "state_dict": weights,
        }
        return save_atomically(content, path, compress=compact)

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        device: torch.device | str = "cpu",
        modules: Mapping[str, TensorDictModuleBase] | None = None,
        **expected: Any,
    ) -> LS3Agent:
        """Read an agent written by :meth:`save`.

        Args:
            path: the file.
            device: where its parameters go.
            modules: the modules by name that the agent was given from outside; the file's weights are loaded into them.
            expected: fields of the architecture that the file must agree with, e.g. ``action_dim=2``.
        """
        path = Path(path)
        content = _read(path)
        given = dict(modules or {})
        foreign = set(content.get("foreign", ()))
        if foreign != set(given):
            raise ValueError(
                f"{path} holds an agent with modules from outside: {', '.join(sorted(foreign)) or 'none'}; received: "
                f"{', '.join(sorted(given)) or 'none'}. Pass just those that it has, as modules={{name: module}}."
            )
        _check_shape(path, content["architecture"], expected)
        agent = cls._of(path, content, given)
        weights = content["state_dict"]
        if content.get("decoder", not content.get("compact")) is False:
            agent.decoder = None
        if content.get("compact"):
            weights = {name: weight.float() if _is_real(weight) else weight for name, weight in weights.items()}
        _require_finite(weights, str(path))
        dtypes = {w.dtype for w in weights.values() if _is_real(w)}
        agent.to(device=device, dtype=dtypes.pop() if len(dtypes) == 1 else None)
        _require_dtypes(path, agent, weights)
        agent.stage = content.get("stage")
        try:
            agent.load_state_dict(weights)
        except (RuntimeError, TypeError) as error:
            which = f"the modules that were given ({', '.join(given)}) or " if given else ""
            raise ValueError(
                f"The weights in {path} do not fit {which}the file's own architecture: {error}. Give modules of the "
                "shapes that were saved; if they are, the file is damaged."
            ) from error
        return agent

    @classmethod
    def _of(cls, path: Path, content: dict[str, Any], given: dict[str, TensorDictModuleBase]) -> LS3Agent:
        """An agent with the settings of a file, and without its weights."""
        bounds = content.get("action_spec")
        try:
            spec = None
            if bounds is not None:
                spec = Bounded(**bounds, shape=bounds["low"].shape, dtype=bounds["low"].dtype)
            return cls(
                **content["architecture"],
                **given,
                action_spec=spec,
                planner=content.get("planner"),
                task=content.get("task"),
            )
        except (TypeError, ValueError, KeyError, AttributeError, RuntimeError) as error:
            raise ValueError(
                f"{path} holds settings that no agent can have ({error}), so it is damaged. Use another copy of it."
            ) from error


def _is_real(weight: Any) -> bool:
    return isinstance(weight, Tensor) and weight.is_floating_point()


def _rounded(weight: Any) -> Any:
    """A weight as a compact file holds it."""
    return weight.to(torch.bfloat16) if _is_real(weight) else weight


def _versions() -> dict[str, str]:
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # used from a checkout that is not installed
            found[name] = "unknown"
    return found


def _read(path: Path) -> dict[str, Any]:
    """The content of an agent file of this version or the one before."""
    content = load_verified(path, f"an agent file ({FORMAT})")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(
            f"{path} is not an agent file ({FORMAT}), or is damaged. Pass a file written by LS3Agent.save()."
        )
    if content.get("version") == 1:
        warnings.warn(
            f"{path} is an agent file of version 1, which keeps neither bounds nor planner settings: pass them to "
            f"planner(), or it plans with the paper's. Save it again to have a file of version {VERSION}.",
            stacklevel=3,
        )
    elif content.get("version") != VERSION:
        raise ValueError(
            f"{path} has version {content.get('version')}, but this library reads versions 1 and {VERSION}. "
            "Train again, or install the library version that wrote it."
        )
    for name, kind in (("architecture", dict), ("state_dict", Mapping)):
        if not isinstance(content.get(name), kind):
            raise ValueError(
                f"{path} is an agent file without {name}, or is damaged. Pass a file written by LS3Agent.save()."
            )
    _drop_removed(path, content)
    return content


def _drop_removed(path: Path, content: dict[str, Any]) -> None:
    """Leave out what is gone, and say where the agent planned otherwise with it. Its weights stay right."""
    content["architecture"].pop("initial_value", None)  # of the value networks, whose weights are known
    for group, removed in _REMOVED.items():
        values = content.get(group)
        if not isinstance(values, dict):
            continue
        for name, only in removed.items():
            value = values.pop(name, only)
            if value != only:
                warnings.warn(
                    f"{path} holds an agent with {name}={value!r}. That setting is gone: it plans now as at {only!r}. "
                    "For the plans of before, install the library version that wrote it.",
                    stacklevel=4,
                )


def _require_finite(weights: Mapping[str, Any], where: str) -> None:
    """Refuse weights with which nobody can act."""
    for name, weight in weights.items():
        if _is_real(weight) and not weight.isfinite().all():
            bad = int((~weight.isfinite()).sum())
            raise ValueError(
                f"{where}: {bad} of {weight.numel()} weights of {name} are NaN or infinite. Use an agent from before "
                "its training diverged."
            )


def _require_dtypes(path: Path, agent: nn.Module, weights: Mapping[str, Any]) -> None:
    """Refuse weights that loading would cast."""
    for name, there in agent.state_dict().items():
        weight = weights.get(name)
        if isinstance(weight, Tensor) and weight.dtype != there.dtype:
            raise ValueError(
                f"{path} has {name} in {weight.dtype}, where {there.dtype} is needed. Give modules of the dtype that "
                "was saved; if they are, the file is damaged."
            )


def _check_shape(path: Path, architecture: dict[str, Any], expected: dict[str, Any]) -> None:
    wanted = {name: plain_of(value) for name, value in expected.items()}
    there = {name: architecture.get(name) for name in wanted}
    differing = [f"{name} {there[name]} instead of {other}" for name, other in wanted.items() if there[name] != other]
    if differing:
        raise ValueError(
            f"{path} holds an agent of another shape: {', '.join(differing)}. Choose a matching checkpoint."
        )
