"""LS³'s learners: which data each draws, what the options change, and that training continues where it stopped."""

import contextlib
import copy
import pickle

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded

from ls3_torchrl import LS3Agent
from ls3_torchrl.data import DataWarning, EpisodeKeys, Tag, TaggedReplayBuffer
from ls3_torchrl.trainers import LossOptions, LS3Options, LS3Trainer, OfflineOptions, OnlineOptions, OptimOptions
from ls3_torchrl.trainers.ls3 import LEARNERS

OPTIM = OptimOptions(batch_size=16, autocast=False)


def trainer_of(agent, buffer, **options):
    return LS3Trainer(agent, buffer, LS3Options(**({"optim": OPTIM} | options)), progress=False)


@pytest.fixture
def filled(episode):
    """A buffer with an episode of each tag, encoded by the agent."""

    def make(agent, **options):
        buffer = TaggedReplayBuffer(100, latent_dim=8, **options)
        flags = {"success": {"success": 8}, "constraint": {"constraint": 5}, "online": {}}
        for tag, rises in flags.items():
            buffer.add(episode(actions=torch.randn(9, 2), **rises), tag)
        buffer.encode(agent.encoder)
        return buffer

    return make


def test_each_learner_draws_from_the_data_that_the_paper_names(make_agent):
    agent, buffer, drawn = make_agent(), TaggedReplayBuffer(100, latent_dim=8), {}

    def draw(batches, rows, selection, *, generator):
        assert selection.without == ("after_violation" if current == "dynamics" else None)
        assert selection.steps is None
        assert selection.online_fraction == 0.25
        drawn[current] = ({tag.name.lower() for tag in selection.tags}, rows // OPTIM.batch_size)
        raise KeyboardInterrupt

    buffer.draw = draw
    trainer = trainer_of(agent, buffer, online=OnlineOptions(fraction=0.25))
    for current in LEARNERS:
        with pytest.raises(KeyboardInterrupt):
            trainer.learners[current].sample()
    everything = {"success", "rand", "constraint", "online"}
    assert drawn == {
        "dynamics": (everything, agent.dynamics.num_members),
        "value": ({"success", "online"}, agent.value.num_members),
        "value_td": ({"success", "online"}, agent.value.num_members),
        "safe_set": (everything, 1),
        "constraint": (everything, 1),
        "goal": (everything, 1),
    }


def test_what_follows_a_violation_teaches_the_dynamics_nothing(make_agent, episode):
    agent = make_agent()
    buffer = TaggedReplayBuffer(100, latent_dim=8)
    number = torch.arange(9.0).unsqueeze(-1).expand(-1, 2)
    buffer.add(episode(actions=number, constraint=3), "constraint")
    buffer.encode(agent.encoder)
    trainer = trainer_of(agent, buffer)
    steps = {int(step) for step in trainer.dynamics.sample()["action"].flatten().tolist()}
    assert max(steps) == 3  # the step to the violation itself is not left out
    assert len(trainer.constraint.sample()["next", "constraint"].unique()) == 2


def test_episodes_that_timed_out_count_as_the_option_says_online_alone(make_agent, episode):
    agent = make_agent()
    buffer = TaggedReplayBuffer(100, latent_dim=8)
    buffer.add(episode(success=8), "success")
    buffer.add(episode(), "rand")
    for outcome in ({}, {"success": 8}, {"constraint": 8}):
        buffer.add(episode(**outcome), "online")
    buffer.encode(agent.encoder)
    assert "safe_set_weight" not in trainer_of(agent, buffer).safe_set.sample()  # as in the paper
    trainer = trainer_of(
        agent, buffer, loss=LossOptions(timed_out_weight=0.25), optim=OptimOptions(batch_size=400, autocast=False)
    )
    trainer.safe_set.sample.extra_keys += ("frame", ("next", "success"), ("next", "constraint"))
    rows = trainer.safe_set.sample()
    weight = rows["safe_set_weight"].flatten()
    light = weight == 0.25
    assert light.any()
    assert (weight[~light] == 1.0).all()
    # The online episode that timed out is the third of the five that were added.
    assert torch.equal(light, (rows["frame"].flatten() >= 20) & (rows["frame"].flatten() < 30))
    assert (rows["tag"].flatten() == int(Tag.ONLINE))[light].all()
    assert not any(rows["next", key].flatten()[light].any() for key in ("success", "constraint"))


def test_mean_latents_feed_posterior_means_to_the_models_that_are_named(make_agent, filled):
    agent = make_agent()
    trainer = trainer_of(agent, filled(agent), loss=LossOptions(mean_latents=("dynamics", "goal")))
    assert trainer.dynamics.loss.tensor_keys.latent == "loc"
    assert trainer.dynamics.loss.tensor_keys.next_latent == ("next", "loc")
    assert trainer.goal.loss.tensor_keys.latent == ("next", "loc")
    assert trainer.constraint.loss.tensor_keys.latent == ("next", "latent")
    assert trainer.safe_set.loss.tensor_keys.latent == "latent"


def test_the_discount_is_the_buffers(make_agent, filled):
    agent = make_agent()
    assert trainer_of(agent, filled(agent, gamma=0.7)).value_td.loss.gamma == 0.7


def test_phases_take_their_steps_in_the_papers_order(make_agent, filled, recorder):
    agent = make_agent()
    options = LS3Options(OfflineOptions(4, 2, 3), OnlineOptions(2, 1, 2), OPTIM)
    trainer = LS3Trainer(agent, filled(agent), options, logger=recorder, progress=False)
    trainer.train_offline()
    phases = list(dict.fromkeys(name.split("/")[0] for name, _, _ in recorder.rows))
    assert phases == ["Dynamics", "Value, reward-to-go", "Safe set", "Constraint", "Goal"]
    steps = {name: learner.steps for name, learner in trainer.learners.items()}
    assert steps == {"dynamics": 4, "value": 3, "value_td": 0, "safe_set": 2, "constraint": 2, "goal": 2}
    trainer.update()
    steps = {name: learner.steps for name, learner in trainer.learners.items()}
    assert steps == {"dynamics": 6, "value": 3, "value_td": 2, "safe_set": 3, "constraint": 3, "goal": 3}


def test_training_that_continues_from_its_state_ends_as_one_that_was_never_stopped(make_agent, filled):
    options = LS3Options(OfflineOptions(3, 3, 3), OnlineOptions(3, 3, 3), OptimOptions(16, target_interval=2))
    torch.manual_seed(5)
    source = make_agent()
    buffer = filled(source)

    def trainer(seed):
        torch.manual_seed(seed)
        return LS3Trainer(make_agent(), buffer, options, progress=False)

    whole, first, second = trainer(0), trainer(0), trainer(1)
    torch.manual_seed(9)
    whole.train_offline()
    whole.update()
    torch.manual_seed(9)
    first.train_offline()
    second.load_state_dict(first.state_dict())
    second.update()
    for name in ("dynamics", "value", "safe_set", "constraint", "goal"):
        pairs = zip(getattr(whole.agent, name).parameters(), getattr(second.agent, name).parameters(), strict=True)
        assert all(torch.equal(a, b) for a, b in pairs), name


@pytest.mark.parametrize("stop", [2, 4, 8, 9, 10, 14, 18])
def test_training_that_was_stopped_in_any_phase_is_taken_up_at_that_step(make_agent, filled, stop):
    options = LS3Options(OfflineOptions(3, 3, 3), OnlineOptions(3, 3, 3), OptimOptions(16, target_interval=2))
    torch.manual_seed(5)
    buffer = filled(make_agent())

    def trainer(seed, after_step=None):
        torch.manual_seed(seed)
        return LS3Trainer(make_agent(), buffer, options, progress=False, after_step=after_step)

    calls, kept = [], {}

    def keep():
        calls.append(None)
        if len(calls) == stop:
            kept.update(state=first.state_dict(), draws=torch.get_rng_state())
            raise KeyboardInterrupt

    whole, first, second = trainer(0), trainer(0, keep), trainer(1)
    torch.manual_seed(9)
    whole.train_offline()
    whole.update()
    torch.manual_seed(9)
    with contextlib.suppress(KeyboardInterrupt):
        first.train_offline()
        first.update()
    assert len(calls) == stop
    second.load_state_dict(kept["state"])
    torch.set_rng_state(kept["draws"])
    if stop <= 9:
        second.train_offline()
    second.update()
    for name, learner in whole.learners.items():
        assert second.learners[name].steps == learner.steps, name
        for key, expected in learner.loss.state_dict().items():
            assert torch.equal(second.learners[name].loss.state_dict()[key], expected), (name, key)


def test_states_under_keys_of_ones_own_train_as_pixels_do(episode, recorder):
    keys = EpisodeKeys(
        observation=("robot", "state"),
        action=("robot", "torque"),
        reward=("next", "task", "reward"),
        constraint=("next", "task", "hit"),
        success=("next", "task", "done"),
    )
    standard = episode(actions=torch.randn(9, 2), success=6, constraint=4)
    states = torch.randn(10, 3)
    content = standard.empty()
    content[keys.observation], content[keys.next_observation] = states[:-1], states[1:]
    content[keys.action] = standard["action"]
    for name in ("reward", "constraint", "success"):
        content[getattr(keys, name)] = standard["next", name]
    buffer = TaggedReplayBuffer(100, latent_dim=3, keys=keys)
    for tag in ("success", "constraint"):
        buffer.add(content, tag)
    encoder = TensorDictModule(torch.nn.Identity(), [keys.observation], ["latent"])
    agent = LS3Agent(action_dim=2, latent_dim=3, encoder=encoder, num_values=2, num_dynamics=2)
    buffer.encode(agent.encoder)
    options = LS3Options(OfflineOptions(2, 2, 2), OnlineOptions(1, 1, 1), OPTIM)
    trainer = LS3Trainer(agent, buffer, options, logger=recorder, progress=False)
    trainer.train_offline()
    trainer.update()
    assert {name: learner.steps for name, learner in trainer.learners.items()} == {
        name: {"value": 2, "value_td": 1}.get(name, 3) for name in LEARNERS
    }
    labels = trainer.goal.sample()[keys.success].float().mean()
    assert 0.0 < labels < 1.0


class Scalar(torch.nn.Module):
    """A single value function, without members."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(8, 1)

    def forward(self, latent):
        return self.layer(latent)


def test_a_value_function_without_members_trains_too(make_agent, filled):
    value = TensorDictModule(Scalar(), ["latent"], ["state_value"])
    agent = make_agent(value=value)
    before = value.module.layer.weight.detach().clone()
    options = LS3Options(OfflineOptions(2, 2, 2), optim=OPTIM)
    LS3Trainer(agent, filled(agent), options, progress=False).train_offline()
    assert not torch.equal(value.module.layer.weight, before)


def test_an_agent_in_double_precision_trains_on_what_the_buffer_holds(make_agent, filled):
    agent = make_agent()
    buffer = filled(agent)
    agent.double()
    options = LS3Options(OfflineOptions(2, 2, 2), optim=OPTIM)
    trainer = LS3Trainer(agent, buffer, options, progress=False)
    trainer.train_offline()
    assert all(p.dtype == torch.float64 for p in agent.parameters())


def test_an_agent_that_is_cast_behind_its_trainers_back_is_noticed(make_agent, filled):
    agent = make_agent()
    trainer = trainer_of(agent, filled(agent))
    agent.double()
    with pytest.raises(RuntimeError, match=r"before its trainer is made"):
        trainer.value_td.train(1, "Value, TD-1")


def test_a_constraint_that_is_known_and_a_goal_that_is_frozen_need_no_training(make_agent, filled, tmp_path):
    known = TensorDictModule(lambda latent: 10.0 * (latent[..., :1] - 1.0), ["latent"], ["constraint_logit"])
    agent = make_agent(constraint=known)
    agent.goal.requires_grad_(False)
    goal = [p.clone() for p in agent.goal.parameters()]
    trainer = trainer_of(agent, filled(agent), offline=OfflineOptions(2, 2, 2))
    trainer.train_offline()
    assert (trainer.constraint.steps, trainer.goal.steps, trainer.safe_set.steps) == (0, 0, 2)
    assert all(torch.equal(a, b) for a, b in zip(goal, agent.goal.parameters(), strict=True))
    trainer.load_state_dict(trainer.state_dict())


def test_a_copy_of_a_trainer_draws_from_a_buffer_of_its_own(make_agent, filled):
    agent = make_agent()
    buffer = filled(agent)
    trainer = trainer_of(agent, buffer)
    for other in (copy.deepcopy(trainer), pickle.loads(pickle.dumps(trainer))):
        assert other.buffer is not buffer
        buffer.draw = other.buffer.draw = None  # whoever draws from it says so
        for name in LEARNERS:
            with pytest.raises(TypeError):
                other.learners[name].sample()
        del buffer.draw
        for name in LEARNERS:
            with pytest.raises(TypeError):
                other.learners[name].sample()


def test_latents_of_another_size_than_the_buffers_are_refused_before_any_work(make_agent, filled):
    with pytest.raises(ValueError, match=r"agent's latents have size 5, the buffer's 8"):
        trainer_of(make_agent(latent_dim=5), filled(make_agent()))


def test_data_of_another_robot_are_refused_before_any_step(make_agent, episode):
    agent = make_agent(action_spec=Bounded(-1.0, 1.0, shape=(2,)))

    def train(actions):
        buffer = TaggedReplayBuffer(100, latent_dim=8)
        buffer.add(episode(actions=actions, success=8, constraint=4), "success")
        buffer.encode(agent.encoder)
        trainer_of(agent, buffer).train_offline()

    with pytest.raises(ValueError, match=r"'action' has 3 actions, the agent's networks have 2"):
        train(torch.zeros(9, 3))
    with pytest.raises(ValueError, match=r"'action' lies outside of what can be carried out in 9 of 9 steps.*unit"):
        train(torch.full((9, 2), 10.0))


@pytest.mark.parametrize(("flags", "missing"), [({"constraint": 4}, "success"), ({"success": 8}, "violation")])
def test_data_without_a_success_or_a_violation_are_warned_of(make_agent, episode, flags, missing):
    agent, buffer = make_agent(), TaggedReplayBuffer(100, latent_dim=8)
    buffer.add(episode(**flags), "success")
    buffer.encode(agent.encoder)
    trainer = trainer_of(agent, buffer, offline=OfflineOptions(0, 0, 0))
    with pytest.warns(DataWarning, match=f"hold no {missing}"):
        trainer.train_offline()
