"""Every piece of LS³ as a TensorDictModule."""

from ls3_torchrl.modules.classifiers import (
    ConstraintEstimator,
    GoalEstimator,
    LatentClassifier,
    SafeSet,
    probability_of,
)
from ls3_torchrl.modules.dynamics import EnsembleDynamics
from ls3_torchrl.modules.ensemble import EnsembleMLP
from ls3_torchrl.modules.vae import PixelDecoder, PixelEncoder
from ls3_torchrl.modules.value import ValueEnsemble

__all__ = [
    "ConstraintEstimator",
    "EnsembleDynamics",
    "EnsembleMLP",
    "GoalEstimator",
    "LatentClassifier",
    "PixelDecoder",
    "PixelEncoder",
    "SafeSet",
    "ValueEnsemble",
    "probability_of",
]
