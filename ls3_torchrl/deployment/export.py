"""The networks in files that other programs run: torch.export, and ONNX."""

from __future__ import annotations

import copy
import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from ls3_torchrl._checks import require_choice
from ls3_torchrl.agent import LS3Agent
from ls3_torchrl.data.packages import require_package
from ls3_torchrl.modules.call import call_on_latent, encode
from ls3_torchrl.modules.classifiers import probability_of
from ls3_torchrl.modules.dynamics import EnsembleDynamics
from ls3_torchrl.modules.vae import IMAGE_SIZE
from ls3_torchrl.options.planner import ControlOptions

Format = Literal["torch", "onnx"]
_SUFFIX = {"torch": ".pt2", "onnx": ".onnx"}
#: What describes the files.
DESCRIPTION = "modules.json"


class _Part(NamedTuple):
    """One file: a network of tensors, an example of each input ``[B, ...]``, and what comes out."""

    network: nn.Module
    inputs: dict[str, Tensor]
    outputs: tuple[str, ...]


class _Encoder(nn.Module):
    def __init__(self, encoder: TensorDictModuleBase) -> None:
        super().__init__()
        self.encoder: Any = encoder

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        key = self.encoder.in_keys[0]
        return encode(self.encoder, TensorDict({key: pixels}, [pixels.shape[0]]))


class _Dynamics(nn.Module):
    def __init__(self, dynamics: EnsembleDynamics) -> None:
        super().__init__()
        self.dynamics: Any = dynamics

    def forward(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        return self.dynamics.distribution(latent, action)


class _Head(nn.Module):
    def __init__(self, head: TensorDictModuleBase, *, probability: bool) -> None:
        super().__init__()
        self.head: Any = head
        self.probability = probability

    def forward(self, latent: Tensor) -> Tensor:
        if self.probability:
            return probability_of(self.head, latent)
        return call_on_latent(self.head, latent)


def export_modules(agent: LS3Agent, folder: str | Path, *, format: Format = "torch") -> dict[str, Path]:
    """Write encoder, dynamics and heads of an agent as files that run without this library.

    A monitor beside another controller, for example, needs the encoder, f_C and f_S alone. Every file takes batches of
    any size B, computes in float32, and is deterministic:

    - ``encoder`` takes ``pixels`` uint8 ``[B, C, 64, 64]``, gives ``loc``, ``scale`` ``[B, D]``: q(z|s) of equation (1)
    - ``dynamics`` takes ``latent`` ``[B, D]``, ``action`` ``[B, A]``, gives ``loc``, ``scale``
      ``[B, M, D]`` of each member
    - ``value`` takes ``latent``, gives ``state_value`` ``[B, M, 1]``: V of equation (3), (4)
    - ``safe_set`` takes ``latent``, gives ``safe_set_prob`` ``[B, 1]``: f_S of equation (5)
    - ``constraint`` takes ``latent``, gives ``constraint_prob`` ``[B, 1]``: f_C
    - ``goal`` takes ``latent``, gives ``goal_prob`` ``[B, 1]``: f_G

    Args:
        agent: whose; it is not changed.
        folder: where the files go; it is made if need be, and files of the same names are replaced.
        format: ``"torch"`` for ``.pt2``, which ``torch.export.load`` reads; ``"onnx"`` for ``.onnx``, which ONNX
            Runtime and many others read.

    Returns:
        The files by name. Beside them lies ``modules.json``: names, shapes and dtypes of what goes in and comes out,
        the actions' bounds and the planner's thresholds.

    Raises:
        ValueError: for another format, or an agent whose encoder, dynamics or heads are not those of this library: what
            a module from outside reads and writes is not known here.
        ModuleNotFoundError: for ONNX without the package ``onnxscript``.

    Example:
        >>> import tempfile
        >>> agent = LS3Agent(2, latent_dim=8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     files = export_modules(agent, folder)
        ...     constraint = torch.export.load(files["constraint"]).module()
        >>> constraint(torch.zeros(3, 8)).shape
        torch.Size([3, 1])
    """
    require_choice(format, ("torch", "onnx"), "format")
    foreign = [name for name in agent.foreign if name != "decoder"]
    if foreign:
        raise ValueError(
            f"The agent's {', '.join(foreign)} came from outside: what such modules read and write is not known here. "
            "Export them by torch.export.export, and with this function an agent whose modules are its own."
        )
    if format == "onnx":
        require_package("onnxscript", "format='onnx'", extra="deployment")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files, parts = {}, _parts(agent)
    for name, part in parts.items():
        files[name] = folder / f"{name}{_SUFFIX[format]}"
        _write(part, files[name], format)
    (folder / DESCRIPTION).write_text(json.dumps(_describe(agent, parts, files), indent=2) + "\n", encoding="utf-8")
    return files


def _parts(agent: LS3Agent) -> dict[str, _Part]:
    shape = agent.architecture
    # Two rows: a batch of one would be taken for a fixed size.
    latent, action = torch.zeros(2, shape.latent_dim), torch.zeros(2, shape.action_dim)
    pixels = torch.zeros(2, shape.in_channels, IMAGE_SIZE, IMAGE_SIZE, dtype=torch.uint8)
    parts = {
        "encoder": _Part(_Encoder(agent.encoder), {"pixels": pixels}, ("loc", "scale")),
        "dynamics": _Part(_Dynamics(agent.dynamics), {"latent": latent, "action": action}, ("loc", "scale")),
        "value": _Part(_Head(agent.value, probability=False), {"latent": latent}, ("state_value",)),
    }
    for name in ("safe_set", "constraint", "goal"):
        head = _Head(getattr(agent, name), probability=True)
        parts[name] = _Part(head, {"latent": latent}, (f"{name}_prob",))
    # Copies, as the files compute: on the CPU and in float32, whatever the agent does.
    return {name: part._replace(network=_copy(part.network)) for name, part in parts.items()}


def _copy(network: nn.Module) -> nn.Module:
    return copy.deepcopy(network).to("cpu", torch.float32).eval().requires_grad_(False)


def _write(part: _Part, path: Path, format: Format) -> None:
    batch = torch.export.Dim("batch")
    exported = torch.export.export(
        part.network,
        tuple(part.inputs.values()),
        dynamic_shapes={name: {0: batch} for name in part.inputs},
        strict=False,
    )
    if format == "torch":
        torch.export.save(exported, path)
        return
    with _quiet():
        program = torch.onnx.export(
            exported,
            input_names=list(part.inputs),
            output_names=list(part.outputs),
            dynamo=True,
            verbose=False,
        )
    assert program is not None  # None is for a file name
    program.save(path)


@contextmanager
def _quiet() -> Iterator[None]:
    """Meanwhile PyTorch does not tell of operators of a package that nothing here needs."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _describe(agent: LS3Agent, parts: dict[str, _Part], files: dict[str, Path]) -> dict[str, Any]:
    """What a reader of the files must know to use them."""
    described: dict[str, Any] = {"task": agent.task, "modules": {}}
    for name, part in parts.items():
        inputs = {
            key: [str(value.dtype).removeprefix("torch."), "B", *value.shape[1:]] for key, value in part.inputs.items()
        }
        with torch.no_grad():
            outputs = part.network(*part.inputs.values())
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        shapes = {key: ["float32", "B", *value.shape[1:]] for key, value in zip(part.outputs, outputs, strict=True)}
        described["modules"][name] = {"file": files[name].name, "inputs": inputs, "outputs": shapes}
    if agent.action_spec is not None:
        space = agent.action_spec.space
        described["action"] = {"low": space.low.tolist(), "high": space.high.tolist()}
    limits = ControlOptions()
    for name in ("safe_set_threshold", "constraint_threshold"):
        described[name] = agent.planner_settings.get(name, getattr(limits, name))
    return described
