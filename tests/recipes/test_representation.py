"""The VAE phase: what encoder and decoder learn from, and what is said when they learn nothing."""

import pytest
import torch
from helpers import Silent, make_agent, noisy_episode
from omegaconf import OmegaConf
from tensordict import TensorDict

from ls3_torchrl.data import TaggedReplayBuffer
from ls3_torchrl.objectives import VAELoss
from representation import enlarge, train_vae, warn_of_collapse


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


def test_batches_seem_drawn_from_the_enlarged_dataset(config):
    buffer = TaggedReplayBuffer(100, latent_dim=config.agent.latent_dim)
    buffer.add(noisy_episode(), "success")
    pixels = torch.randint(256, (400, 3, 64, 64), dtype=torch.uint8)
    assert torch.equal(enlarge(pixels, buffer, None), pixels)
    same = (enlarge(pixels, buffer, 4 * len(buffer.frames)) == pixels).flatten(1).all(1).float().mean()
    assert abs(same - 0.25) < 0.08
    assert torch.equal(enlarge(pixels, buffer, len(buffer.frames)), pixels)


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
        spreads.append(buffer.transitions.storage[:]["loc"].std(0).square().mean().sqrt().item())
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
    buffer = TaggedReplayBuffer(20, latent_dim=config.agent.latent_dim)
    pixels = (torch.arange(20) % 2 * 255).to(torch.uint8)[:, None, None, None].expand(-1, 3, 64, 64).contiguous()
    step = {"reward": -torch.ones(19, 1), "pixels": pixels[1:]}
    step |= {k: torch.zeros(19, 1, dtype=torch.bool) for k in ("constraint", "success")}
    buffer.add(TensorDict({"pixels": pixels[:-1], "action": torch.zeros(19, 2), "next": step}, [19]), "success")
    # Black and white images in turn: their variance about the mean image is a quarter.
    warn_of_collapse(0.25 * error, buffer)
    assert ("hardly sees" in capsys.readouterr().out) == warned


def test_a_vae_can_be_taken_from_a_trained_agent_of_the_same_shape(config, tmp_path):
    trained, agent = make_agent(config), make_agent(config)
    path = trained.save(tmp_path / "agent.pt")
    OmegaConf.update(config, "vae.agent", str(path))
    buffer = TaggedReplayBuffer(20, latent_dim=config.agent.latent_dim)
    episode = noisy_episode()
    buffer.add(episode, "success")
    run = Silent()
    dynamics = [p.clone() for p in agent.dynamics.parameters()]
    train_vae(agent, buffer, config, run)
    assert run.rows == []  # nothing was trained
    assert not any(p.requires_grad for p in agent.encoder.parameters())
    assert all(torch.equal(a, b) for a, b in zip(dynamics, agent.dynamics.parameters(), strict=True))
    seen = trained.encoder(episode.select("pixels"))
    torch.testing.assert_close(buffer.transitions.storage[:]["loc"], seen["loc"], atol=1e-4, rtol=1e-4)
    OmegaConf.update(config, "agent.latent_dim", 5)
    with pytest.raises(ValueError, match="latent_dim 8 instead of 5"):
        train_vae(make_agent(config), buffer, config, run)
