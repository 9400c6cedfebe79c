"""LS³, Latent Space Safe Sets, as modular TorchRL components (Wilcox et al., CoRL 2021, arXiv 2107.04775).

``modules`` are the networks, ``objectives`` their losses, ``planners`` the controller, ``data`` the way from
episodes to batches; ``LS3Agent`` holds the networks together.
"""

from ls3_torchrl.agent import LS3Agent

__version__ = "0.1.0"

__all__ = ["LS3Agent", "__version__"]
