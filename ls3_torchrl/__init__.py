"""LS³, Latent Space Safe Sets, as modular TorchRL components (Wilcox et al., CoRL 2021, arXiv 2107.04775).

``modules`` are the networks, ``objectives`` their losses, ``planners`` the controller, ``data`` the way from
episodes to batches; ``LS3Agent`` holds the networks together.

All of these are imported when they are first asked for: ``ls3_torchrl.options`` and ``ls3_torchrl.exceptions`` need no
PyTorch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ls3_torchrl.agent import LS3Agent

__version__ = "0.1.0"

__all__ = ["LS3Agent", "__version__"]

_PARTS = ("agent", "baselines", "data", "exceptions", "modules", "objectives", "options", "planners", "trainers")


def __getattr__(name: str) -> Any:
    """The agent and the parts of the library."""
    if name in _PARTS:
        return import_module(f"{__name__}.{name}")
    if name == "LS3Agent":
        return import_module(f"{__name__}.agent").LS3Agent
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_PARTS})
