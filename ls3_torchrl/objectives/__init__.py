"""One loss module per equation of the paper."""

from ls3_torchrl.objectives.base import LatentLoss
from ls3_torchrl.objectives.classifier import ClassifierLoss
from ls3_torchrl.objectives.dynamics import EnsembleDynamicsLoss
from ls3_torchrl.objectives.prediction import LatentPredictionLoss
from ls3_torchrl.objectives.safe_set import SafeSetLoss
from ls3_torchrl.objectives.vae import VAELoss
from ls3_torchrl.objectives.value import OfflineValueLoss, TD1ValueLoss

__all__ = [
    "ClassifierLoss",
    "EnsembleDynamicsLoss",
    "LatentLoss",
    "LatentPredictionLoss",
    "OfflineValueLoss",
    "SafeSetLoss",
    "TD1ValueLoss",
    "VAELoss",
]
