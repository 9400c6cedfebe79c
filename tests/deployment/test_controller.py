"""Images in, actions out: what environment and collector do for a policy, without either."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Bounded
from torchrl.envs import CatFrames
from torchrl.modules import GRUModule

from ls3_torchrl import LS3Agent
from ls3_torchrl.deployment import Controller
from ls3_torchrl.planners import SafeSetFilter

SMALL = {"horizon": 3, "num_candidates": 20, "num_elites": 4, "num_particles": 2, "optim_steps": 2, "p_random": 0.3}


class Spy:
    """Remembers what it is given, and acts by the brightness of the newest image."""

    def __init__(self):
        self.seen = []

    def __call__(self, td):
        self.seen.append(td.clone())
        brightness = td["pixels"][..., -3:, :, :].float().mean((-1, -2, -3), keepdim=False) / 255.0
        td.set("action", brightness.unsqueeze(-1))
        return td.set(("next", "memory"), td["pixels"].float().mean((-1, -2, -3)).unsqueeze(-1))


def agent(**options):
    torch.manual_seed(0)
    return LS3Agent(action_spec=Bounded(low=-1.0, high=1.0, shape=(2,)), latent_dim=8, **options)


def grey(value, height=48, width=64):
    return np.full((height, width, 3), value, dtype=np.uint8)


def test_it_acts_on_the_image_it_is_shown():
    controller = Controller(Spy())
    assert controller.act(grey(255)).tolist() == [1.0]
    assert controller.act(grey(51)).tolist() == pytest.approx([0.2])
    assert controller.milliseconds > 0.0


def test_frames_are_stacked_as_the_environments_of_torchrl_stack_them():
    images = [grey(10 * (1 + t), 64, 64) for t in range(7)]
    stack = CatFrames(5, dim=-3, in_keys=["pixels"])
    spy = Spy()
    controller = Controller(spy, frames=3, frame_stride=2)
    spy.seen.clear()
    tds = TensorDict({"pixels": torch.stack([torch.from_numpy(i).movedim(-1, 0) for i in images])}, [7])
    done = torch.zeros(7, 1, dtype=torch.bool)
    tds["next"] = TensorDict({"done": done}, [7])
    expected = stack(tds.clone().refine_names("time"))["pixels"].unflatten(-3, (-1, 3))[:, ::2].flatten(1, 2)
    for image in images:
        controller.act(image)
    assert torch.equal(torch.cat([td["pixels"] for td in spy.seen]), expected)


def test_an_episode_begins_at_the_first_image_and_after_each_reset():
    spy = Spy()
    controller = Controller(spy, frames=2)
    spy.seen.clear()
    for value in (10, 20):
        controller.act(grey(value))
    controller.reset()
    controller.act(grey(30))
    assert [td["is_init"].item() for td in spy.seen] == [True, False, True]
    # What the policy wrote for the next step is there, and gone after a reset.
    assert spy.seen[1]["memory"].item() == 10.0
    assert "memory" not in spy.seen[0]
    assert "memory" not in spy.seen[2]
    assert spy.seen[2]["pixels"].unique().tolist() == [30]


def test_the_planner_goes_on_from_its_last_plan():
    torch.manual_seed(1)
    planner = agent().planner(**SMALL)
    controller = Controller(planner)
    torch.manual_seed(2)
    rows = [controller.step(grey(value)) for value in (50, 60)]
    # By hand, as a collector would carry it.
    torch.manual_seed(2)
    pixels = [torch.full((1, 3, 64, 64), value, dtype=torch.uint8) for value in (50, 60)]
    first = TensorDict({"pixels": pixels[0], "is_init": torch.ones(1, 1, dtype=torch.bool)}, [1])
    first = planner(first.update(planner.make_tensordict_primer().primers.zero().unsqueeze(0)))
    second = TensorDict({"pixels": pixels[1], "is_init": torch.zeros(1, 1, dtype=torch.bool)}, [1])
    second = planner(second.update(first["next"]))
    assert torch.equal(rows[0]["action"], first["action"][0])
    assert torch.equal(rows[1]["action"], second["action"][0])
    assert rows[1]["plan", "iterations"].item() >= 1


def test_a_reset_leaves_nothing_of_the_last_episode():
    policy, seen = agent().planner(**SMALL), []

    def watched(td):
        seen.append(sorted(map(str, td.keys(True, True))))
        return policy(td)

    watched_module = TensorDictSequential(policy)
    watched_module.forward = watched
    controller = Controller(watched_module)
    controller.act(grey(10))
    controller.reset()
    controller.act(grey(20))
    assert seen[-1] == seen[0] == ["('plan', 'mean')", "('plan', 'std')", "is_init", "pixels"]


def test_a_person_acts_through_the_filter():
    shield = SafeSetFilter(None, agent().planner(**SMALL))
    with pytest.raises(KeyError, match="needs the keys"):
        Controller(shield)
    shielded = Controller(shield, example={"action": [0.0, 0.0]})
    row = shielded.step(grey(9), action=[0.25, -0.5])
    assert row["filter", "proposed"].tolist() == [0.25, -0.5]


def test_making_one_leaves_the_random_numbers_alone():
    planner = agent().planner(**SMALL)
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    Controller(planner)
    assert torch.equal(torch.rand(3), expected)


def test_a_recurrent_policy_keeps_its_memory():
    torch.manual_seed(0)
    core = {"in_keys": ["seen", "hidden", "is_init"], "out_keys": ["features", ("next", "hidden")]}
    look = TensorDictModule(lambda pixels: pixels.float().mean((-1, -2)) / 255.0, in_keys=["pixels"], out_keys=["seen"])
    act = TensorDictModule(torch.nn.Linear(4, 2), in_keys=["features"], out_keys=["action"])
    controller = Controller(TensorDictSequential(look, GRUModule(3, 4, num_layers=1, **core), act))
    once, twice = (controller.act(grey(200)) for _ in range(2))
    controller.reset()
    assert (controller.act(grey(200)) == once).all()
    assert (once != twice).any()


def test_images_of_any_size_and_order_become_the_encoders():
    spy = Spy()
    controller = Controller(spy, channels="first", fit="crop", size=32)
    spy.seen.clear()
    controller.act(torch.zeros(3, 120, 160, dtype=torch.uint8))
    assert spy.seen[0]["pixels"].shape == (1, 3, 32, 32)
    controller = Controller(spy)
    spy.seen.clear()
    controller.act(np.zeros((100, 100), dtype=np.uint8))
    assert spy.seen[0]["pixels"].shape == (1, 3, 64, 64)


def test_what_cannot_work_is_refused_when_it_is_made():
    with pytest.raises(TypeError, match="policy must be a function"):
        Controller("agent.pt")
    with pytest.raises(ValueError, match="frames must be at least 1"):
        Controller(Spy(), frames=0)
    with pytest.raises(ValueError, match="in_channels"):
        Controller(agent().planner(**SMALL), frames=3)
    with pytest.raises(KeyError, match="Controller needs the keys"):
        Controller(lambda td: td)
    with pytest.raises(ValueError, match="one image at a time, got 2"):
        Controller(Spy()).act(np.zeros((2, 64, 64, 3), dtype=np.uint8))
