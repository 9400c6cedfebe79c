"""LS³'s learners: which data each draws, and what the settings change."""

import pytest
import torch
from helpers import Silent, make_agent
from omegaconf import OmegaConf
from tensordict import TensorDict

from ls3_torchrl.data import Tag, TaggedReplayBuffer
from representation import train_vae
from training import Training


def test_each_learner_draws_from_the_data_that_the_paper_names(config):
    agent = make_agent(config)
    buffer = TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim)
    drawn = {}

    OmegaConf.update(config, "online.fraction", 0.25)

    def sample(batch_size, *, tags, members=None, without=None, steps=None, online_fraction):
        assert without is None
        assert steps is None
        assert online_fraction == 0.25
        drawn[current] = ({tag.name.lower() for tag in tags}, members)
        raise KeyboardInterrupt

    buffer.sample = sample
    training = Training(agent, buffer, config, Silent())
    for current in ("dynamics", "value", "value_td", "safe_set", "constraint", "goal"):
        with pytest.raises(KeyboardInterrupt):
            getattr(training, current).sample()
    everything = {"success", "rand", "constraint", "online"}
    assert drawn == {
        "dynamics": (everything, agent.dynamics.num_members),
        "value": ({"success", "online"}, agent.value.num_members),
        "value_td": ({"success", "online"}, agent.value.num_members),
        "safe_set": (everything, None),
        "constraint": (everything, None),
        "goal": (everything, None),
    }


@pytest.mark.parametrize("frozen", [True, False])
def test_what_follows_a_violation_teaches_the_dynamics_as_the_setting_says(config, frozen):
    OmegaConf.update(config, "loss.frozen_dynamics", frozen)
    OmegaConf.update(config, "vae.prediction_weight", 1.0)
    agent = make_agent(config)
    buffer = TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim)
    step = {"reward": -torch.ones(9, 1), "pixels": torch.zeros(9, 3, 64, 64, dtype=torch.uint8)}
    step |= {k: torch.zeros(9, 1, dtype=torch.bool) for k in ("constraint", "success")}
    step["constraint"][3:] = True
    number = torch.arange(9.0).unsqueeze(-1).expand(-1, 2)
    buffer.add(TensorDict({"pixels": step["pixels"], "action": number, "next": step}, [9]), "constraint")
    drawn = []
    draw = buffer.sample_frame_transitions
    buffer.sample_frame_transitions = lambda *a, **o: drawn.append(draw(*a, **o)) or drawn[-1]
    training = Training(agent, buffer, config, Silent())
    train_vae(agent, buffer, config, Silent())
    latent = {int(step) for step in training.dynamics.sample()["action"].flatten().tolist()}
    pixels = {int(step) for batch in drawn for step in batch["action"].flatten().tolist()}
    for steps in (latent, pixels):
        assert (max(steps) > 3) == frozen  # the step to the violation itself is not left out
    assert 3 in latent
    assert len(training.constraint.sample()["next", "constraint"].unique()) == 2


def test_undecided_episodes_count_as_the_setting_says_online_alone(config):
    agent = make_agent(config)
    buffer = TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim)

    def episode(**ends):
        step = {"reward": -torch.ones(9, 1), "pixels": torch.zeros(9, 3, 64, 64, dtype=torch.uint8)}
        step |= {k: torch.zeros(9, 1, dtype=torch.bool) for k in ("constraint", "success")}
        for key in ends:
            step[key][-1] = True
        return TensorDict({"pixels": step["pixels"], "action": torch.zeros(9, 2), "next": step}, [9])

    buffer.add(episode(success=True), "success")
    buffer.add(episode(), "rand")
    for outcome in ({}, {"success": True}, {"constraint": True}):
        buffer.add(episode(**outcome), "online")
    buffer.encode(agent.encoder)
    rows = Training(agent, buffer, config, Silent()).safe_set.sample()
    assert "safe_set_weight" not in rows  # as in the paper
    OmegaConf.update(config, "loss.timed_out_weight", 0.25)
    OmegaConf.update(config, "optim.batch_size", 400)
    rows = Training(agent, buffer, config, Silent()).safe_set.sample()
    outcome = [rows["next", key].flatten() for key in ("success", "constraint")]
    online = rows["tag"].flatten() == int(Tag.ONLINE)
    weight = rows["safe_set_weight"].flatten()
    light = weight == 0.25
    assert light.any()
    assert (weight[~light] == 1.0).all()
    # The undecided online episode is the third of the five that were added.
    assert torch.equal(light, (rows["frame"].flatten() >= 20) & (rows["frame"].flatten() < 30))
    assert online[light].all()
    assert not any(kind[light].any() for kind in outcome)


def test_failures_are_violating_demonstrations_at_the_value_of_failure(config):
    OmegaConf.update(config, "loss.failure_weight", 0.5)
    OmegaConf.update(config, "loss.failure_value", -42.0)
    agent = make_agent(config)
    buffer = TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim)
    step = {"reward": -torch.ones(9, 1), "pixels": torch.zeros(9, 3, 64, 64, dtype=torch.uint8)}
    step |= {k: torch.zeros(9, 1, dtype=torch.bool) for k in ("constraint", "success")}
    episode = TensorDict({"pixels": step["pixels"], "action": torch.zeros(9, 2), "next": step}, [9])
    for tag in ("success", "constraint", "online"):
        buffer.add(episode, tag)
    buffer.encode(agent.encoder)
    training = Training(agent, buffer, config, Silent())
    rows = training.value.auxiliary.sample()
    assert (rows["tag"] == int(Tag.CONSTRAINT)).all()
    assert (rows["reward_to_go"] == -42.0).all()
    assert training.value.auxiliary.weight == 0.5
    # The buffer itself keeps the returns that were seen.
    assert (buffer.sample(50, tags=["constraint"])["reward_to_go"] > -42.0).all()


def test_failures_may_be_the_violating_states_alone_and_have_the_value_of_an_episode_without_success(config):
    OmegaConf.update(config, "loss.failure_weight", 0.5)
    OmegaConf.update(config, "loss.failure_rows", "violating")
    agent = make_agent(config)
    buffer = TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim)
    step = {"reward": -torch.ones(9, 1), "pixels": torch.randint(256, (9, 3, 64, 64), dtype=torch.uint8)}
    step |= {"success": torch.zeros(9, 1, dtype=torch.bool), "constraint": torch.arange(9)[:, None] >= 7}
    buffer.add(TensorDict({"pixels": step["pixels"], "action": torch.zeros(9, 2), "next": step}, [9]), "constraint")
    buffer.encode(agent.encoder)
    training = Training(agent, buffer, config, Silent(), horizon=3)
    rows = training.value.auxiliary.sample()
    assert rows.batch_size == (4, agent.value.num_members)
    assert rows["next", "constraint"].all()
    assert torch.equal(rows["latent"], rows["next", "latent"])
    torch.testing.assert_close(rows["reward_to_go"], torch.full_like(rows["reward_to_go"], -(1 + 0.99 + 0.99**2)))


def test_mean_latents_feed_posterior_means_to_the_models_that_are_named(config):
    OmegaConf.update(config, "loss.mean_latents", ["dynamics", "goal"])
    agent = make_agent(config)
    training = Training(agent, TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim), config, Silent())
    assert training.dynamics.loss.tensor_keys.latent == "loc"
    assert training.dynamics.loss.tensor_keys.next_latent == ("next", "loc")
    assert training.goal.loss.tensor_keys.latent == ("next", "loc")
    assert training.constraint.loss.tensor_keys.latent == ("next", "latent")
    assert training.safe_set.loss.tensor_keys.latent == "latent"
