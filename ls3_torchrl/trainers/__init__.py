"""Training as components, on any environment: the VAE, the latent models, and what they know."""

from ls3_torchrl.exceptions import DivergenceError
from ls3_torchrl.options.training import (
    LossOptions,
    LS3Options,
    OfflineOptions,
    OnlineOptions,
    OptimOptions,
    VAEOptions,
)
from ls3_torchrl.trainers.checkpoints import Checkpoints, Stateful
from ls3_torchrl.trainers.diagnostics import StateProbe
from ls3_torchrl.trainers.group import LearnerGroup, Stage
from ls3_torchrl.trainers.learner import Learner
from ls3_torchrl.trainers.ls3 import LS3Trainer
from ls3_torchrl.trainers.vae import VAETrainer, load_vae

__all__ = [
    "Checkpoints",
    "DivergenceError",
    "LS3Options",
    "LS3Trainer",
    "Learner",
    "LearnerGroup",
    "LossOptions",
    "OfflineOptions",
    "OnlineOptions",
    "OptimOptions",
    "Stage",
    "StateProbe",
    "Stateful",
    "VAEOptions",
    "VAETrainer",
    "load_vae",
]
