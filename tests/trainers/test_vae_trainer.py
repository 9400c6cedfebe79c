"""The VAE's training: what encoder and decoder learn from, what is said when they learn nothing, how it continues."""

import copy
import threading

import pytest
import torch
from tensordict.nn import TensorDictModule

from ls3_torchrl import LS3Agent
from ls3_torchrl.data import EpisodeKeys, TaggedReplayBuffer
from ls3_torchrl.halves import Halves
from ls3_torchrl.objectives import VAELoss
from ls3_torchrl.trainers import DivergenceError, VAEOptions, VAETrainer
from ls3_torchrl.trainers.vae_gradient import TARGET

FAST = {"steps": 3, "batch_size": 4, "autocast": False}


@pytest.fixture
def filled(episode):
    """Makes a buffer that holds one episode of noise, or the episode given."""

    def make(content=None, **options):
        buffer = TaggedReplayBuffer(100, latent_dim=8, **options)
        buffer.add(episode(7) if content is None else content, "success")
        return buffer

    return make


@pytest.mark.parametrize("background", [True, False])
def test_a_decoder_with_a_background_starts_from_the_mean_image(make_agent, filled, episode, recorder, background):
    buffer = filled(episode(grey=51))
    VAETrainer(make_agent(background=background), buffer, VAEOptions(**FAST), logger=recorder, progress=False).train()
    first = recorder.values("VAE/reconstruction")[0]
    assert (first < 0.01) == background  # black is 0.2² = 0.04 away


def test_batches_seem_drawn_from_the_enlarged_dataset(make_agent, filled):
    buffer = filled()
    pixels = torch.randint(256, (400, 3, 64, 64), dtype=torch.uint8)

    def kept(goal):
        trainer = VAETrainer(make_agent(), buffer, VAEOptions(**FAST, enlarge_to=goal), progress=False)
        return (trainer._enlarge(pixels) == pixels).flatten(1).all(1).float().mean().item()

    assert kept(None) == 1.0
    assert kept(len(buffer.frames)) == 1.0
    assert abs(kept(4 * len(buffer.frames)) - 0.25) < 0.08


def test_predictable_latents_are_measured_in_their_spread_which_keeps_the_pictures(
    make_agent, filled, episode, monkeypatch
):
    content = episode(7)
    pictures, spreads = [], []
    rescale = VAETrainer._rescale
    for measured in (False, True):
        torch.manual_seed(1)
        agent, buffer = make_agent(), filled(content)
        monkeypatch.setattr(VAETrainer, "_rescale", rescale if measured else lambda self: None)
        VAETrainer(agent, buffer, VAEOptions(**FAST, prediction_weight=1.0), progress=False).train()
        spreads.append(buffer.transitions.storage[:]["loc"].std(0).square().mean().sqrt().item())
        pictures.append(agent.decoder(agent.encoder(content.select("pixels")))["reco_pixels"])
    assert spreads[1] == pytest.approx(1.0, rel=1e-3)
    assert spreads[0] != pytest.approx(1.0, rel=1e-2)
    torch.testing.assert_close(*pictures)


def test_the_prediction_term_trains_the_dynamics_along_by_its_weight(make_agent, filled, episode, recorder):
    content = episode(7, actions=torch.randn(7, 2))
    heads = []
    for weight in (0.0, 1.0, 1.0, 2.0):
        torch.manual_seed(1)
        recorder.rows.clear()
        agent, buffer = make_agent(), filled(content)
        before = [p.detach().clone() for p in agent.dynamics.parameters()]
        options = VAEOptions(**(FAST | {"steps": 20, "lr": 1e-3}), prediction_weight=weight)
        VAETrainer(agent, buffer, options, logger=recorder, progress=False).train()
        changed = [not torch.equal(a, b) for a, b in zip(before, agent.dynamics.parameters(), strict=True)]
        assert any(changed) == (weight > 0.0)
        assert bool(recorder.values("VAE/prediction")) == (weight > 0.0)
        heads.append(agent.encoder[0].module.head.weight.detach())
    # The encoder learns from it too, and the weight makes a difference where nothing else does.
    assert not torch.equal(heads[0], heads[1])
    assert torch.equal(heads[1], heads[2])
    assert not torch.equal(heads[2], heads[3])


def test_prediction_leaves_out_what_follows_a_violation(make_agent, filled, episode):
    number = torch.arange(9.0).unsqueeze(-1).expand(-1, 2)
    buffer = filled(episode(actions=number, constraint=3))
    drawn, draw = [], buffer.sample_frame_transitions
    buffer.sample_frame_transitions = lambda *a, **o: drawn.append(draw(*a, **o)) or drawn[-1]
    options = VAEOptions(**(FAST | {"batch_size": 64}), prediction_weight=1.0)
    VAETrainer(make_agent(), buffer, options, progress=False).train()
    steps = {int(step) for batch in drawn for step in batch["action"].flatten().tolist()}
    assert max(steps) == 3  # the step to the violation itself is not left out


@pytest.mark.parametrize("predicts", [False, True])
def test_every_frame_is_reconstructed_as_often_as_any_other(make_agent, filled, episode, predicts):
    buffer = filled(episode(constraint=3))
    options = VAEOptions(**(FAST | {"batch_size": 500}), prediction_weight=1.0)
    trainer = VAETrainer(make_agent(), buffer, options, progress=False)
    drawn = torch.cat([trainer._sample(predicts=predicts)[TARGET] for _ in range(6)])
    # The image that violates, and what comes after it: it never comes before an action that the dynamics learn from.
    for frame in buffer.frames.storage[:]["pixels"]:
        share = (drawn == frame).flatten(1).all(1).float().mean().item()
        assert abs(share - 0.1) < 0.03


@pytest.mark.parametrize(
    ("warmup", "fractions"),
    [(None, [1.0, 1.0, 1.0, 1.0]), ([0.0, 0.75], [1 / 3, 2 / 3, 1.0, 1.0]), ([0.25, 0.75], [0.0, 0.5, 1.0, 1.0])],
)
def test_beta_rises_over_its_fraction_of_the_steps(make_agent, filled, warmup, fractions):
    seen = []
    options = VAEOptions(**(FAST | {"steps": 4}), beta=0.3, warmup=warmup)
    trainer = VAETrainer(
        make_agent(), filled(), options, progress=False, after_step=lambda: seen.append(trainer.loss.beta)
    )
    trainer._minimise()
    assert seen == pytest.approx([0.3 * fraction for fraction in fractions])


@pytest.mark.parametrize(("error", "warned"), [(0.9, True), (0.3, False)])
def test_a_vae_that_draws_the_mean_image_is_noticed(make_agent, filled, episode, caplog, error, warned):
    # Black and white images in turn: their variance about the mean image is a quarter.
    content = episode(19, grey=0)
    content["pixels"][1::2], content["next", "pixels"][::2] = 255, 255
    trainer = VAETrainer(make_agent(), filled(content), VAEOptions(**FAST), progress=False)
    trainer._warn_of_collapse(0.25 * error)
    assert ("little more than the mean image" in caplog.text) == warned


def test_a_vae_can_be_taken_from_a_trained_agent_of_the_same_shape(make_agent, filled, episode, recorder, tmp_path):
    trained, agent, content = make_agent(), make_agent(), episode(7)
    options = VAEOptions(checkpoint=str(trained.save(tmp_path / "agent.pt")))
    buffer = filled(content)
    dynamics = [p.clone() for p in agent.dynamics.parameters()]
    VAETrainer(agent, buffer, options, logger=recorder, progress=False).train()
    assert recorder.rows == []  # nothing was trained
    assert not any(p.requires_grad for p in agent.encoder.parameters())
    assert all(torch.equal(a, b) for a, b in zip(dynamics, agent.dynamics.parameters(), strict=True))
    seen = trained.encoder(content.select("pixels"))
    torch.testing.assert_close(buffer.transitions.storage[:]["loc"], seen["loc"], atol=1e-4, rtol=1e-4)
    with pytest.raises(ValueError, match="latent_dim 8 instead of 5"):
        VAETrainer(make_agent(latent_dim=5), buffer, options, progress=False).train()


def test_training_that_continues_from_its_state_ends_as_one_that_was_never_stopped(make_agent, filled, episode):
    content = episode(7, actions=torch.randn(7, 2))
    settings = {"batch_size": 4, "autocast": False, "schedule": "onecycle", "prediction_weight": 1.0, "lr": 1e-3}

    def trainer(seed):
        torch.manual_seed(seed)
        return VAETrainer(make_agent(), filled(content), VAEOptions(steps=6, **settings), progress=False)

    whole, first, second = trainer(0), trainer(0), trainer(1)
    for one, steps in ((whole, 6), (first, 4)):
        torch.manual_seed(3)
        with Halves() as both:
            for _ in range(steps):
                one._step(both)
                one.steps += 1
    second.load_state_dict(first.state_dict())
    second._minimise()
    assert second.steps == 6
    for half in ("encoder", "decoder", "dynamics"):
        pairs = zip(getattr(whole.agent, half).parameters(), getattr(second.agent, half).parameters(), strict=True)
        assert all(torch.equal(a, b) for a, b in pairs), half


@pytest.mark.parametrize("stop", [1, 4, 6])
def test_training_that_was_stopped_at_a_step_ends_as_one_that_was_not(make_agent, filled, episode, recorder, stop):
    content = episode(7)
    options = VAEOptions(**FAST | {"steps": 6}, prediction_weight=1.0, schedule="onecycle")

    def trainer(seed, **more):
        torch.manual_seed(seed)
        return VAETrainer(make_agent(), filled(content), options, progress=False, **more)

    whole, kept = trainer(0, logger=recorder), {}

    def keep():
        if first.steps == stop:
            kept.update(state=first.state_dict(), draws=torch.get_rng_state())
            raise KeyboardInterrupt

    torch.manual_seed(3)
    whole.train()
    first = trainer(0, after_step=keep)
    torch.manual_seed(3)
    with pytest.raises(KeyboardInterrupt):
        first.train()
    second = trainer(1, logger=type(recorder)())
    second.load_state_dict(kept["state"])
    torch.set_rng_state(kept["draws"])
    second.train()
    assert second.logger.rows == [row for row in recorder.rows if row[2] >= stop]
    for half in ("encoder", "decoder"):
        pairs = zip(getattr(whole.agent, half).parameters(), getattr(second.agent, half).parameters(), strict=True)
        assert all(torch.equal(a, b) for a, b in pairs), half
    assert torch.equal(second.buffer.transitions.storage[:]["loc"], whole.buffer.transitions.storage[:]["loc"])


def test_the_optimisers_state_has_the_shapes_of_the_weights_and_continues_from_any_order_of_memory(make_agent, filled):
    trainer = VAETrainer(make_agent(), filled(), VAEOptions(**FAST), progress=False)
    trainer.train()
    state = trainer.state_dict()
    averages = [state["optimizer"]["state"][i] for i in range(len(trainer._learnt))]
    assert all(of["exp_avg"].shape == p.shape for of, p in zip(averages, trainer._learnt, strict=True))
    kept = [of["exp_avg"].clone() for of in averages]
    for of in averages:
        of["exp_avg"] = of["exp_avg"].contiguous()
    trainer.load_state_dict(state)
    again = trainer.state_dict()["optimizer"]["state"]
    assert all(torch.equal(again[i]["exp_avg"], average) for i, average in enumerate(kept))
    assert all(of["exp_avg"].is_contiguous() for of in trainer.optimizer.state.values())


def test_after_a_step_that_raises_no_thread_is_left(make_agent, filled):
    def stop():
        assert torch.get_num_threads() == 1
        raise KeyboardInterrupt

    before, began = torch.get_num_threads(), threading.active_count()
    torch.set_num_threads(2)
    try:
        trainer = VAETrainer(make_agent(), filled(), VAEOptions(**FAST), progress=False, after_step=stop)
        with pytest.raises(KeyboardInterrupt):
            trainer.train()
        assert (torch.get_num_threads(), threading.active_count()) == (2, began)
    finally:
        torch.set_num_threads(before)


def test_training_again_once_it_has_ended_changes_nothing(make_agent, filled, episode):
    content = episode(7)

    def trainer(seed):
        torch.manual_seed(seed)
        return VAETrainer(make_agent(), filled(content), VAEOptions(**FAST, prediction_weight=1.0), progress=False)

    first, second = trainer(0), trainer(1)
    first.train()
    weights = [p.clone() for p in first.agent.encoder.parameters()]
    first.train()
    second.load_state_dict(first.state_dict())
    second.train()
    for agent in (first.agent, second.agent):
        assert all(torch.equal(a, b) for a, b in zip(weights, agent.encoder.parameters(), strict=True))
    assert torch.equal(second.buffer.transitions.storage[:]["loc"], first.buffer.transitions.storage[:]["loc"])


class Brush(torch.nn.Module):
    """A decoder of one's own."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(8, 3 * 64 * 64)

    def forward(self, latent):
        return self.layer(latent).unflatten(-1, (3, 64, 64))


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_a_decoder_of_ones_own_is_trained_too(make_agent, filled, weight):
    decoder = TensorDictModule(Brush(), ["latent"], ["reco_pixels"])
    agent = make_agent(decoder=decoder)
    before = decoder.module.layer.weight.detach().clone()
    options = VAEOptions(**FAST, prediction_weight=weight)
    VAETrainer(agent, filled(), options, progress=False).train()  # latents keep their scale: a brush has no rescale()
    assert not torch.equal(before, decoder.module.layer.weight)


def test_images_under_a_key_of_ones_own(make_agent, episode, recorder):
    content = episode(7)
    content.rename_key_("pixels", ("camera", "image"))
    content.rename_key_(("next", "pixels"), ("next", "camera", "image"))
    buffer = TaggedReplayBuffer(50, latent_dim=8, keys=EpisodeKeys(observation=("camera", "image")))
    buffer.add(content, "success")
    from ls3_torchrl.modules import PixelDecoder, PixelEncoder

    agent = make_agent(encoder=PixelEncoder(3, 8, pixels_key=("camera", "image")), decoder=PixelDecoder(3, 8))
    options = VAEOptions(**FAST, prediction_weight=0.5)
    VAETrainer(agent, buffer, options, logger=recorder, progress=False).train()
    assert recorder.values("VAE/prediction")
    assert buffer.sample(4)["latent"].shape == (4, 8)


def test_an_encoder_without_a_decoder_needs_no_training():
    encoder = TensorDictModule(torch.nn.Identity(), ["pixels"], ["latent"])
    agent = LS3Agent(action_dim=2, latent_dim=4, encoder=encoder)
    with pytest.raises(ValueError, match=r"buffer\.encode\(agent\.encoder\)"):
        VAETrainer(agent, TaggedReplayBuffer(10, latent_dim=4))


def test_a_loss_that_is_not_finite_stops_the_training(make_agent, filled, monkeypatch):
    found = VAELoss.of_posterior

    def not_finite(self, loc, scale, target, *, noise):
        values = found(self, loc, scale, target, noise=noise)
        return values | {"loss_vae": values["loss_vae"] * torch.nan}

    monkeypatch.setattr(VAELoss, "of_posterior", not_finite)
    trainer = VAETrainer(make_agent(), filled(), VAEOptions(**FAST), progress=False)
    before = {key: value.clone() for key, value in trainer.agent.state_dict().items()}
    with pytest.raises(FloatingPointError, match=r"VAE diverged: .*'loss_vae': nan") as raised:
        trainer.train()
    assert raised.value.batch[TARGET].shape == (4, 3, 64, 64)
    assert all(torch.equal(value, before[key]) for key, value in trainer.agent.state_dict().items())


def test_it_can_be_taken_back_to_an_earlier_state(make_agent, filled):
    states = []
    buffer = filled()
    trainer = VAETrainer(
        make_agent(),
        buffer,
        VAEOptions(**FAST),
        progress=False,
        after_step=lambda: states.append((copy.deepcopy(trainer.state_dict()), torch.get_rng_state())),
    )
    trainer.train()
    ended = {key: value.clone() for key, value in trainer.agent.state_dict().items()}
    state, random = states[0]
    trainer.load_state_dict(state)
    torch.set_rng_state(random)
    trainer.train()
    assert all(torch.equal(value, ended[key]) for key, value in trainer.agent.state_dict().items())


def test_a_vae_that_explodes_in_its_last_step_is_blamed_itself(make_agent, filled):
    buffer = filled()
    with pytest.raises(DivergenceError, match=r"^VAE diverged: not finite at step 1\. Lower") as raised:
        VAETrainer(make_agent(), buffer, VAEOptions(**{**FAST, "steps": 1, "lr": 1e30}), progress=False).train()
    assert raised.value.phase == "VAE"
    assert not buffer.transitions.storage[:]["loc"].any()  # nothing was stored


def test_latents_without_a_spread_are_not_divided_by_it(make_agent, filled, episode):
    buffer = filled(episode(grey=51))
    trainer = VAETrainer(make_agent(), buffer, VAEOptions(**FAST, prediction_weight=1.0), progress=False)
    for _ in range(2):
        with pytest.raises(ValueError, match="All latents are alike"):
            trainer.train()
    assert not trainer.finished


def test_weights_that_got_another_order_of_memory_are_the_ones_that_learn(make_agent, filled):
    agent = make_agent()
    trainer = VAETrainer(agent, filled(), VAEOptions(**FAST), progress=False)
    agent.to(memory_format=torch.contiguous_format)
    before = [weight.detach().clone() for weight in agent.encoder.parameters()]
    trainer.train()
    assert all(not torch.equal(new, old) for new, old in zip(agent.encoder.parameters(), before, strict=True))


def test_what_is_frozen_stays_and_hooks_are_called(make_agent, filled):
    agent, seen = make_agent(), []
    frozen = next(agent.encoder.parameters()).requires_grad_(False)
    before = frozen.clone()
    agent.encoder.register_forward_hook(lambda *_: seen.append(1))
    trainer = VAETrainer(agent, filled(), VAEOptions(**FAST), progress=False)
    trainer._minimise()
    assert torch.equal(frozen, before)
    assert len(seen) == 3


def test_a_compact_file_has_no_decoder_to_take(tmp_path):
    buffer, agent = TaggedReplayBuffer(20, latent_dim=4), LS3Agent(2, latent_dim=4)
    small = agent.save(tmp_path / "small.pt", compact=True)
    options = VAEOptions(checkpoint=str(small))
    with pytest.raises(ValueError, match="is a compact file, whose agent has no decoder"):
        VAETrainer(agent, buffer, options, progress=False).train()
