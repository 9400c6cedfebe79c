"""The planner as a policy among TorchRL's environments, transforms and collectors."""

import copy
import pickle
import warnings

import pytest
import torch
from stub_planners import (
    A,
    Corridor,
    D,
    assert_warm_starts_are_carried,
    corridor,
    latents,
    random_planner,
    still,
    stub_planner,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import InitTracker, SerialEnv, TransformedEnv, check_env_specs
from torchrl.modules.utils import get_env_transforms_from_module, get_primers_from_module

# TorchRL warns about classes of its own while its collectors are imported.
pytestmark = pytest.mark.filterwarnings("ignore:Creating .* which inherits from WeightUpdaterBase:DeprecationWarning")


def collect(env, policy, **options):
    from torchrl.collectors import Collector

    collector = Collector(env, policy, frames_per_batch=6, total_frames=18, **options)
    # Batches of three steps: episodes, and with them the plans, run on from one batch to the next.
    path = torch.cat(list(collector), 1)
    collector.shutdown()
    return path


def test_rollout_carries_the_warm_start_and_drops_it_with_the_episode():
    torch.manual_seed(0)
    planner = stub_planner(p_random=0.5)
    path = corridor(planner).rollout(9, planner, break_when_any_done=False)
    assert_warm_starts_are_carried(path)
    assert ("plan", "score") in path.keys(True)


def test_collector_carries_the_warm_start_and_drops_it_with_the_episode():
    torch.manual_seed(0)
    planner = stub_planner(p_random=0.5)
    assert_warm_starts_are_carried(collect(corridor(planner), planner))


def test_nested_keys_are_carried_too():
    torch.manual_seed(0)
    planner = stub_planner(p_random=0.5, plan_key=("ls3", "plan"))
    path = corridor(planner).rollout(9, planner, break_when_any_done=False)
    assert_warm_starts_are_carried(path, ("ls3", "plan"))


def test_the_carried_start_is_what_the_next_plan_begins_with():
    planner = stub_planner(p_random=0.0)
    env = corridor(planner)
    # Noise free: the first plan is the middle of the box, so make the second start elsewhere by hand.
    noise = still(planner.sample_noise(2))
    state = env.reset()
    state = planner(state, noise=noise)
    state["next", "plan", "mean"] = torch.full((2, 3, A), 0.25)
    _, following = env.step_and_maybe_reset(state)
    torch.testing.assert_close(planner(following, noise=noise)["action"], torch.full((2, A), 0.25))


def test_a_collector_finds_the_warm_start_by_itself():
    torch.manual_seed(0)
    planner = stub_planner(p_random=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        assert_warm_starts_are_carried(collect(Corridor(), planner, auto_register_policy_transforms=True))


@pytest.mark.parametrize("plan_key", ["plan", ("ls3", "plan")])
def test_torchrl_finds_the_primer_of_a_planner_inside_other_modules(plan_key):
    planner = stub_planner(p_random=0.5, plan_key=plan_key)
    primer = get_primers_from_module(TensorDictSequential(planner))
    keys = {planner.warm_start.keys["mean"], planner.warm_start.keys["std"]}
    assert set(primer.primers.keys(True, True)) == keys
    assert all(primer.primers[key].shape == (3, A) for key in keys)
    env = TransformedEnv(SerialEnv(2, lambda: Corridor(2)), get_env_transforms_from_module(planner))
    check_env_specs(env)
    path = env.rollout(4, planner, break_when_any_done=False)
    assert (path[planner.warm_start.keys["std"]][:, :, 1] > 0).any(-1).any(-1).all()


def test_without_a_primer_it_says_so_once_and_plans_all_the_same():
    planner = stub_planner(p_random=0.5)
    with pytest.warns(UserWarning, match=r"no last plan.*make_tensordict_primer\(\).*auto_register_policy") as seen:
        plans = [planner(latents(2)) for _ in range(3)]
    assert len(seen) == 1
    assert all(plan["action"].shape == (2, A) for plan in plans)
    # The first step of an episode may well be marked without a primer.
    other = stub_planner(p_random=0.5)
    with pytest.warns(UserWarning, match="found no last plan"):
        other(latents(2).update({"is_init": torch.ones(2, 1, dtype=torch.bool)}))
    env = TransformedEnv(Corridor(), InitTracker())
    with pytest.warns(UserWarning, match="found no last plan") as seen:
        env.rollout(6, stub_planner(p_random=0.5), break_when_any_done=False)
    assert len(seen) == 1


@pytest.mark.parametrize("settings", [{"p_random": 1.0}, {"p_random": 0.4, "p_constant": 0.6}])
def test_nothing_is_said_where_no_last_plan_is_used(settings):
    planner = stub_planner(**settings)
    planner(latents(2))
    Corridor().rollout(6, planner, break_when_any_done=False)
    assert planner.in_keys == ["latent"]
    # Whatever lies there is not read.
    rubbish = latents(2).update({"plan": {"mean": torch.full((2, 3, A), torch.nan), "std": torch.ones(2, 3, A)}})
    noise = planner.sample_noise(2)
    assert torch.equal(planner(rubbish, noise=noise)["action"], planner(latents(2), noise=noise)["action"])


class Watched(TensorDict):
    """Remembers which keys were asked for."""

    asked: set

    def get(self, key, *args, **kwargs):
        self.asked.add(key)
        return super().get(key, *args, **kwargs)


@pytest.mark.parametrize("p_random", [0.5, 1.0])
@pytest.mark.parametrize("plan_key", ["plan", ("ls3", "plan")])
def test_in_keys_are_what_is_read_and_out_keys_what_is_written(p_random, plan_key):
    planner = stub_planner(p_random=p_random, plan_key=plan_key)
    state = corridor(planner).reset()
    watched = Watched(dict(state.items()), state.batch_size)
    watched.asked = set()
    out = planner(watched, TensorDict({}, state.batch_size))
    assert watched.asked == set(planner.in_keys)
    assert set(out.keys(True, True)) == set(planner.out_keys)
    assert len(planner.out_keys) == len(set(planner.out_keys))
    # The keys that are declared are all that it needs.
    assert planner(state.select(*planner.in_keys))["action"].shape == (2, A)


def test_a_sequence_passes_the_keys_on():
    planner = stub_planner(p_random=0.5)
    policy = TensorDictSequential(TensorDictModule(nn.Identity(), ["latent"], ["seen"]), planner)
    assert policy.in_keys == ["latent", ("plan", "mean"), ("plan", "std"), "is_init"]
    assert policy.out_keys == ["seen", *planner.out_keys]
    assert_warm_starts_are_carried(corridor(planner).rollout(9, policy, break_when_any_done=False))
    unknown = TensorDictSequential(stub_planner(p_random=1.0), partial_tolerant=True)
    assert "action" in unknown(latents(2)).keys()  # noqa: SIM118


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda planner: pickle.loads(pickle.dumps(planner))])
@pytest.mark.parametrize("engine", ["fused", "rollout"])
def test_a_planner_that_served_a_collector_can_be_copied(copied, engine):
    from torchrl.collectors import Collector

    planner = random_planner(engine=engine, p_random=0.5)
    collector = Collector(corridor(planner), planner, frames_per_batch=6, total_frames=6)
    list(collector)
    start, noise = next(iter(corridor(planner).rollout(1, planner).split(1, 1))).squeeze(1), planner.sample_noise(2)
    for _ in range(2):  # while the collector is there, and after it
        twin = copied(planner)
        assert twin.value is not planner.value
        assert twin.imagine.safe_set is twin.safe_set
        one, two = (policy(start.clone(), noise=noise) for policy in (planner, twin))
        for key in planner.out_keys:
            assert torch.equal(one[key], two[key])
        collector.shutdown()
    # The copy has weights of its own, and sees them change.
    with torch.no_grad():
        for parameter in twin.safe_set.parameters():
            parameter.zero_()
    assert (twin.imagine_plans(start["latent"], torch.zeros(2, 1, 3, A)).safe_set_prob == 0.5).all()
    assert (planner.imagine_plans(start["latent"], torch.zeros(2, 1, 3, A)).safe_set_prob != 0.5).any()


def test_what_was_compiled_for_a_gpu_is_not_copied(monkeypatch):
    kept = torch.compile
    monkeypatch.setattr(torch, "compile", lambda function, **options: kept(function, backend="eager"))
    planner = random_planner()
    planner.imagine.compiled = True
    noise = planner.sample_noise(2)
    expected = planner(latents(2), noise=noise)["action"]
    assert "_replay" in vars(planner.imagine)
    for twin in (copy.deepcopy(planner), pickle.loads(pickle.dumps(planner))):
        assert "_replay" not in vars(twin.imagine)
        torch.testing.assert_close(twin(latents(2), noise=noise)["action"], expected)


def test_a_collector_may_compile_the_planner():
    torch.manual_seed(0)
    encoder = TensorDictModule(nn.Sequential(nn.Linear(D, 8), nn.Tanh(), nn.Linear(8, D)), ["latent"], ["embedding"])
    planner = stub_planner(p_random=0.5, encoder=encoder)
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    path = collect(corridor(planner), planner, compile_policy={"backend": "aot_eager"})
    assert_warm_starts_are_carried(path)
    # The search is the one thing that is not traced: it is left out on purpose, and the rest is compiled.
    breaks = torch._dynamo.utils.counters["graph_break"]
    assert breaks
    assert all("LS3Planner.plan" in reason for reason in breaks)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] > 0


@pytest.mark.parametrize("encoded", [False, True], ids=["latents", "encoder"])
def test_a_compiled_planner_plans_the_same(encoded):
    encoder = TensorDictModule(nn.Linear(D, D), ["latent"], ["embedding"]) if encoded else None
    planner = stub_planner(encoder=encoder)
    noise = planner.sample_noise(3)
    expected = planner(latents(3), noise=noise)
    compiled = torch.compile(planner, backend="aot_eager")
    for _ in range(2):
        out = compiled(latents(3), noise=noise)
        for key in planner.out_keys:
            torch.testing.assert_close(out[key], expected[key])
