"""Numbers that are not finite, in every phase: training stops at that step, names it, and good weights stay."""

import json
import warnings

import pytest
import torch
from tensordict import TensorDict
from tiny_runs import LS3, TINY

from ls3_recipes.algorithms import ls3
from ls3_recipes.commands.train import main
from ls3_recipes.configuration import train_settings
from ls3_recipes.experiment import Experiment
from ls3_recipes.protocol import run_experiment
from ls3_torchrl.trainers import DivergenceError, Learner

# TorchRL warns about classes of its own while its collectors are imported.
pytestmark = pytest.mark.filterwarnings("ignore:Creating .* which inherits from WeightUpdaterBase:DeprecationWarning")

MANY = [f"offline.{name}_steps=50" for name in ("dynamics", "classifier")]
NO_VALUES = ["offline.value_steps=0"]
#: What is so large that a phase diverges, and the phases that do.
RATES = {
    "VAE": ["vae.lr=1e6", "vae.steps=50"],
    "Dynamics": ["optim.dynamics_lr=1e6", *MANY],
    "Value, reward-to-go": ["optim.lr=1e6", "offline.value_steps=50"],
    "Value, TD-1": ["optim.lr=1e6", *NO_VALUES, "offline.classifier_steps=0", "online.value_td_steps=50"],
    "Safe set": ["optim.lr=1e30", *NO_VALUES, *MANY],
    "Critic": ["algorithm=sacfd", "policy.lr=1e6", "policy.cloning_steps=0", "policy.critic_steps=50"],
    "Actor and critic": ["algorithm=awac", "policy.lr=1e6", "policy.cloning_steps=0", "policy.critic_steps=50"],
}
#: Of training on the offline data, and of an update.
OFFLINE = ["Dynamics", "Value, reward-to-go", "Safe set", "Constraint", "Goal"]
UPDATE = ["Dynamics", "Value, TD-1", "Safe set", "Constraint", "Goal"]


@pytest.fixture(autouse=True)
def no_probe(monkeypatch):
    """Leaves out what takes most of a tiny run's time and changes nothing that is learnt."""
    monkeypatch.setattr(ls3, "probe", lambda *_: {})


def finite(state):
    tensors = [value for value in state.values() if isinstance(value, torch.Tensor) and value.is_floating_point()]
    inner = [finite(value) for value in state.values() if isinstance(value, dict)]
    return all(torch.isfinite(tensor).all() for tensor in tensors) and all(inner)


def diverged(folder, *overrides):
    """Run until it diverges; the error."""
    base = TINY if any("algorithm" in override for override in overrides) else LS3
    with pytest.raises(DivergenceError) as raised:
        run_experiment(train_settings(*base, *overrides, f"output={folder}"))
    return raised.value


@pytest.mark.parametrize("phase", RATES)
def test_a_rate_that_is_far_too_large_stops_its_phase_at_the_step(tmp_path, phase):
    error = diverged(tmp_path / "run", *RATES[phase])
    assert error.phase == phase
    assert 1 <= error.step < 50
    assert f"{phase} diverged: " in str(error)
    assert f"at step {error.step}" in str(error)
    kept = tmp_path / "run" / "diverged"
    assert json.loads((kept / "error.json").read_text())["step"] == error.step
    assert str(kept) in error.__notes__[0]
    state = torch.load(kept / "state.pt", weights_only=True)
    assert finite(state["state"])  # the bad step was not taken
    assert set(state["batch"]) & {"latent", "vae_target", "action"}


@pytest.fixture
def poison(monkeypatch):
    """A function that makes what a phase learns from NaN from a step on, in the n-th of its trainings."""

    def spoil(phase, step, training=0):
        begin, seen = Learner.begin, []

        def poisoned(self, steps, name, seed):
            if name == phase:
                seen.append(name)
            if name == phase and len(seen) > training:
                draw, first = self.new_batch, self.steps

                def sample():
                    rows = draw()
                    if self.steps - first >= step:
                        for key in rows.keys(include_nested=True, leaves_only=True):
                            if "latent" in key:
                                rows[key].fill_(torch.nan)
                    return rows

                self.new_batch = sample
            begin(self, steps, name, seed)

        monkeypatch.setattr(Learner, "begin", poisoned)

    return spoil


@pytest.mark.parametrize("phase", OFFLINE)
def test_nan_in_a_batch_stops_the_phase_at_the_step(poison, tmp_path, phase):
    poison(phase, 3)
    error = diverged(tmp_path / "run", "online.updates=0")
    assert (error.phase, error.step) == (phase, 3)
    state = torch.load(tmp_path / "run" / "diverged" / "state.pt", weights_only=True)
    assert finite(state["state"])
    batch = TensorDict(state["batch"])
    assert torch.isnan(batch["latent" if "latent" in batch else ("next", "latent")]).all()


@pytest.mark.parametrize("phase", UPDATE)
def test_so_does_nan_in_an_update_and_the_run_goes_on_when_the_cause_is_gone(poison, tmp_path, phase, monkeypatch):
    before = 0 if phase == "Value, TD-1" else 5
    poison(phase, 1, training=int(before > 0))
    error = diverged(tmp_path / "run")
    assert (error.phase, error.step) == (phase, before + 1)
    assert (tmp_path / "run" / "checkpoints" / "agent_000.pt").is_file()
    assert not (tmp_path / "run" / "checkpoints" / "agent_001.pt").exists()
    monkeypatch.undo()
    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    summary = run_experiment(train_settings(*LS3, f"output={tmp_path / 'run'}"))
    assert summary["online"]["episodes"] == 4


def test_on_the_command_line_it_is_one_line(tmp_path):
    with pytest.raises(SystemExit) as stopped, warnings.catch_warnings():
        main([*LS3, *RATES["VAE"], f"output={tmp_path / 'run'}"])
    line = str(stopped.value)
    assert line.startswith("ls3 train: VAE diverged: {")
    assert f"state of that moment are in {tmp_path / 'run' / 'diverged'}." in line
    assert "\n" not in line


def test_nan_in_rewards_that_the_environment_gives_is_refused_before_anything_is_learnt_from_them(
    monkeypatch, tmp_path
):
    keep = Experiment._keep_episodes

    def spoiled(self, update, episodes):
        if update == 2:
            episodes["next", "reward"][0, 3] = torch.nan
        keep(self, update, episodes)

    monkeypatch.setattr(Experiment, "_keep_episodes", spoiled)
    with pytest.raises(ValueError, match=r"reward.*is not finite") as raised:
        run_experiment(train_settings(*LS3, f"output={tmp_path / 'run'}"))
    assert f"resume={tmp_path / 'run'}" in raised.value.__notes__[0]
    assert (tmp_path / "run" / "checkpoints" / "agent_001.pt").is_file()
    monkeypatch.undo()
    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    run_experiment(train_settings(*LS3, f"output={tmp_path / 'run'}"))
    assert (tmp_path / "run" / "summary.json").is_file()
