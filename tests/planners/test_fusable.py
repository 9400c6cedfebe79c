"""A user's module is never bypassed."""

import pytest
import torch
from stub_planners import A, D, latents, random_planner
from tensordict import TensorDict
from torch import nn
from torch.nn.utils import parametrizations
from torchrl.modules import NoisyLinear

from ls3_torchrl.modules import (
    ConstraintEstimator,
    EnsembleDynamics,
    EnsembleMLP,
    GoalEstimator,
    SafeSet,
    ValueEnsemble,
)
from ls3_torchrl.planners import FusedImagination, LatentEnv, LS3Planner, RolloutImagination
from ls3_torchrl.planners.fusable import why_not_fused

KINDS = {
    "dynamics": EnsembleDynamics,
    "constraint": ConstraintEstimator,
    "goal": GoalEstimator,
    "value": ValueEnsemble,
    "safe_set": SafeSet,
}
METHODS = [
    ("dynamics", "forward"),
    ("dynamics", "network_input"),
    ("dynamics", "read_output"),
    ("dynamics", "distribution"),
    ("value", "forward"),
    *(
        (name, method)
        for name in ("constraint", "goal", "safe_set")
        for method in ("forward", "of_latent", "probability")
    ),
]


def parts_with(name=None, change=None):
    """Modules of a random planner, one of them turned into an instance of a subclass of its kind."""
    planner = random_planner()
    parts = {
        "dynamics": planner.env.dynamics,
        "constraint": planner.env.constraint,
        "goal": planner.env.goal,
        "value": planner.value,
        "safe_set": planner.safe_set,
    }
    if name is not None:
        parts[name].__class__ = type("Own", (KINDS[name],), change)
    return parts


def env_of(parts, kind=LatentEnv):
    spec = random_planner().action_spec
    return kind(parts["dynamics"], parts["constraint"], parts["goal"], action_spec=spec)


def reason(parts, kind=LatentEnv):
    return why_not_fused(env_of(parts, kind), parts["value"], parts["safe_set"])


def planner_of(parts, kind=LatentEnv, **options):
    options = {"horizon": 3, "num_candidates": 24, "num_elites": 4, "num_particles": 3} | options
    return LS3Planner(env_of(parts, kind), parts["value"], parts["safe_set"], **options)


def test_the_librarys_own_modules_are_fused():
    assert reason(parts_with()) is None


@pytest.mark.parametrize("name", KINDS)
def test_so_is_a_subclass_that_overrides_nothing_that_matters(name):
    def hello(self):
        """Something of the user's own."""

    parts = parts_with(name, {"hello": hello, "extra_repr": lambda self: "mine"})
    assert reason(parts) is None
    assert isinstance(planner_of(parts).imagine, FusedImagination)


@pytest.mark.parametrize(("name", "method"), METHODS)
def test_a_method_that_is_overridden_is_named_and_asked(name, method):
    called = []

    def own(self, *args, **kwargs):
        called.append(method)
        return getattr(super(type(self), self), method)(*args, **kwargs)

    parts = parts_with(name, {method: own})
    assert reason(parts) == f"{name} (Own) overrides {method}"
    planner = planner_of(parts)
    assert isinstance(planner.imagine, RolloutImagination)
    planner(latents(2))
    assert called
    with pytest.raises(TypeError, match=rf"bypass a module: {name} \(Own\) overrides {method}.*engine=\"rollout\""):
        planner_of(parts, engine="fused")


@pytest.mark.parametrize(("name", "method"), METHODS)
def test_so_is_one_that_is_set_on_the_module_itself(name, method):
    parts = parts_with()
    setattr(parts[name], method, lambda *args, **kwargs: None)
    assert reason(parts) == f"{name} ({KINDS[name].__name__}) overrides {method}"


def test_what_a_safe_set_of_ones_own_says_is_what_the_planner_acts_on():
    # The paper's classifier says 0.5 or so everywhere; this one allows ends with z_0 > 0 alone.
    class Half(SafeSet):
        def probability(self, latent):
            return (latent[..., :1] > 0.0).to(latent)

    class HalfLogit(SafeSet):
        def forward(self, tensordict):
            sign = (tensordict.get(self.in_keys[0])[..., :1] > 0.0).float()
            return tensordict.set(self.out_keys[0], 200.0 * sign - 100.0)

    for kind in (Half, HalfLogit):
        planner = planner_of(parts_with() | {"safe_set": kind(D, hidden=(8,))})
        seen = planner.imagine_plans(torch.tensor([[900.0] * D, [-900.0] * D]), torch.zeros(2, 1, 3, A))
        assert seen.safe_set_prob.flatten().tolist() == [1.0, 0.0]


@pytest.mark.parametrize("method", ["_step", "_reset", "step", "rollout"])
def test_a_model_environment_that_does_something_else_is_asked(method):
    called = []

    def own(self, *args, **kwargs):
        called.append(method)
        return getattr(super(type(self), self), method)(*args, **kwargs)

    kind = type("OwnEnv", (LatentEnv,), {method: own})
    parts = parts_with()
    assert reason(parts, kind) == f"model (OwnEnv) overrides {method}"
    planner_of(parts, kind)(latents(2))
    assert called


def test_a_model_environment_with_another_world_model_is_asked():
    planner = planner_of(parts_with())
    planner.env.world_model = nn.Identity()
    assert isinstance(planner.imagine, RolloutImagination)


@pytest.mark.parametrize("kind", ["register_forward_hook", "register_forward_pre_hook"])
@pytest.mark.parametrize(
    ("name", "where"),
    [
        *((name, where) for name in KINDS for where in ("module", "network")),
        *((name, "layer") for name in ("constraint", "goal", "safe_set")),
    ],
)
def test_hooks_are_called_even_if_they_come_later(name, kind, where):
    parts = parts_with()
    planner = planner_of(parts)
    planner(latents(2))
    assert isinstance(planner.imagine, FusedImagination)
    module = parts[name]
    hooked = {"module": module, "network": module.network}[where] if where != "layer" else module.network[0]
    called = []
    handle = getattr(hooked, kind)(lambda *args: called.append(True))
    planner(latents(2))
    assert called
    assert "forward hooks" in reason(parts)
    with pytest.raises(TypeError, match="forward hooks"):
        planner_of(parts, engine="fused")
    handle.remove()
    assert isinstance(planner.imagine, FusedImagination)


def test_a_planner_with_the_fused_engine_refuses_what_comes_later():
    planner = planner_of(parts_with(), engine="fused")
    planner(latents(2))
    planner.env.goal.network[1] = nn.Tanh()
    with pytest.raises(TypeError, match=r"goal \(GoalEstimator\) has a network of another kind than its own"):
        planner(latents(2))


def spectral(network):
    parametrizations.spectral_norm(network[0])
    return network


class Doubled(nn.Sequential):
    def forward(self, x):
        return 2 * super().forward(x)


@pytest.mark.parametrize(
    "network",
    [
        lambda: nn.Sequential(nn.Linear(D, 8), nn.Tanh(), nn.Linear(8, 1)),
        lambda: nn.Sequential(nn.Linear(D, 8), nn.ReLU(), nn.Linear(8, 1), nn.ReLU()),
        lambda: nn.Sequential(nn.Linear(D, 8), nn.ReLU(), nn.Dropout(0.5), nn.Linear(8, 1)),
        lambda: nn.Sequential(nn.Linear(D, 8, bias=False), nn.ReLU(), nn.Linear(8, 1)),
        lambda: nn.Sequential(NoisyLinear(D, 8), nn.ReLU(), nn.Linear(8, 1)),
        lambda: Doubled(nn.Linear(D, 1)),
        lambda: spectral(nn.Sequential(nn.Linear(D, 8), nn.ReLU(), nn.Linear(8, 1))),
        lambda: nn.Linear(D, 1),
    ],
)
def test_networks_that_are_more_than_their_layers_roll_out(network):
    parts = parts_with()
    parts["constraint"].network = network()
    assert reason(parts).startswith("constraint (ConstraintEstimator) has a network of another kind than its own")
    out = planner_of(parts)(latents(2))
    assert out["action"].shape == (2, A)


@pytest.mark.parametrize("name", ["dynamics", "value"])
def test_an_ensemble_of_ones_own_rolls_out(name):
    class Own(EnsembleMLP):
        def forward(self, inputs, *, per_member=False):
            return 2 * super().forward(inputs, per_member=per_member)

    parts = parts_with()
    parts[name].network.__class__ = Own
    assert f"{name} ({KINDS[name].__name__}) has a network of another kind" in reason(parts)
    parts = parts_with()
    parts[name].network.forward = lambda *args, **kwargs: None
    assert f"{name} ({KINDS[name].__name__}) has a network of another kind" in reason(parts)


def test_modules_from_elsewhere_are_named():
    class Value(nn.Module):
        in_keys, out_keys = ("latent",), ("state_value",)

        def forward(self, tensordict: TensorDict) -> TensorDict:
            return tensordict.set("state_value", tensordict["latent"][..., :1])

    parts = parts_with() | {"value": Value()}
    assert reason(parts) == "value (Value) is no ValueEnsemble"
    assert why_not_fused(nn.Identity(), parts["value"], parts["safe_set"]) == "model (Identity) is no LatentEnv"
