"""Acting outside any simulator: a controller behind a camera, and the networks in files for other programs."""

from ls3_torchrl.deployment.controller import Controller
from ls3_torchrl.deployment.export import export_modules

__all__ = ["Controller", "export_modules"]
