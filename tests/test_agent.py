import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded

from ls3_torchrl import LS3Agent
from ls3_torchrl.planners import CrossEntropyMethod, LS3Planner

TINY = {
    "latent_dim": 4,
    "num_dynamics": 2,
    "num_values": 3,
    "dynamics_hidden": (8,),
    "value_hidden": (8, 8),
    "classifier_hidden": (8,),
}
NETWORKS = ("encoder", "decoder", "dynamics", "value", "safe_set", "constraint", "goal")


def tiny(seed=0, **options):
    torch.manual_seed(seed)
    return LS3Agent(2, **(TINY | options))


def outputs(agent):
    """What all seven networks say of the same images and latents."""
    generator = torch.Generator().manual_seed(5)
    pixels = torch.randint(256, (3, 3, 64, 64), dtype=torch.uint8, generator=generator)
    td = TensorDict({"pixels": pixels, "action": torch.randn(3, 2, generator=generator)}, [3])
    td["dynamics_member"] = torch.tensor([[0], [1], [0]])
    td["dynamics_noise"] = torch.randn(3, 4, generator=generator)
    with torch.no_grad():
        for name in NETWORKS:
            getattr(agent, name)(td)
    return td


def change(path, **entries):
    """Rewrite entries of an agent file."""
    torch.save(torch.load(path, weights_only=True) | entries, path)


def test_default_sizes_are_the_papers():
    agent = LS3Agent(2)
    layers = [tuple(weight.shape) for weight in agent.value.network.weights]
    assert layers == [(5, 32, 256), (5, 256, 256), (5, 256, 256), (5, 256, 1)]
    layers = [tuple(weight.shape) for weight in agent.dynamics.network.weights]
    assert layers == [(5, 34, 128), (5, 128, 128), (5, 128, 64)]
    for head in (agent.safe_set, agent.constraint, agent.goal):
        shapes = [tuple(p.shape) for p in head.parameters() if p.ndim == 2]
        assert shapes == [(256, 32), (256, 256), (256, 256), (1, 256)]


def test_a_round_trip_gives_identical_outputs(tmp_path):
    agent = tiny()
    path = agent.save(tmp_path / "deep" / "folder" / "agent.pt")
    loaded = LS3Agent.load(path)
    assert loaded.architecture == agent.architecture
    one, two = outputs(agent), outputs(loaded)
    keys = one.keys(True, True)
    assert {("next", "latent"), "state_value", "goal_logit", "reco_pixels", "loc"} <= set(keys)
    for key in keys:
        assert torch.equal(one[key], two[key]), key
    assert not torch.equal(one["loc"], outputs(tiny(seed=1))["loc"])
    # No half-written file stays behind.
    assert [file.name for file in path.parent.iterdir()] == ["agent.pt"]


def test_the_form_of_the_dynamics_travels_with_the_file(tmp_path):
    agent = LS3Agent(action_dim=2, latent_dim=4, control_affine=True, action_scale=[0.5, 0.02])
    loaded = LS3Agent.load(agent.save(tmp_path / "agent.pt"))
    latent, action = torch.randn(3, 4), torch.randn(3, 2)
    for one, other in zip(
        agent.dynamics.distribution(latent, action), loaded.dynamics.distribution(latent, action), strict=True
    ):
        assert torch.equal(one, other)


def test_saving_again_replaces_the_file(tmp_path):
    tiny(0).save(tmp_path / "agent.pt")
    other = tiny(1)
    other.save(tmp_path / "agent.pt")
    assert torch.equal(outputs(LS3Agent.load(tmp_path / "agent.pt"))["loc"], outputs(other)["loc"])


def test_expected_sizes_that_agree_are_no_matter(tmp_path):
    path = tiny().save(tmp_path / "agent.pt")
    LS3Agent.load(path, action_dim=2, latent_dim=4, value_hidden=(8, 8))
    # Configuration files have lists where the constructor keeps tuples.
    LS3Agent.load(path, value_hidden=[8, 8])


@pytest.mark.parametrize(
    ("expected", "message"),
    [
        ({"action_dim": 3}, "action_dim 2 instead of 3"),
        ({"latent_dim": 32, "in_channels": 9}, "latent_dim 4 instead of 32, in_channels 3 instead of 9"),
        ({"value_hidden": [8, 9]}, r"value_hidden \(8, 8\) instead of"),
    ],
)
def test_another_shape_than_expected_is_refused(tmp_path, expected, message):
    path = tiny().save(tmp_path / "agent.pt")
    with pytest.raises(ValueError, match=f"another shape: {message}"):
        LS3Agent.load(path, **expected)


def test_another_version_is_refused(tmp_path):
    path = tiny().save(tmp_path / "agent.pt")
    change(path, version=99)
    with pytest.raises(ValueError, match="has version 99, but this library reads versions 1 and 2"):
        LS3Agent.load(path)


@pytest.mark.parametrize("content", [{"format": "other"}, {"state_dict": {}}, [1, 2]])
def test_files_that_are_no_agents_are_refused(tmp_path, content):
    torch.save(content, tmp_path / "agent.pt")
    with pytest.raises(ValueError, match=r"is not an agent file.*LS3Agent\.save"):
        LS3Agent.load(tmp_path / "agent.pt")


@pytest.mark.parametrize("keep", [0, 10, 2000, -100])
def test_truncated_files_are_refused(tmp_path, keep):
    path = tiny().save(tmp_path / "agent.pt")
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match="is not an agent file"):
        LS3Agent.load(path)


def test_text_files_are_refused(tmp_path):
    (tmp_path / "agent.pt").write_text("not weights at all\n")
    with pytest.raises(ValueError, match="is not an agent file"):
        LS3Agent.load(tmp_path / "agent.pt")


def test_weights_that_do_not_fit_are_refused(tmp_path):
    path = tiny().save(tmp_path / "agent.pt")
    change(path, state_dict=tiny(value_hidden=(9,)).state_dict())
    with pytest.raises(ValueError, match="do not fit the file's own architecture"):
        LS3Agent.load(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"agent\.pt is not an agent file.*no such file"):
        LS3Agent.load(tmp_path / "agent.pt")


@pytest.mark.parametrize("size", ["action_dim", "in_channels", "latent_dim", "num_dynamics", "num_values"])
def test_sizes_below_one_are_refused(size):
    with pytest.raises(ValueError, match="must be at least 1, got 0"):
        LS3Agent(**({"action_dim": 2} | TINY | {size: 0}))


OPTIONS = {"num_candidates": 20, "num_elites": 4, "num_particles": 2, "optim_steps": 1, "horizon": 2}


@pytest.mark.parametrize("worlds", [[], [5], [2, 3]])
def test_a_planner_takes_a_batched_environments_action_spec(worlds):
    low, high = torch.tensor([-1.0, 0.5]), torch.tensor([0.0, 2.0])
    spec = Bounded(low=low.expand(*worlds, 2), high=high.expand(*worlds, 2), shape=(*worlds, 2))
    planner = tiny().planner(spec, **OPTIONS)
    assert isinstance(planner, LS3Planner)
    assert planner.action_spec.shape == (2,)
    assert torch.equal(planner.action_spec.space.low, low)
    assert torch.equal(planner.action_spec.space.high, high)
    pixels = torch.randint(256, (*worlds, 3, 64, 64), dtype=torch.uint8)
    action = planner(TensorDict({"pixels": pixels}, worlds))["action"]
    assert action.shape == (*worlds, 2)
    assert ((action >= low) & (action <= high)).all()


def test_a_planner_plans_with_the_agents_own_networks():
    agent = tiny()
    planner = agent.planner(Bounded(low=-1.0, high=1.0, shape=(2,)), **OPTIONS)
    assert planner.env.dynamics is agent.dynamics
    assert planner.env.constraint is agent.constraint
    assert planner.env.goal is agent.goal
    assert planner.value is agent.value
    assert planner.safe_set is agent.safe_set
    assert planner.encoder is agent.encoder


def test_options_of_the_planner_are_passed_on():
    spec = Bounded(low=-1.0, high=1.0, shape=(2,))
    planner = tiny().planner(spec, **(OPTIONS | {"horizon": 7, "safe_set_threshold": 0.5}))
    assert planner.horizon == 7
    assert planner.safe_set_threshold == 0.5
    with pytest.raises(TypeError, match="depth"):
        tiny().planner(spec, depth=3)


SPEC = Bounded(low=torch.tensor([-1.0, 0.5]), high=torch.tensor([0.0, 2.0]), shape=(2,))


def acts(planner):
    """What a planner does from three images, under one seed."""
    torch.manual_seed(11)
    pixels = torch.randint(256, (3, 3, 64, 64), dtype=torch.uint8)
    return planner(TensorDict({"pixels": pixels}, [3]))["action"]


def test_a_loaded_agent_plans_as_it_did_in_its_run(tmp_path):
    agent = tiny()
    action = acts(agent.planner(SPEC, **(OPTIONS | {"safe_set_threshold": 0.5, "noise_scale": 0.5})))
    loaded = LS3Agent.load(agent.save(tmp_path / "agent.pt"))
    planner = loaded.planner()
    assert (planner.horizon, planner.optimizer.num_candidates, planner.safe_set_threshold) == (2, 20, 0.5)
    assert torch.equal(planner.action_spec.space.low, SPEC.space.low)
    assert torch.equal(acts(planner), action)
    # A setting of one's own goes before what the file holds, and the others stay.
    assert loaded.planner(horizon=3).horizon == 3
    assert loaded.planner().optimizer.num_candidates == 20


def test_an_agent_made_for_a_task_keeps_its_bounds_settings_and_name(tmp_path):
    agent = LS3Agent(action_spec=SPEC.expand(4, 2), planner=OPTIONS, task="reacher", **TINY)
    path = agent.save(tmp_path / "agent.pt")
    loaded = LS3Agent.load(path)
    assert (loaded.architecture.action_dim, loaded.task) == (2, "reacher")
    assert loaded.planner().horizon == OPTIONS["horizon"]
    versions = torch.load(path, weights_only=True)["versions"]
    assert versions["torch"] == torch.__version__.split("+")[0] or versions["torch"] == torch.__version__


def test_without_bounds_there_is_no_planner():
    with pytest.raises(ValueError, match=r"action_spec=env\.action_spec"):
        tiny().planner()
    with pytest.raises(ValueError, match="action_dim, or an action_spec"):
        LS3Agent()


def test_a_file_of_version_one_is_read_with_a_warning(tmp_path):
    agent = tiny()
    path = agent.save(tmp_path / "agent.pt")
    content = torch.load(path, weights_only=True)
    old = {key: content[key] for key in ("format", "architecture", "state_dict")}
    torch.save(old | {"version": 1}, path)
    with pytest.warns(UserWarning, match="version 1, which keeps neither bounds nor planner settings"):
        loaded = LS3Agent.load(path)
    assert torch.equal(outputs(loaded)["loc"], outputs(agent)["loc"])


GONE = {
    "architecture": {"initial_value": -60.0, "propagation": "ts1"},
    "planner": {"common_noise": True, "constraint_reduction": "max", "goal_reduction": "count", "min_std": 0.0},
}


def written_before(tmp_path, **other):
    """An agent that plans from images, and its file as it was written when there were more settings."""
    agent = tiny()
    agent.planner(SPEC, **OPTIONS)
    path = agent.save(tmp_path / "agent.pt")
    content = torch.load(path, weights_only=True)
    change(path, **{group: content[group] | gone | other.get(group, {}) for group, gone in GONE.items()})
    return agent, path


def test_a_file_with_settings_that_are_gone_is_read_where_they_are_what_all_agents_have_now(tmp_path):
    agent, path = written_before(tmp_path)
    loaded = LS3Agent.load(path)
    assert (loaded.architecture, loaded.planner_settings) == (agent.architecture, agent.planner_settings)
    assert torch.equal(acts(loaded.planner()), acts(agent.planner()))


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        ("architecture", "propagation", "tsinf"),
        ("planner", "common_noise", False),
        ("planner", "min_std", 0.05),
        ("planner", "constraint_reduction", "mean"),
        ("planner", "goal_reduction", "expected"),
    ],
)
def test_a_file_whose_agent_planned_otherwise_with_a_setting_that_is_gone_is_read_with_a_warning(
    tmp_path, group, name, value
):
    agent, path = written_before(tmp_path, **{group: {name: value}})
    with pytest.warns(UserWarning, match=rf"holds an agent with {name}={value!r}\. That setting is gone"):
        loaded = LS3Agent.load(path)
    assert torch.equal(acts(loaded.planner()), acts(agent.planner()))


@pytest.mark.parametrize(
    "numbers",
    [
        {"action_scale": np.array([3.0, 1.0])},
        {"action_scale": np.float64(3.0)},
        {"latent_dim": np.int64(4)},
        {"value_hidden": np.array([8, 8])},
        {"num_values": torch.tensor(2)},
    ],
)
def test_numbers_of_numpy_and_torch_can_be_saved_and_read(tmp_path, numbers):
    agent = tiny(**numbers)
    loaded = LS3Agent.load(agent.save(tmp_path / "agent.pt"))
    assert loaded.architecture == agent.architecture
    planner = agent.planner(SPEC, **(OPTIONS | {"horizon": np.int64(3), "noise_scale": np.float32(0.5)}))
    assert LS3Agent.load(agent.save(tmp_path / "agent.pt")).planner().horizon == planner.horizon


def test_box_is_half_the_range_of_each_action():
    low, high = torch.tensor([-3.0, 0.0]), torch.tensor([1.0, 0.02])
    for batch in ((), (4,)):
        spec = Bounded(low=low.expand(*batch, 2), high=high.expand(*batch, 2), shape=(*batch, 2))
        agent = LS3Agent(action_spec=spec, **TINY, action_scale="box")
        assert agent.architecture.action_scale == pytest.approx((2.0, 0.01))
    with pytest.raises(ValueError, match="needs the actions' bounds"):
        tiny(action_scale="box")
    with pytest.raises(ValueError, match="action_scale"):
        LS3Agent(action_spec=spec, **TINY, action_scale="range")


def reader():
    return TensorDictModule(torch.nn.Linear(10, 4), ["sensors"], ["latent"])


def test_an_encoder_of_ones_own_takes_the_place_of_the_agents(tmp_path):
    agent = tiny(encoder=reader())
    assert agent.decoder is None
    assert agent.foreign == ("encoder",)
    planner = agent.planner(SPEC, **OPTIONS)
    action = planner(TensorDict({"sensors": torch.zeros(3, 10)}, [3]))["action"]
    assert action.shape == (3, 2)
    path = agent.save(tmp_path / "agent.pt")
    other = reader()
    loaded = LS3Agent.load(path, modules={"encoder": other})
    assert loaded.encoder is other
    assert torch.equal(other.module.weight, agent.encoder.module.weight)
    with pytest.raises(ValueError, match=r"modules from outside: encoder; received: none"):
        LS3Agent.load(path)


def test_modules_for_an_agent_that_has_its_own_are_refused(tmp_path):
    path = tiny().save(tmp_path / "agent.pt")
    with pytest.raises(ValueError, match="modules from outside: none; received: encoder"):
        LS3Agent.load(path, modules={"encoder": reader()})


def test_every_module_can_be_given():
    parts = tiny(1)
    given = {name: getattr(parts, name) for name in NETWORKS}
    agent = tiny(0, **given)
    assert agent.foreign == NETWORKS
    assert all(getattr(agent, name) is module for name, module in given.items())


def test_unknown_settings_of_the_architecture_are_refused():
    with pytest.raises(TypeError, match="latent_size"):
        LS3Agent(2, latent_size=3)


@pytest.mark.parametrize("wrong", [{"horizon": 0}, {"horizn": 3}])
def test_settings_that_were_refused_are_not_remembered(tmp_path, wrong):
    agent = tiny()
    with pytest.raises((ValueError, TypeError), match="horiz"):
        agent.planner(SPEC, **OPTIONS, **wrong) if "horizn" in wrong else agent.planner(SPEC, **(OPTIONS | wrong))
    assert agent.action_spec is None
    agent.planner(SPEC, **OPTIONS)
    assert LS3Agent.load(agent.save(tmp_path / "agent.pt")).planner().horizon == OPTIONS["horizon"]


class Shooting(CrossEntropyMethod):
    """Another optimiser: one round of candidates."""

    def __init__(self):
        super().__init__(num_candidates=6, num_elites=1, optim_steps=1)


def test_another_optimiser_takes_the_place_of_cem_and_is_not_remembered(tmp_path):
    agent = tiny()
    agent.planner(SPEC, **OPTIONS)
    planner = agent.planner(optimizer=Shooting(), horizon=3)
    assert isinstance(planner.optimizer, Shooting)
    assert planner.horizon == 3
    loaded = LS3Agent.load(agent.save(tmp_path / "agent.pt"))
    assert loaded.planner().optimizer.num_candidates == OPTIONS["num_candidates"]
    assert isinstance(loaded.planner(optimizer=Shooting()).optimizer, Shooting)


def test_a_setting_that_a_file_cannot_keep_is_named_before_anything_is_written(tmp_path):
    agent = tiny()
    agent.planner_settings["horizon"] = object()
    with pytest.raises(ValueError, match="setting horizon holds a object"):
        agent.save(tmp_path / "agent.pt")
    assert not (tmp_path / "agent.pt").exists()


def test_precision_travels_with_the_file(tmp_path):
    agent = tiny().double()
    agent.planner(SPEC.to(torch.float64), **OPTIONS)
    loaded = LS3Agent.load(agent.save(tmp_path / "agent.pt"))
    assert all(p.dtype == torch.float64 for p in loaded.parameters())
    planner = loaded.planner()
    assert planner.action_spec.dtype == torch.float64
    assert acts(planner).dtype == torch.float64


class Drift(torch.nn.Module):
    """Dynamics of one's own, which do not say how large their latents are."""

    def forward(self, latent, action):
        return latent + action.sum(-1, keepdim=True)


def test_dynamics_of_ones_own_plan_in_an_agent_without_any_parameter():
    def module(function, written):
        return TensorDictModule(function, ["latent"], [written])

    agent = LS3Agent(
        2,
        latent_dim=4,
        encoder=TensorDictModule(lambda x: x, ["sensors"], ["latent"]),
        dynamics=TensorDictModule(Drift(), ["latent", "action"], [("next", "latent")]),
        value=module(lambda z: z[..., :1], "state_value"),
        safe_set=module(lambda z: 0 * z[..., :1] + 5, "safe_set_logit"),
        constraint=module(lambda z: 0 * z[..., :1] - 5, "constraint_logit"),
        goal=module(lambda z: 0 * z[..., :1] - 5, "goal_logit"),
    )
    assert not list(agent.parameters())
    planner = agent.planner(SPEC, **(OPTIONS | {"num_candidates": 200, "optim_steps": 4}))
    action = planner(TensorDict({"sensors": torch.zeros(3, 4)}, [3]))["action"]
    assert (action.sum(-1) > 1.5).all()  # the value rises with the sum of the actions, at most 2


def test_modules_that_do_not_fit_the_file_are_named(tmp_path):
    path = tiny(encoder=reader()).save(tmp_path / "agent.pt")
    other = TensorDictModule(torch.nn.Linear(11, 4), ["sensors"], ["latent"])
    with pytest.raises(ValueError, match=r"do not fit the modules that were given \(encoder\)"):
        LS3Agent.load(path, modules={"encoder": other})


def test_an_action_without_dimension_is_refused():
    with pytest.raises(ValueError, match=r"Give a single action as shape \[1\]"):
        LS3Agent(action_spec=Bounded(low=-1.0, high=1.0, shape=()))
