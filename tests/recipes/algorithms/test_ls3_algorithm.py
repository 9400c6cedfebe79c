"""LS³ under the protocol: its settings reach its parts, and its file is an agent's."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.algorithms.ls3 import LS3, probe
from ls3_recipes.configuration import train_settings
from ls3_torchrl import LS3Agent


class Box:
    """The specs of an environment, and no more."""

    action_spec = Bounded(low=torch.tensor([-3.0, 0.0]), high=torch.tensor([1.0, 0.02]), shape=(2,))
    observation_spec = {"pixels": torch.zeros(9, 64, 64)}  # noqa: RUF012


def make(*overrides):
    return LS3(train_settings("preset=smoke", *overrides), Box(), torch.device("cpu"))


def test_settings_reach_agent_planner_buffer_and_trainer(recorder):
    algorithm = make("planner.horizon=4", "buffer.gamma=0.9", "agent.background=true", "online.dynamics_steps=7")
    architecture = algorithm.agent.architecture
    assert (architecture.in_channels, architecture.latent_dim, architecture.background) == (9, 8, True)
    assert architecture.action_scale == pytest.approx((2.0, 0.01))  # box: half the range of each action
    assert algorithm.policy.horizon == 4
    assert algorithm.agent.task == "navigation"
    buffer = algorithm.make_buffer(torch.device("cpu"))
    assert (buffer.gamma, buffer.latent_dim, buffer.capacity) == (0.9, 8, 35_000)
    algorithm.begin(buffer, recorder, 12)
    assert algorithm.trainer.options.online.dynamics_steps == 7
    assert list(algorithm.phases()) == ["vae", "offline"]


def test_its_file_is_an_agents_that_plans_alike_and_fits_no_other_shape(tmp_path):
    algorithm = make()
    path = algorithm.save(tmp_path / "agent.pt")
    planner = LS3Agent.load(path).planner()
    assert (planner.horizon, planner.num_particles) == (3, 4)
    algorithm.restore(path)
    with pytest.raises(ValueError, match=r"another shape: latent_dim 8 instead of 5"):
        make("agent.latent_dim=5").restore(path)


def test_every_algorithm_has_a_name_and_a_colour_for_reports():
    algorithms = {key: row.load() for key, row in ALGORITHMS.items()}
    labels = [label for algorithm in algorithms.values() for label in algorithm.labels.values()]
    assert len({label.title for label in labels}) == len({label.colour for label in labels}) == len(labels) == 5
    assert all(key == algorithm.key for key, algorithm in algorithms.items())
    assert all(algorithm.name in algorithm.labels for algorithm in algorithms.values())


class Reader(torch.nn.Module):
    """Stands for an encoder whose means are the brightness of two pixels."""

    in_keys, out_keys = ["pixels"], ["loc", "scale", "latent"]

    def forward(self, td):
        corner = td["pixels"][:, :2, 0, 0].float() / 10.0
        return td.set("loc", corner).set("scale", torch.ones_like(corner)).set("latent", corner)


def test_a_run_without_states_or_with_short_episodes_is_summarised_without_a_probe():
    agent = LS3Agent(action_dim=2, latent_dim=2)
    agent.encoder = Reader()
    pixels = torch.randint(256, (20, 5, 3, 1, 1), dtype=torch.uint8)
    state = pixels[..., :2, 0, 0].float()
    reached = {"state": state[:, 1:], "pixels": pixels[:, 1:]}
    episodes = TensorDict(
        {"pixels": pixels[:, :-1], "state": state[:, :-1], "action": torch.zeros(20, 4, 2), "next": reached}, [20, 4]
    )
    assert probe(agent, [episodes], episodes.exclude("state"), horizon=3) == {}
    assert probe(agent, [episodes], episodes, horizon=5) == {}
    assert set(probe(agent, [episodes], episodes, horizon=3)) == {"state_error", "imagined_3_steps_error"}
