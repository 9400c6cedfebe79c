"""What a GPU would be bound by: how many operators a plan and a gradient step call, and their products."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.benchmark.planning import permissive
from ls3_recipes.benchmark.tables import Section
from ls3_recipes.benchmark.updates import gradient_step, random_rows
from ls3_recipes.benchmark.workbench import Workbench
from ls3_recipes.options import as_dict
from ls3_torchrl import LS3Agent
from ls3_torchrl.objectives import EnsembleDynamicsLoss, OfflineValueLoss, VAELoss
from ls3_torchrl.planners.fused import _GPU_BLOCK, FusedImagination
from ls3_torchrl.trainers.steps import threads

#: What a GPU needs to be told of one operator, in microseconds: the usual range.
LAUNCH_US = (5.0, 10.0)
#: Dense products in bf16 by the makers' data sheets, in TFLOP/s.
PEAKS = {"H100": 989.0, "A100": 312.0, "L4": 121.0}
#: Operators that only ask for memory, or change nothing in it.
_NO_WORK = ("aten::empty", "aten::resize", "aten::set_", "aten::lift_fresh", "aten::alias", "aten::detach")
#: Operators for whose result the processor waits.
_WAITS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::_unique2", "aten::equal")


class Calls(NamedTuple):
    """What some work calls.

    Attributes:
        operators: that compute something; on a GPU each is a launch, or a few.
        waits: those of them for whose result the processor waits.
        gflop: operations of all products, in 10⁹.
    """

    operators: int
    waits: int
    gflop: float


class _Operators(TorchDispatchMode):
    """Collects the names of operators that compute something, in the thread that enters it.

    It sees what PyTorch hands to a device: operators that are made of others are taken apart by then. A profiler also
    lists those, and what the processor's own kernels call within.
    """

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Note an operator, and call it."""
        name = func.name()
        if not func.is_view and not name.startswith(_NO_WORK):
            self.names.append(name)
        return func(*args, **(kwargs or {}))


def count_calls(call: Callable[[], object]) -> Calls:
    """Count what a call does on one thread; views and empty tensors are left out.

    Example:
        >>> a, bias = torch.ones(4, 8), torch.ones(4)
        >>> count_calls(lambda: torch.nn.functional.linear(a, a, bias).relu())
        Calls(operators=2, waits=0, gflop=2.56e-07)
    """
    with threads(1), FlopCounterMode(display=False) as products, _Operators() as operators:
        call()
    names = operators.names
    return Calls(len(names), sum(name.startswith(_WAITS) for name in names), products.get_total_flops() / 1e9)


def count_kernels(work: Workbench) -> list[dict[str, Any]]:
    """Count the plan and the gradient steps of every preset.

    Returns:
        A dictionary for each: ``what``, and what :class:`Calls` holds.
    """
    out = []
    for preset in work.presets:
        for what, call in _work_of(work, preset).items():
            call()  # what is made once is not counted
            out.append({"what": f"{what}, {preset.preset}", **count_calls(call)._asdict()})
    return out


def _work_of(work: Workbench, preset: LS3Settings) -> dict[str, Callable[[], object]]:
    frames, batch = work.episodes["pixels"].flatten(0, 1), preset.optim.batch_size
    torch.manual_seed(0)
    agent = permissive(LS3Agent(action_spec=work.spec, in_channels=frames.shape[1], **as_dict(preset.agent)))
    agent = agent.to(work.device)
    shape = agent.architecture
    planner = agent.planner(work.spec, **(as_dict(preset.planner) | {"precision": "fp32"}))
    imagination = planner.imagine
    if isinstance(imagination, FusedImagination):
        imagination.block, imagination.compiled = _GPU_BLOCK, False  # as a GPU is given it, uncompiled
    latent = torch.randn(1, shape.latent_dim, device=work.device)
    rows = random_rows([batch, shape.num_values], shape.latent_dim, shape.action_dim, work.device)
    images = frames[torch.arange(preset.vae.batch_size) % len(frames)].to(work.device)
    pixels = TensorDict({"pixels": images}, [len(images)], device=work.device)
    dynamics = EnsembleDynamicsLoss(agent.dynamics, bootstrap=True)
    value = OfflineValueLoss(agent.value, bootstrap=True)
    vae = VAELoss(agent.encoder, agent.decoder)
    return {
        "plan": lambda: planner.plan(latent),
        "dynamics step": gradient_step(dynamics, "loss_dynamics", rows, "fp32"),
        "value step": gradient_step(value, "loss_value", rows, "fp32"),
        f"VAE step of {len(images)}": gradient_step(vae, "loss_vae", pixels, "fp32"),
    }


def kernels_section(counted: list[dict[str, Any]]) -> Section:
    """Launches against products, and which of the two is longer."""
    lines = []
    for row in counted:
        low, high = (row["operators"] * each / 1e3 for each in LAUNCH_US)
        products = {gpu: row["gflop"] / peak for gpu, peak in PEAKS.items()}  # GFLOP by TFLOP/s: milliseconds
        bound = ", ".join(gpu for gpu, ms in products.items() if ms > low) or "none"
        times = [f"{ms:.2g}" for ms in products.values()]
        numbers = (str(row["operators"]), str(row["waits"]), f"{row['gflop']:.3g}")
        lines.append((row["what"], *numbers, f"{low:.2g} to {high:.2g}", *times, bound))
    gpus = [f"{gpu} ms" for gpu in PEAKS]
    columns = ("", "operators", "waits", "GFLOP", "launches ms", *gpus, "products rule")
    low, high = LAUNCH_US
    caption = (
        f"counted on the processor, uncompiled; a launch of {low:g} to {high:g} µs for each operator, against the "
        "products at the data sheets' bf16 peak; products rule: on which they take longer than the launches"
    )
    return Section("What a GPU would be bound by", columns, lines, caption)
