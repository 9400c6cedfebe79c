"""A domain of a user's own, as docs/new_domain.md shows it: one file, one row, and everything knows it."""

import inspect
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torch import Tensor
from torchrl.envs.utils import check_env_specs

import ls3_envs
from ls3_envs import Circle, Domain, OfflineData, Plane, Rectangle, VisualConstraintEnv
from ls3_envs.demonstrators import Scripted, collect_episodes

DOC = (Path(__file__).parents[2] / "docs" / "new_domain.md").read_text()


class FerryEnv(VisualConstraintEnv):
    """A boat crosses a river, 1 wide and 1 long, to a dock; downstream is a waterfall.

    The state is the boat's place (x, y), y downstream; an action moves it by up to .05 a step, the current by .01 more.
    """

    dock, dock_radius, waterfall, current = (0.85, 0.3), 0.08, 0.8, 0.01

    def __init__(self, num_envs=1, *, horizon=40, device="cpu", seed=None):
        super().__init__(
            num_envs=num_envs,
            state_dim=2,
            action_low=(-0.05, -0.05),
            action_high=(0.05, 0.05),
            horizon=horizon,
            device=device,
            seed=seed,
        )

    def _initial_state(self, index: int, generator: np.random.Generator) -> Tensor:
        return torch.as_tensor(generator.normal((0.15, 0.3), 0.01))

    def _advance(self, state: Tensor, action: Tensor) -> Tensor:
        return self.advance_noiseless(state, action)

    def _violates(self, state: Tensor) -> Tensor:
        return state[..., 1:] > self.waterfall

    def _succeeds(self, state: Tensor) -> Tensor:
        return (state - state.new_tensor(self.dock)).norm(dim=-1, keepdim=True) < self.dock_radius

    def _render(self, state: Tensor) -> Tensor:
        axis = (torch.arange(self.image_size, device=state.device) + 0.5) / self.image_size
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        image = state.new_tensor((30, 90, 200)).view(3, 1, 1).repeat(len(state), 1, self.image_size, self.image_size)
        image[:, :, y > self.waterfall] = 230
        image[:, :, (x - self.dock[0]) ** 2 + (y - self.dock[1]) ** 2 < self.dock_radius**2] = 60
        boat = (x - state[:, 0, None, None]) ** 2 + (y - state[:, 1, None, None]) ** 2 < 0.06**2
        return torch.where(boat[:, None], state.new_tensor((240, 60, 40)).view(3, 1, 1), image).to(torch.uint8)

    # For pictures alone: maps, paths and plans over the river.

    def plane(self, points: int = 60) -> Plane:
        axis = (torch.arange(points) + 0.5) / points
        return Plane(
            states=torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1),
            extent=(0.0, 1.0, 1.0, 0.0),
            outlines=(Circle(self.dock, self.dock_radius), Rectangle((0.0, self.waterfall), (1.0, 1.0))),
        )

    def advance_noiseless(self, state: Tensor, action: Tensor) -> Tensor:
        return (state + action + state.new_tensor((0.0, self.current))).clamp(0.0, 1.0)


class FerryDemonstrator(Scripted):
    """Steers straight to the dock, against the current."""

    def __init__(self, *, seed: int = 0) -> None:
        super().__init__(limit=0.05, noise_std=0.01, seed=seed)

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        return (state.new_tensor(FerryEnv.dock) - state).clamp(-0.05, 0.05)


class FerryDrifter(FerryDemonstrator):
    """Leaves the boat to the current after some steps of its way: all episodes violate."""

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        turn = self._for_the_episode("turn", self._uniform(state, 1, 0.0, 10.0), is_init)
        return torch.where(step < turn, super()._act(state, step, is_init), state.new_tensor((0.0, 0.02)))


@pytest.fixture
def ferry():
    ls3_envs.register(
        "ferry",
        Domain(
            env=FerryEnv,
            gym_id="mine/Ferry-v0",
            offline={
                "success": OfflineData(20, FerryDemonstrator),
                "constraint": OfflineData(10, FerryDrifter),
            },
        ),
    )
    yield "ferry"
    ls3_envs.unregister("ferry")


def test_it_can_be_made_and_keeps_the_bases_promises(ferry):
    env = ls3_envs.make(ferry, num_envs=3, horizon=5, seed=0)
    check_env_specs(env)
    assert isinstance(env.base_env, FerryEnv)
    episode = env.rollout(5)
    assert episode["next", "truncated"][..., 0].tolist() == [[False] * 4 + [True]] * 3
    alone = ls3_envs.make(ferry, num_envs=1, horizon=5, seed=0)
    assert torch.equal(
        alone.reset()["state"][0], ls3_envs.make(ferry, num_envs=3, horizon=5, seed=0).reset()["state"][0]
    )


def test_its_offline_data_are_collected(ferry):
    success, constraint = (ls3_envs.collect_offline(ferry, kind) for kind in ("success", "constraint"))
    assert success.batch_size == (20, 40)
    assert success["next", "success"][:, -1].all()
    assert not success["next", "constraint"].any()
    assert constraint.batch_size == (10, 40)
    assert constraint["next", "constraint"][:, -1].all()
    with pytest.raises(ValueError, match="Domain 'ferry' has no offline data 'rand'; it has: constraint, success"):
        ls3_envs.collect_offline(ferry, "rand")


def test_frames_are_stacked_as_its_row_says():
    ls3_envs.register("ferry", Domain(FerryEnv, "mine/Ferry-v0", frames=2, frame_stride=3))
    try:
        assert ls3_envs.make("ferry").reset()["pixels"].shape == (1, 6, 64, 64)
    finally:
        ls3_envs.unregister("ferry")


def test_gymnasium_knows_it(ferry):
    check_env(gymnasium.make("mine/Ferry-v0", render_mode="rgb_array", horizon=8).unwrapped)
    many = gymnasium.make_vec("mine/Ferry-v0", num_envs=2, vectorization_mode="vector_entry_point")
    images, info = many.reset(seed=0)
    assert images.shape == (2, 64, 64, 3)
    assert info["constraint"].tolist() == [False, False]


def test_it_is_in_every_list_until_it_is_taken_out(ferry):
    assert list(ls3_envs.DOMAINS)[-1] == "ferry"
    with pytest.raises(ValueError, match=r"Known domains: cable_routing, ferry, navigation"):
        ls3_envs.make("fery")
    ls3_envs.unregister("ferry")
    assert "ferry" not in ls3_envs.DOMAINS
    assert "mine/Ferry-v0" not in gymnasium.registry
    with pytest.raises(ValueError, match="Unknown domain 'ferry'"):
        ls3_envs.unregister("ferry")
    ls3_envs.register("ferry", Domain(FerryEnv, "mine/Ferry-v0"))  # the fixture takes it out again


def test_taken_names_are_refused_and_leave_everything_as_it_was(ferry):
    before, ids = dict(ls3_envs.DOMAINS), set(gymnasium.registry)
    with pytest.raises(ValueError, match=r"Domain 'ferry' is registered already\. .*unregister\('ferry'\)"):
        ls3_envs.register("ferry", Domain(FerryEnv, "mine/Ferry-v1"))
    with pytest.raises(ValueError, match=r"an environment 'ls3/Navigation-v0' already.*gym_id for 'boat'"):
        ls3_envs.register("boat", Domain(FerryEnv, "ls3/Navigation-v0"))
    assert dict(ls3_envs.DOMAINS) == before
    assert set(gymnasium.registry) == ids


def test_a_table_that_is_only_to_be_read():
    with pytest.raises(TypeError):
        ls3_envs.DOMAINS["ferry"] = Domain(FerryEnv, "mine/Ferry-v0")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"gym_id": "Ferry"}, "gym_id must read 'namespace/Name-v0', got 'Ferry'"),
        ({"offline": {"demos": OfflineData(1, FerryDemonstrator)}}, "'success', 'rand', 'constraint', got 'demos'"),
        ({"frames": 0}, "frames must be at least 1, got 0"),
        ({"frame_stride": 0}, "frame_stride must be at least 1, got 0"),
    ],
)
def test_rows_that_cannot_be_right_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Domain(**({"env": FerryEnv, "gym_id": "mine/Ferry-v0"} | wrong))


def test_offline_data_of_no_episodes_are_refused():
    with pytest.raises(ValueError, match="episodes must be at least 1, got 0"):
        OfflineData(0, FerryDemonstrator)


def test_its_plans_follow_its_own_dynamics(ferry):
    env = ls3_envs.make(ferry, seed=0).base_env
    td = env.reset()
    action = torch.tensor([[0.02, -0.03]])
    there = env.advance_noiseless(td["state"], action)
    torch.testing.assert_close(there, td["state"] + torch.tensor([[0.02, -0.02]]))
    assert torch.equal(env.step(td.set("action", action))["next", "state"], there)


@pytest.mark.parametrize("part", [FerryEnv, FerryDemonstrator, FerryDrifter])
def test_the_document_shows_this_very_domain(part):
    assert inspect.getsource(part) in DOC


def test_the_documents_python_runs():
    blocks = re.findall(r"```python\n(.*?)```", DOC, flags=re.DOTALL)
    assert len(blocks) >= 2
    namespace: dict = {}
    try:
        for block in blocks:
            exec(compile(block, "new_domain.md", "exec"), namespace)
        assert ls3_envs.domain("ferry").env is namespace["FerryEnv"]
        assert namespace["episodes"]["next", "success"].any(1).all()
        assert collect_episodes(namespace["env"], namespace["FerryDemonstrator"]()).batch_size == (4, 40)
    finally:
        ls3_envs.unregister("ferry")
