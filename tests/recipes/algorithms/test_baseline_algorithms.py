"""The baselines under the protocol: what each learns from, that it runs, and that it is healthy on its own."""

import json
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type

import ls3_envs
from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.algorithms.awac import AWAC
from ls3_recipes.algorithms.sacfd import SACfD
from ls3_recipes.commands.evaluate import EvaluateSettings, evaluate
from ls3_recipes.commands.report import ReportSettings, report
from ls3_recipes.configuration import compose_settings, train_settings
from ls3_recipes.protocol import run_experiment
from ls3_torchrl import LS3Agent
from ls3_torchrl.data import Tag, TaggedReplayBuffer

# TorchRL warns about classes of its own while its collectors are imported.
pytestmark = pytest.mark.filterwarnings("ignore:Creating .* which inherits from WeightUpdaterBase:DeprecationWarning")

BASELINES = {
    "bc": ["algorithm=bc"],
    "sacfd": ["algorithm=sacfd"],
    "sacfd_rrl": ["algorithm=sacfd", "recovery=true"],
    "awac": ["algorithm=awac"],
}


def configure(name, *overrides):
    return train_settings("preset=smoke", "device=cpu", *BASELINES[name], *overrides)


# --- everything once ------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("task", ls3_envs.DOMAINS)
@pytest.mark.parametrize("algorithm", BASELINES)
def test_every_baseline_runs_on_every_task(tmp_path, algorithm, task):
    folder = tmp_path / "run"
    small = [f"task={task}", "vae.steps=2", "online.updates=1", "task.horizon=6", "task.offline_episodes=2"]
    config = configure(algorithm, *small, f"pictures={task == 'navigation'}", f"output={folder}")
    summary = run_experiment(config)
    assert summary == json.loads((folder / "summary.json").read_text())
    assert (summary["algorithm"], summary["task"]) == (algorithm, task)
    assert summary["online"]["episodes"] == 2
    assert all(math.isfinite(value) for value in summary["evaluation"].values())
    if task == "navigation":
        drawn = {path.name for path in folder.glob("*.png")} | {path.name for path in folder.glob("*.gif")}
        assert {"learning_curves.png", "losses.png", "paths.png", "reconstructions.png", "evaluation.gif"} <= drawn
        assert ("heatmaps.png" in drawn) == (algorithm != "bc")


@pytest.mark.slow
def test_ls3_and_a_baseline_go_through_evaluate_and_report(run_folder, tmp_path):
    folder = tmp_path / "awac"
    run_experiment(configure("awac", f"output={folder}", f"data={run_folder / 'demonstrations'}"))
    arguments = [f"run={folder}", "episodes=2", "seed=5", "device=cpu"]

    def evaluated(*more):
        return evaluate(compose_settings("evaluate", EvaluateSettings, [*arguments, *more]))

    summary = evaluated(f"output={tmp_path / 'evaluation'}")
    assert summary["algorithm"] == "awac"
    with pytest.raises(ValueError, match=r"is a run of awac, which has no planner: leave out planner\.horizon=3"):
        evaluated("planner.horizon=3", f"output={tmp_path / 'other'}")
    assert not (tmp_path / "other").exists()
    made = report(ReportSettings(runs=(str(run_folder), str(folder)), output=str(tmp_path / "report")))
    assert [row["algorithm"] for row in made] == ["LS³", "AWAC"]
    assert (tmp_path / "report" / "navigation-learning.png").is_file()


@pytest.mark.slow
def test_the_frozen_latents_are_those_of_ls3_with_the_same_seed(run_folder, tmp_path):
    folder = tmp_path / "run"
    config = configure("bc", f"output={folder}", f"data={run_folder / 'demonstrations'}", "pictures=false")
    torch.manual_seed(0)
    run_experiment(config)
    theirs = LS3Agent.load(run_folder / "agent.pt").encoder.state_dict()
    ours = torch.load(folder / "agent.pt", weights_only=True)["state_dict"]
    assert theirs
    for name, weights in theirs.items():
        assert torch.equal(ours[f"encoder.{name}"], weights), name
    # And they can be taken from a file instead.
    other = tmp_path / "other"
    taken = configure(
        "bc", f"output={other}", f"data={run_folder / 'demonstrations'}", f"vae.checkpoint={run_folder / 'agent.pt'}",
        "pictures=false", "seed=7",
    )  # fmt: skip
    run_experiment(taken)
    again = torch.load(other / "agent.pt", weights_only=True)["state_dict"]
    assert all(torch.equal(again[f"encoder.{name}"], weights) for name, weights in theirs.items())


def test_networks_of_another_algorithm_are_refused(tmp_path):
    cloning = parts(configure("bc"))
    path = cloning.save(tmp_path / "bc.pt")
    other = parts(configure("awac"))
    with pytest.raises(ValueError, match="holds no networks of awac"):
        other.restore(path)
    before = {name: weights.clone() for name, weights in cloning.networks.state_dict().items()}
    with torch.no_grad():
        for parameter in cloning.networks.parameters():
            parameter.add_(1.0)
    cloning.restore(path)
    assert all(torch.equal(weights, before[name]) for name, weights in cloning.networks.state_dict().items())


# --- what each learns from ------------------------------------------------------------------------------------


class Box:
    """The specs of an environment, and no more."""

    action_spec = Bounded(low=-3.0, high=3.0, shape=(2,))
    observation_spec = {"pixels": torch.zeros(3, 64, 64)}  # noqa: RUF012


def parts(settings, box=None):
    return ALGORITHMS[settings.algorithm].load()(settings, box or Box(), torch.device("cpu"))


def fill(algorithm, logger, *tags):
    """A buffer with one episode of each tag, violating at step 4 and succeeding at step 6; ``loc`` tells the step."""
    buffer = algorithm.make_buffer(torch.device("cpu"))
    step = {"reward": -torch.ones(9, 1), "pixels": torch.zeros(9, 3, 64, 64, dtype=torch.uint8)}
    step["constraint"], step["success"] = (torch.arange(9)[:, None] == k for k in (4, 6))
    action = torch.zeros(9, 2)
    episode = TensorDict(
        {"pixels": step["pixels"], "action": action, "task_action": action + 1, "next": step}, [1, 9][1:]
    )
    for tag in tags:
        buffer.add(episode, tag)
    if algorithm.vae is not None:
        buffer.encode(algorithm.vae.encoder)
    algorithm.begin(buffer, logger, 9)
    return buffer


@pytest.mark.parametrize("encoder", ["latents", "conv"])
def test_each_learner_draws_from_the_data_that_the_paper_names(recorder, encoder):
    everything = {0, 1, 2, 3}
    learners = {
        "bc": {"cloning": {0}},
        "sacfd": {"cloning": {0}, "critic": {0}, "both": {0, 3}},
        "sacfd_rrl": {"critic": {0}, "both": {0, 3}, "risk": everything, "safer": everything},
        "awac": {"both": everything},
    }
    for name, expected in learners.items():
        algorithm = parts(configure(name, "policy.batch_size=200", f"encoder={encoder}"))
        fill(algorithm, recorder, "success", "rand", "constraint", "online")
        for learner, tags in expected.items():
            rows = algorithm.learners.learners[learner].sample()
            assert set(rows["tag"].unique().tolist()) == tags, (name, learner)
            assert algorithm.observation in rows
            assert algorithm.observation in rows["next"]


def test_rewards_are_penalised_and_nothing_ends_the_task(recorder):
    algorithm = parts(configure("awac", "policy.batch_size=300"))
    fill(algorithm, recorder, "success")
    rows = algorithm.learners.learners["both"].sample()
    violated = rows["next", "constraint"]
    assert violated.any()
    assert (rows["next", "reward"][violated] == -2.0).all()
    assert (rows["next", "reward"][~violated] == -1.0).all()
    assert rows["next", "success"].any()
    assert not rows["next", "terminated"].any()
    assert not rows["next", "done"].any()


def test_the_task_learns_what_it_wanted_and_the_safety_critic_what_was_done(recorder):
    algorithm = parts(configure("sacfd_rrl"))
    fill(algorithm, recorder, "success", "constraint")
    assert (algorithm.learners.learners["both"].sample()["action"] == 1.0).all()
    assert (algorithm.learners.learners["risk"].sample()["action"] == 0.0).all()
    offline = algorithm.offline_data({Tag.SUCCESS: TensorDict({"action": torch.randn(2, 3, 2)}, [2, 3])})
    assert torch.equal(offline[Tag.SUCCESS]["task_action"], offline[Tag.SUCCESS]["action"])


def test_cloning_trains_the_actors_mean_and_leaves_its_spread(recorder):
    algorithm = parts(configure("sacfd", "policy.cloning_steps=150", "policy.hidden=[32]", "policy.lr=0.01"))
    buffer = fill(algorithm, recorder, "success")
    wanted = torch.tensor([1.5, -2.0])
    buffer.transitions.storage[:].get("action").copy_(wanted.expand(9, 2))
    seen = buffer.transitions.storage[:].select("loc")
    before = algorithm.networks["actor"](seen.clone())["action_scale"].detach()
    algorithm.phases()["cloning"]()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        after = algorithm.networks["actor"](seen.clone())
    torch.testing.assert_close(after["action"], wanted.expand(9, 2), atol=0.1, rtol=0)
    assert (after["action_scale"] / before - 1).abs().max() < 2.0  # only through the layers that both share


def test_units_of_the_actions_change_no_value(recorder):
    # The same box in metres and in centimetres: with the correction, entropy is worth the same in both.
    class Small(Box):
        action_spec = Bounded(low=-0.03, high=0.03, shape=(2,))

    rewards = []
    for box in (Box, Small):
        algorithm = parts(configure("sacfd"), box())
        fill(algorithm, recorder, "success")
        # r + γ (Q - α log π): log π is larger by the logarithm of the units.
        log_prob = -2 * math.log(box.action_spec.space.high[0].item())
        bonus = -0.99 * algorithm.options.alpha * log_prob
        rewards.append(algorithm.sample([Tag.SUCCESS])["next", "reward"].max().item() + bonus)
    assert rewards[0] == pytest.approx(rewards[1], abs=1e-5)


# --- health ---------------------------------------------------------------------------------------------------


class Walk:
    """A walk on a line, seen as its two latents: from x = -1 to the goal at x >= 1, by steps of up to 0.2."""

    def __init__(self, episodes: int, policy, horizon: int = 40):
        x = torch.full((episodes, 1), -1.0)
        steps = []
        for _ in range(horizon):
            seen = self.see(x)
            action = policy(TensorDict({"loc": seen}, [episodes])).clamp(-3.0, 3.0)
            x = (x + 0.2 * action[:, :1] / 3.0).clamp(-1.5, 1.2)
            success = x >= 1.0
            reached = {"loc": self.see(x), "reward": success.float() - 1.0, "success": success}
            reached["constraint"] = torch.zeros_like(success)
            steps.append(TensorDict({"loc": seen, "action": action, "next": reached}, [episodes]))
        self.rows = torch.stack(steps, 1)

    @staticmethod
    def see(x):
        return torch.cat([x, x.square()], -1)

    @property
    def steps(self) -> float:
        return float((~self.rows["next", "success"]).sum(1).float().mean())


def walk_online(algorithm, demonstrator, rounds, logger):
    """Train on walks: offline on the demonstrator's, online on its own. Mean steps to the goal, of each round."""
    data = {Tag.SUCCESS: Walk(20, demonstrator).rows.flatten()}

    def sample(batch_size, *, tags, observations=False):
        wanted = [data[tag] for tag in tags if tag in data]
        rows = torch.cat(wanted)
        return rows[torch.randint(len(rows), (batch_size,))].clone()

    buffer = TaggedReplayBuffer(10, latent_dim=2)
    buffer.sample = sample
    algorithm.begin(buffer, logger, 40)
    phases = algorithm.phases()
    phases.pop("vae")
    for train in phases.values():
        train()

    def act(explore):
        kind = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC

        def policy(td):
            with torch.no_grad(), set_exploration_type(kind):
                return algorithm.networks["actor"](td)["action"]

        return policy

    lengths = [Walk(20, act(False)).steps]
    for _ in range(rounds):
        rows = Walk(4, act(True)).rows.flatten()
        data[Tag.ONLINE] = torch.cat([data[Tag.ONLINE], rows]) if Tag.ONLINE in data else rows
        algorithm.update()
        lengths.append(Walk(20, act(False)).steps)
    return lengths


def slow_demonstrator(td):
    return 1.0 + 0.6 * torch.randn(len(td), 2)  # 0.067 a step: about 30 steps, where 10 would do


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm_class", "own"),
    # An advantage is a fraction of a step here, and there are hundreds of gradient steps, not thousands.
    [
        (SACfD, ["policy.alpha=0.02", "policy.tau=0.05", "policy.initial_std=0.3"]),
        (AWAC, ["policy.temperature=0.1", "policy.tau=0.05", "policy.initial_std=0.3"]),
    ],
)
def test_from_slow_demonstrations_to_a_quick_agent(recorder, algorithm_class, own):
    # No wall and λ = 0: what is left is to reach the goal, and sooner than the demonstrator.
    settings = ["policy.hidden=[64,64]", "policy.batch_size=128", "policy.cloning_steps=300", "policy.critic_steps=500"]
    more = ["policy.penalty=0", "policy.updates_per_step=1.5", "policy.lr=1e-3", "agent.latent_dim=2"]
    algorithm = parts(configure(algorithm_class.key, *settings, *more, *own, "online.episodes_per_update=4"))
    lengths = walk_online(algorithm, slow_demonstrator, 8, recorder)
    demonstrated = Walk(200, slow_demonstrator).steps
    assert lengths[0] < 1.3 * demonstrated  # it imitates
    assert lengths[-1] < 0.75 * demonstrated  # and improves
