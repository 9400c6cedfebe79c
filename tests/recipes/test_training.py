"""The learners: what a phase starts from, and how divergence is reported."""

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from tensordict import TensorDict

from ls3_torchrl import LS3Agent
from ls3_torchrl.data import TaggedReplayBuffer
from ls3_torchrl.modules import ValueEnsemble
from ls3_torchrl.objectives import OfflineValueLoss, TD1ValueLoss
from training import Learner, Training, check_settings


class Silent:
    """A run folder that keeps what is logged."""

    def __init__(self):
        self.rows = []

    def log(self, phase, step, **values):
        self.rows.append((phase, step, values))


@pytest.fixture
def config(request):
    conf = request.config.rootpath / "recipes" / "conf"
    with initialize_config_dir(str(conf), version_base="1.3"):
        return compose("ls3", ["preset=smoke"])


def test_td1_starts_from_what_reward_to_go_had_learnt():
    # With a target made beforehand, TD-1 pulled every value back towards that of an untrained network.
    value = ValueEnsemble(4, num_members=2, hidden=(16,))
    z = torch.randn(64, 4)
    reached = {"latent": z, "reward": torch.full((64, 1), -1.0)}
    batch = TensorDict({"latent": z, "reward_to_go": torch.full((64, 1), -100.0), "next": reached}, [64])
    first = Learner("value", OfflineValueLoss(value), lambda: batch, lr=0.03)
    second = Learner("value", TD1ValueLoss(value, gamma=0.99), lambda: batch, lr=0.03, target_interval=100)
    run = Silent()
    first.train(400, "Value, reward-to-go", run)
    before = value(batch.select("latent"))["state_value"].mean().item()
    assert before == pytest.approx(-100.0, abs=1.0)
    second.train(150, "Value, TD-1", run)
    # -1 + 0.99 * -100 = -100: the values that solve equation (3) solve equation (4) as well.
    assert value(batch.select("latent"))["state_value"].mean().item() == pytest.approx(-100.0, abs=2.0)


def test_a_loss_that_is_not_finite_stops_the_phase_with_a_remedy():
    value = ValueEnsemble(4, num_members=2, hidden=(8,))
    bad = TensorDict({"latent": torch.randn(8, 4), "reward_to_go": torch.full((8, 1), torch.nan)}, [8])
    learner = Learner("value", OfflineValueLoss(value), lambda: bad, lr=1e-3)
    with pytest.raises(FloatingPointError, match="learning rate"):
        learner.train(3, "Value", Silent())


def test_each_learner_draws_from_the_data_that_the_paper_names(config):
    agent = LS3Agent(action_dim=2, **config.agent)
    buffer = TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim)
    drawn = {}

    def sample(batch_size, *, tags, members=None):
        drawn[current] = ({tag.name.lower() for tag in tags}, members)
        raise KeyboardInterrupt

    buffer.sample = sample
    training = Training(agent, buffer, config, Silent())
    for current in ("dynamics", "background", "value", "value_td", "safe_set", "constraint", "goal"):
        with pytest.raises(KeyboardInterrupt):
            getattr(training, current).sample()
    everything = {"success", "rand", "constraint", "online"}
    assert drawn == {
        "dynamics": (everything, agent.dynamics.num_members),
        "background": (everything, agent.value.num_members),
        "value": ({"success", "online"}, agent.value.num_members),
        "value_td": ({"success", "online"}, agent.value.num_members),
        "safe_set": (everything, None),
        "constraint": (everything, None),
        "goal": (everything, None),
    }


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vae.schedule", "cosine"),
        ("vae.reduction", "median"),
        ("vae.crop_scale", [0.5, 1.5]),
        ("vae.steps", 0),
        ("optim.lr", -1.0),
        ("online.episodes_per_update", 0),
    ],
)
def test_settings_that_would_fail_late_are_refused_early(config, name, value):
    check_settings(config)
    OmegaConf.update(config, name, value)
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        check_settings(config)
