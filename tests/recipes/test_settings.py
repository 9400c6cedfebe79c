"""Settings that would fail late are refused early."""

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torchrl.data import Bounded

from settings import agent_options, check_settings


@pytest.fixture
def config(request):
    conf = request.config.rootpath / "recipes" / "conf"
    with initialize_config_dir(str(conf), version_base="1.3"):
        return compose("ls3", ["preset=smoke"])


def test_a_monte_carlo_bound_needs_returns_that_do_not_end_with_the_horizon(config):
    OmegaConf.update(config, "loss.monte_carlo", True)
    OmegaConf.update(config, "loss.continue_failures", False)
    with pytest.raises(ValueError, match=r"loss\.continue_failures"):
        check_settings(config)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vae.schedule", "cosine"),
        ("vae.warmup", [0.5, 0.5]),
        ("vae.warmup", [0.5, 1.5]),
        ("vae.prediction_weight", -1.0),
        ("vae.autocast", "bf16"),
        ("optim.autocast", "bf16"),
        ("optim.cooldown", 1.5),
        ("loss.failure_weight", -0.1),
        ("loss.failure_rows", "last"),
        ("loss.timed_out_weight", -0.1),
        ("loss.mean_latents", ["value"]),
        ("vae.reduction", "median"),
        ("vae.crop_scale", [0.5, 1.5]),
        ("vae.steps", 0),
        ("optim.lr", -1.0),
        ("online.episodes_per_update", 0),
        ("online.select", "first"),
        ("online.fraction", 1.0),
        ("vae.prediction_horizon", 0),
        ("loss.dynamics_horizon", 0),
        ("loss.success_tail", 0),
        ("agent.action_scale", "range"),
        ("vae.agent", "/nowhere.pt"),
    ],
)
def test_settings_that_would_fail_late_are_refused_early(config, name, value):
    check_settings(config)
    OmegaConf.update(config, name, value)
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        check_settings(config)


def test_box_is_half_the_range_of_each_action(config):
    low, high = torch.tensor([-3.0, 0.0]), torch.tensor([1.0, 0.02])
    for batch in ((), (4,)):
        spec = Bounded(low=low.expand(*batch, 2), high=high.expand(*batch, 2), shape=(*batch, 2))
        assert agent_options(config, spec)["action_scale"] == pytest.approx([2.0, 0.01])
    config.agent.action_scale = 0.5
    assert agent_options(config, spec)["action_scale"] == 0.5
