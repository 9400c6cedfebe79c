"""Planning: the learned model as an environment, the optimiser, the scores, and LS³'s controller."""

from ls3_torchrl.planners.calibration import Calibration, calibrate, conformal_threshold, foresee
from ls3_torchrl.planners.cem import CrossEntropyMethod
from ls3_torchrl.planners.decisions import describe_plan
from ls3_torchrl.planners.fused import FusedImagination
from ls3_torchrl.planners.imagination import ImaginationNoise, Limits, PlanNoise, RolloutImagination
from ls3_torchrl.planners.latent_env import LatentEnv
from ls3_torchrl.planners.ls3 import LS3Planner
from ls3_torchrl.planners.optimizer import Optimizer, OptimizerResult, PlanScores
from ls3_torchrl.planners.safe_set_filter import SafeSetFilter, describe_filter
from ls3_torchrl.planners.scoring import PlanStatistics, feasible, least_harm, objective
from ls3_torchrl.planners.warm_start import WarmStart

__all__ = [
    "Calibration",
    "CrossEntropyMethod",
    "FusedImagination",
    "ImaginationNoise",
    "LS3Planner",
    "LatentEnv",
    "Limits",
    "Optimizer",
    "OptimizerResult",
    "PlanNoise",
    "PlanScores",
    "PlanStatistics",
    "RolloutImagination",
    "SafeSetFilter",
    "WarmStart",
    "calibrate",
    "conformal_threshold",
    "describe_filter",
    "describe_plan",
    "feasible",
    "foresee",
    "least_harm",
    "objective",
]
