"""The learners: what a phase starts from, and how divergence is reported."""

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.objectives import HardUpdate

from learning import Learner, Term, cooled_down
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, TaggedReplayBuffer
from ls3_torchrl.modules import ValueEnsemble
from ls3_torchrl.objectives import EnsembleDynamicsLoss, OfflineValueLoss, SafeSetLoss, TD1ValueLoss, VAELoss
from representation import enlarge, train_vae
from settings import agent_options
from training import Training


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


def make_agent(config):
    return LS3Agent(**agent_options(config, Bounded(low=-3.0, high=3.0, shape=(2,))), action_dim=2)


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
    agent = make_agent(config)
    buffer = TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim)
    drawn = {}

    def sample(batch_size, *, tags, members=None, without=None, steps=None):
        assert without is None
        assert steps is None
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
    draw = buffer.sample_pixel_transitions
    buffer.sample_pixel_transitions = lambda *a, **o: drawn.append(draw(*a, **o)) or drawn[-1]
    training = Training(agent, buffer, config, Silent())
    train_vae(agent, buffer, config, Silent())
    latent = {int(step) for step in training.dynamics.sample()["action"].flatten().tolist()}
    pixels = {int(step) for batch in drawn for step in batch["action"].flatten().tolist()}
    for steps in (latent, pixels):
        assert (max(steps) > 3) == frozen  # the step to the violation itself is not left out
    assert 3 in latent
    assert len(training.constraint.sample()["next", "constraint"].unique()) == 2


@pytest.mark.parametrize("background", [True, False])
def test_a_decoder_with_a_background_starts_from_the_mean_image(config, background):
    OmegaConf.update(config, "agent.background", background)
    agent = make_agent(config)
    buffer = TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim)
    step = {"reward": -torch.ones(9, 1), "pixels": torch.full((9, 3, 64, 64), 51, dtype=torch.uint8)}
    step |= {k: torch.zeros(9, 1, dtype=torch.bool) for k in ("constraint", "success")}
    buffer.add(TensorDict({"pixels": step["pixels"], "action": torch.zeros(9, 2), "next": step}, [9]), "success")
    run = Silent()
    train_vae(agent, buffer, config, run)
    first = run.rows[0][2]["reconstruction"]
    assert (first < 0.01) == background  # black is 0.2² = 0.04 away


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
    OmegaConf.update(config, "loss.undecided_weight", 0.25)
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


def test_a_term_beside_the_loss_pulls_the_same_network_with_its_weight():
    value = ValueEnsemble(4, num_members=1, hidden=(16,))
    z, far = torch.zeros(32, 4), torch.ones(32, 4)
    near_batch = TensorDict({"latent": z, "reward_to_go": torch.full((32, 1), -5.0)}, [32])
    far_batch = TensorDict({"latent": far, "reward_to_go": torch.full((32, 1), -60.0)}, [32])
    # On the same states, a term of weight 3 draws the least-squares value to three quarters of the way.
    both = Term(3.0, OfflineValueLoss(value), lambda: far_batch.set("latent", z))
    learner = Learner("value", OfflineValueLoss(value), lambda: near_batch, lr=0.05, beside=both)
    run = Silent()
    learner.train(600, "Value", run)
    middle = (-5.0 + 3.0 * -60.0) / 4.0
    assert value(TensorDict({"latent": z[:1]}, [1]))["state_value"].item() == pytest.approx(middle, abs=0.5)
    assert "beside" in run.rows[-1][2]


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
    rows = training.value.beside.sample()
    assert (rows["tag"] == int(Tag.CONSTRAINT)).all()
    assert (rows["reward_to_go"] == -42.0).all()
    assert training.value.beside.weight == 0.5
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
    rows = training.value.beside.sample()
    assert rows.batch_size == (4, agent.value.num_members)
    assert rows["next", "constraint"].all()
    assert torch.equal(rows["latent"], rows["next", "latent"])
    torch.testing.assert_close(rows["reward_to_go"], torch.full_like(rows["reward_to_go"], -(1 + 0.99 + 0.99**2)))


def test_batches_seem_drawn_from_the_enlarged_dataset(config):
    agent = make_agent(config)
    buffer = TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim)
    buffer.add(noisy_episode(), "success")
    pixels = torch.randint(256, (400, 3, 64, 64), dtype=torch.uint8)
    assert torch.equal(enlarge(pixels, buffer, None), pixels)
    same = (enlarge(pixels, buffer, 4 * len(buffer.pixels)) == pixels).flatten(1).all(1).float().mean()
    assert abs(same - 0.25) < 0.08
    assert torch.equal(enlarge(pixels, buffer, len(buffer.pixels)), pixels)


def test_mean_latents_feed_posterior_means_to_the_models_that_are_named(config):
    OmegaConf.update(config, "loss.mean_latents", ["dynamics", "goal"])
    agent = make_agent(config)
    training = Training(agent, TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim), config, Silent())
    assert training.dynamics.loss.tensor_keys.latent == "loc"
    assert training.dynamics.loss.tensor_keys.next_latent == ("next", "loc")
    assert training.goal.loss.tensor_keys.latent == ("next", "loc")
    assert training.constraint.loss.tensor_keys.latent == ("next", "latent")
    assert training.safe_set.loss.tensor_keys.latent == "latent"


def noisy_episode() -> TensorDict:
    """Seven steps of random images and actions."""
    pixels = torch.randint(256, (8, 3, 64, 64), dtype=torch.uint8)
    step = {"reward": -torch.ones(7, 1), "pixels": pixels[1:]}
    step |= {k: torch.zeros(7, 1, dtype=torch.bool) for k in ("constraint", "success")}
    return TensorDict({"pixels": pixels[:-1], "action": torch.randn(7, 2), "next": step}, [7])


def test_unit_scale_measures_latents_in_their_spread_and_keeps_the_pictures(config):
    torch.manual_seed(0)
    episode = noisy_episode()
    pictures, spreads = [], []
    for unit_scale in (False, True):
        OmegaConf.update(config, "vae", {"steps": 3, "batch_size": 4, "crop_scale": None, "unit_scale": unit_scale})
        torch.manual_seed(1)
        agent = make_agent(config)
        buffer = TaggedReplayBuffer(20, latent_dim=config.agent.latent_dim)
        buffer.add(episode, "success")
        train_vae(agent, buffer, config, Silent())
        spreads.append(buffer.latents.storage[:]["loc"].std(0).square().mean().sqrt().item())
        pictures.append(agent.decoder(agent.encoder(episode.select("pixels")))["reco_pixels"])
    assert spreads[1] == pytest.approx(1.0, rel=1e-3)
    assert spreads[0] != pytest.approx(1.0, rel=1e-2)
    torch.testing.assert_close(*pictures)


def test_the_prediction_term_trains_the_dynamics_beside_the_vae_by_its_weight(config):
    torch.manual_seed(0)
    episode = noisy_episode()
    heads = []
    for weight in (0.0, 1.0, 1.0, 2.0):
        torch.manual_seed(1)
        OmegaConf.update(config, "vae", {"steps": 20, "lr": 1e-3, "prediction_weight": weight})
        agent = make_agent(config)
        before = [p.detach().clone() for p in agent.dynamics.parameters()]
        buffer = TaggedReplayBuffer(20, latent_dim=config.agent.latent_dim)
        buffer.add(episode, "success")
        run = Silent()
        train_vae(agent, buffer, config, run)
        changed = [not torch.equal(a, b) for a, b in zip(before, agent.dynamics.parameters(), strict=True)]
        assert any(changed) == (weight > 0.0)
        assert ("prediction" in run.rows[-1][2]) == (weight > 0.0)
        heads.append(agent.encoder[0].module.head.weight.detach())
    # The encoder learns from it too, and the weight makes a difference where nothing else does.
    assert not torch.equal(heads[0], heads[1])
    assert torch.equal(heads[1], heads[2])
    assert not torch.equal(heads[2], heads[3])


@pytest.mark.parametrize(
    ("warmup", "shares"),
    [(None, [1.0, 1.0, 1.0, 1.0]), ([0.0, 0.75], [1 / 3, 2 / 3, 1.0, 1.0]), ([0.25, 0.75], [0.0, 0.5, 1.0, 1.0])],
)
def test_beta_rises_over_its_share_of_the_steps(config, monkeypatch, warmup, shares):
    OmegaConf.update(config, "vae", {"steps": 4, "batch_size": 2, "beta": 0.3, "warmup": warmup})
    agent = make_agent(config)
    buffer = TaggedReplayBuffer(20, latent_dim=config.agent.latent_dim)
    step = {"reward": -torch.ones(3, 1), "pixels": torch.zeros(3, 3, 64, 64, dtype=torch.uint8)}
    step |= {k: torch.zeros(3, 1, dtype=torch.bool) for k in ("constraint", "success")}
    buffer.add(TensorDict({"pixels": step["pixels"], "action": torch.zeros(3, 2), "next": step}, [3]), "success")
    seen, forward = [], VAELoss.forward
    monkeypatch.setattr(VAELoss, "forward", lambda self, td: (seen.append(self.beta), forward(self, td))[1])
    train_vae(agent, buffer, config, Silent())
    assert seen == pytest.approx([0.3 * share for share in shares])


@pytest.mark.parametrize(("error", "warned"), [(0.9, True), (0.3, False)])
def test_a_vae_that_draws_the_mean_image_is_noticed(config, capsys, error, warned):
    agent = make_agent(config)
    buffer = TaggedReplayBuffer(20, latent_dim=config.agent.latent_dim)
    pixels = (torch.arange(20) % 2 * 255).to(torch.uint8)[:, None, None, None].expand(-1, 3, 64, 64).contiguous()
    step = {"reward": -torch.ones(19, 1), "pixels": pixels[1:]}
    step |= {k: torch.zeros(19, 1, dtype=torch.bool) for k in ("constraint", "success")}
    buffer.add(TensorDict({"pixels": pixels[:-1], "action": torch.zeros(19, 2), "next": step}, [19]), "success")
    # Black and white images in turn: their variance about the mean image is a quarter.
    Training(agent, buffer, config, Silent())._warn_of_collapse(0.25 * error)
    assert ("hardly sees" in capsys.readouterr().out) == warned


@pytest.mark.parametrize("name", ["dynamics", "value", "safe_set"])
def test_losses_and_gradients_under_bf16_agree_with_fp32(name):
    torch.manual_seed(0)
    agent = LS3Agent(action_dim=2, latent_dim=8)
    rows = TensorDict(
        {
            "latent": torch.randn(256, 5, 8),
            "action": torch.randn(256, 5, 2),
            "reward_to_go": -60.0 - 5.0 * torch.rand(256, 5, 1),
            "in_success": torch.rand(256, 5, 1) < 0.5,
            "next": {"latent": torch.randn(256, 5, 8)},
        },
        [256, 5],
    )
    losses = {
        "dynamics": (EnsembleDynamicsLoss(agent.dynamics, bootstrap=True), rows),
        "value": (OfflineValueLoss(agent.value, bootstrap=True), rows),
        "safe_set": (SafeSetLoss(agent.safe_set, gamma=0.3), rows[:, 0]),
    }
    loss, batch = losses[name]
    if name == "safe_set":
        HardUpdate(loss, value_network_update_interval=99)
    found = []
    for bf16 in (False, True):
        learner = Learner(name, loss, lambda: batch, lr=1e-3, bf16=bf16)
        learner.optimizer.zero_grad()
        _, value = learner.evaluate()
        value.backward()
        assert all(p.grad.dtype == torch.float32 for p in learner.parameters)
        found.append((value.detach(), torch.cat([p.grad.flatten() for p in learner.parameters])))
    (exact, gradient), (rough, rounded) = found
    torch.testing.assert_close(rough, exact, rtol=5e-3, atol=0.0)
    assert not torch.equal(rounded, gradient)
    assert (rounded - gradient).norm() < 0.05 * gradient.norm()  # bf16 rounds by 0.4 % at every product


def test_the_learning_rate_falls_to_nothing_in_the_last_part_of_every_phase():
    assert [cooled_down(share, 0.5) for share in (0.0, 0.25, 0.5, 0.75, 0.9)] == pytest.approx([1, 1, 1, 0.5, 0.2])
    assert cooled_down(0.99, 0.0) == 1.0
    value = ValueEnsemble(4, num_members=2, hidden=(8,))
    rows = TensorDict({"latent": torch.randn(8, 4), "reward_to_go": torch.zeros(8, 1)}, [8])
    rates = []

    def sample():
        rates.append(learner.optimizer.param_groups[0]["lr"])
        return rows

    learner = Learner("value", OfflineValueLoss(value), sample, lr=0.4, cooldown=0.5)
    for _ in range(2):  # every phase starts warm again
        learner.train(4, "Value", Silent())
    assert rates == pytest.approx([0.4, 0.4, 0.4, 0.2] * 2)
