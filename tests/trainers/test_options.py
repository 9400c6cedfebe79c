"""Options that would fail late are refused when they are made; the defaults are the paper's."""

import dataclasses

import numpy as np
import pytest

from ls3_torchrl.trainers import LossOptions, LS3Options, OfflineOptions, OnlineOptions, OptimOptions, VAEOptions


@pytest.mark.parametrize(
    ("options", "field", "value"),
    [
        (VAEOptions, "schedule", "cosine"),
        (VAEOptions, "warmup", [0.5, 0.5]),
        (VAEOptions, "warmup", [0.5, 1.5]),
        (VAEOptions, "warmup", [-0.1, 0.5]),
        (VAEOptions, "warmup", [0.1, 0.2, 0.3]),
        (VAEOptions, "prediction_weight", -1.0),
        (VAEOptions, "prediction_weight", float("nan")),
        (VAEOptions, "autocast", "bf16"),
        (VAEOptions, "steps", 0),
        (VAEOptions, "batch_size", 0),
        (VAEOptions, "lr", 0.0),
        (VAEOptions, "beta", -1e-6),
        (VAEOptions, "prediction_horizon", 0),
        (VAEOptions, "enlarge_to", 0),
        (VAEOptions, "checkpoint", "/nowhere.pt"),
        (OfflineOptions, "value_steps", -1),
        (OnlineOptions, "dynamics_steps", -1),
        (OnlineOptions, "fraction", 1.0),
        (OnlineOptions, "fraction", -0.1),
        (OptimOptions, "autocast", "bf16"),
        (OptimOptions, "lr", -1.0),
        (OptimOptions, "dynamics_lr", float("inf")),
        (OptimOptions, "batch_size", 0),
        (OptimOptions, "target_interval", 0),
        (LossOptions, "timed_out_weight", -0.1),
        (LossOptions, "mean_latents", ["value"]),
        (LossOptions, "dynamics_horizon", 0),
        (LossOptions, "gamma_safe_set", 1.1),
    ],
)
def test_values_out_of_range_are_refused_by_name(options, field, value):
    with pytest.raises(ValueError, match=rf"^{field} must"):
        options(**{field: value})


@pytest.mark.parametrize(
    ("options", "field", "value"),
    [
        (VAEOptions, "steps", 1.5),
        (VAEOptions, "steps", "ten"),
        (VAEOptions, "steps", True),
        (VAEOptions, "lr", "fast"),
        (VAEOptions, "lr", None),
        (VAEOptions, "beta", "small"),
        (VAEOptions, "warmup", "early"),
        (VAEOptions, "warmup", ["a", "b"]),
        (VAEOptions, "checkpoint", 3),
        (OfflineOptions, "dynamics_steps", 1.5),
        (OnlineOptions, "classifier_steps", "many"),
        (OnlineOptions, "fraction", "half"),
        (LossOptions, "zero_at_goal", "yes"),
        (LossOptions, "mean_latents", "goal"),
        (LossOptions, "dynamics_horizon", 2.5),
    ],
)
def test_values_of_another_type_are_refused_by_name(options, field, value):
    with pytest.raises(TypeError, match=rf"^{field} must"):
        options(**{field: value})


@pytest.mark.parametrize(
    ("options", "field"),
    [
        (VAEOptions, "lr"),
        (VAEOptions, "beta"),
        (OnlineOptions, "fraction"),
        (OptimOptions, "dynamics_lr"),
        (LossOptions, "gamma_safe_set"),
        (LossOptions, "timed_out_weight"),
    ],
)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_numbers_that_are_none_are_refused_by_name(options, field, value):
    with pytest.raises(ValueError, match=rf"^{field} must"):
        options(**{field: value})


@pytest.mark.parametrize("number", [np.int64(3), np.float32(0.5)])
def test_numpys_numbers_are_numbers(number):
    whole = isinstance(number, np.integer)
    assert (OfflineOptions(dynamics_steps=number) if whole else VAEOptions(lr=number)) is not None


@pytest.mark.parametrize(
    ("options", "field", "value"),
    [
        (VAEOptions, "warmup", [0.0, 0.75]),
        (VAEOptions, "autocast", True),
        (OfflineOptions, "value_steps", 0),
        (OnlineOptions, "fraction", 0.0),
        (LossOptions, "mean_latents", ["dynamics", "goal"]),
        (LossOptions, "gamma_safe_set", 0.0),
    ],
)
def test_values_at_the_edge_are_taken_and_lists_become_tuples(options, field, value):
    made = getattr(options(**{field: value}), field)
    assert made == (tuple(value) if isinstance(value, list) else value)


def test_the_defaults_are_the_papers():
    vae, options = VAEOptions(), LS3Options()
    assert (vae.steps, vae.batch_size, vae.lr, vae.beta) == (100_000, 256, 1e-4, 1e-6)
    assert set(dataclasses.asdict(options.offline).values()) == {10_000}
    assert (options.online.dynamics_steps, options.online.value_td_steps) == (512, 2000)
    assert (options.optim.batch_size, options.optim.lr, options.optim.dynamics_lr) == (256, 1e-4, 1e-3)
    assert options.optim.target_interval == 100


def test_options_cannot_change_once_they_are_checked():
    with pytest.raises(dataclasses.FrozenInstanceError):
        VAEOptions().steps = 0
