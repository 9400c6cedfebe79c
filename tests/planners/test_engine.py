import pytest
import torch
from stub_planners import latents, random_planner
from torch import nn

from ls3_torchrl.planners import FusedImagination, RolloutImagination
from ls3_torchrl.planners.engine import Engine


def modules():
    planner = random_planner()
    return planner.env, planner.value, planner.safe_set


@pytest.mark.parametrize(("name", "kind"), [("auto", FusedImagination), ("fused", FusedImagination)])
def test_the_fast_engine_is_kept_from_plan_to_plan(name, kind):
    engine = Engine(*modules(), name)
    assert type(engine.choose()) is kind
    assert engine.choose() is engine.choose()


def test_rollout_is_what_was_asked_for():
    assert isinstance(Engine(*modules(), "rollout").choose(), RolloutImagination)


def test_both_reduce_as_they_were_told():
    parts = modules()
    for name in ("fused", "rollout"):
        imagine = Engine(*parts, name, safe_set_reduction="min").choose()
        assert imagine.safe_set_reduction == "min"


def test_the_choice_follows_the_modules():
    env, value, safe_set = modules()
    engine = Engine(env, value, safe_set)
    kept = env.goal.network
    env.goal.network = nn.Sequential(*kept, nn.Hardtanh())
    assert isinstance(engine.choose(), RolloutImagination)
    env.goal.network = kept
    assert isinstance(engine.choose(), FusedImagination)


def test_a_planner_imagines_with_what_is_chosen_at_each_plan():
    planner = random_planner()
    chosen = []
    choose = planner.engine.choose
    planner.engine.choose = lambda modules: chosen.append(True) or choose(modules)
    for _ in range(2):
        planner(latents(2))
    assert len(chosen) == 2
    assert torch.is_tensor(planner.imagine_plans(torch.zeros(1, 4), torch.zeros(1, 2, 3, 2)).value)


@pytest.mark.parametrize("name", ["auto", "rollout"])
@pytest.mark.parametrize("part", ["value", "safe_set", "dynamics", "constraint", "goal"])
def test_a_module_that_was_exchanged_is_the_one_that_counts(name, part):
    planner = random_planner(engine=name)
    other = random_planner(engine=name)
    noise, latent = planner.sample_noise(2), torch.randn(2, planner.env.latent_dim)
    holder, source = (p if part in ("value", "safe_set") else p.env for p in (planner, other))
    with torch.no_grad():
        for parameter in getattr(source, part).parameters():
            parameter.add_(0.5)
    planner.plan(latent, noise=noise)  # what was made for the old module is there by now
    setattr(holder, part, getattr(source, part))
    plans = torch.rand(2, 6, planner.horizon, planner.action_spec.shape[-1])
    torch.manual_seed(0)
    found = planner.imagine_plans(latent, plans)
    fresh = type(planner)(
        planner.env, planner.value, planner.safe_set, optimizer=planner.optimizer, horizon=planner.horizon,
        num_particles=planner.num_particles, engine=name, precision="fp32",
    )  # fmt: skip
    torch.manual_seed(0)
    for one, expected in zip(found, fresh.imagine_plans(latent, plans), strict=True):
        assert torch.equal(one, expected)


def test_exchanged_dynamics_are_those_that_the_environment_steps_with():
    planner, other = random_planner(), random_planner()
    planner.env.dynamics = other.env.dynamics
    assert planner.env.world_model is other.env.dynamics
