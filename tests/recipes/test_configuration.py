"""What tasks, presets and arguments resolve to, and what is refused."""

import re
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf
from torchrl.data import Bounded

import ls3_envs
from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.configuration import CONF, choices_of, settings_from, settings_of_run, train_settings
from ls3_recipes.options import as_dict
from ls3_recipes.resume import name_of
from ls3_torchrl import LS3Agent

PRESETS = ("cpu", "paper", "smoke")
RESOLVED = yaml.safe_load((Path(__file__).parent / "resolved_settings.yaml").read_text())


def flat(settings, prefix=""):
    out = {}
    for key, value in settings.items():
        out |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return out


def resolved(algorithm, task, preset):
    """What the table says."""
    table = RESOLVED[algorithm]
    return table["navigation paper"] | table.get(f"{task} {preset}", {})


# --- values ---------------------------------------------------------------------------------------------------

# Table 1 of the supplement, the Navigation column.
TABLE_1 = {
    "planner.safe_set_threshold": 0.8,
    "planner.constraint_threshold": 0.2,
    "vae.beta": 1e-6,
    "planner.horizon": 5,
    "planner.num_particles": 20,
    "planner.num_candidates": 1000,
    "agent.latent_dim": 32,
    "planner.p_random": 1.0,
    "optim.batch_size": 256,
    "vae.batch_size": 256,
    "buffer.gamma": 0.99,
    "loss.gamma_safe_set": 0.3,
}

# What the supplement's text says in addition to the table, and the counts of the original experiments.
TEXT = {
    "agent.dynamics_hidden": [128, 128],
    "agent.value_hidden": [256, 256, 256],
    "agent.classifier_hidden": [256, 256, 256],
    "optim.lr": 1e-4,
    "vae.lr": 1e-4,
    "optim.dynamics_lr": 1e-3,
    "optim.target_interval": 100,
    "planner.relaxation": 0.8,
    "planner.optim_steps": 4,  # n_cem_iters = 5 samples five iterations and scores four
    "online.updates": 25,
    "online.episodes_per_update": 10,
    "online.value_td_steps": 2000,
    "online.dynamics_steps": 512,
    "online.classifier_steps": 512,
    "offline.dynamics_steps": 10_000,
    "offline.classifier_steps": 10_000,
    "vae.steps": 100_000,
    "buffer.capacity": 35_000,
}


def test_the_paper_preset_is_the_paper():
    settings = flat(as_dict(train_settings("task=navigation", "preset=paper")))
    expected = TABLE_1 | TEXT
    assert {key: settings[key] for key in expected} == expected


def test_the_paper_collects_as_many_episodes_as_the_paper():
    assert train_settings("preset=paper").task.offline_episodes is None
    assert {kind: data.episodes for kind, data in ls3_envs.domain("navigation").offline.items()} == {
        "success": 50,
        "constraint": 50,
    }


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("task", ["navigation", "reacher", "pushing", "cable_routing"])
@pytest.mark.parametrize("preset", PRESETS)
def test_every_setting_of_every_task_and_preset(algorithm, task, preset):
    settings = flat(as_dict(train_settings(f"algorithm={algorithm}", f"task={task}", f"preset={preset}")))
    names = {key: settings.pop(key) for key in ("algorithm", "task.name", "preset")}
    assert list(names.values()) == [algorithm, task, preset]
    assert settings.pop("output") is None
    expected = resolved("ls3", task, preset)
    if algorithm != "ls3":  # a baseline has what it shares with LS³, and its own
        own = resolved(algorithm, task, preset)
        expected = {key: value for key, value in expected.items() if key in settings} | own
    assert settings == expected


@pytest.mark.parametrize(
    ("task", "penalty", "gamma", "threshold"),
    [
        ("navigation", -3, 0.95, 0.8),
        ("reacher", -1, 0.55, 0.7),
        ("pushing", -3, 0.75, 0.7),
        ("cable_routing", -3, 0.55, 0.7),
    ],
)
def test_the_supplements_settings_of_the_baselines_per_task(task, penalty, gamma, threshold):
    policy = train_settings("algorithm=sacfd", f"task={task}").policy
    assert (policy.penalty, policy.risk.gamma, policy.risk.threshold, policy.lr) == (penalty, gamma, threshold, 3e-4)
    assert train_settings("algorithm=awac", f"task={task}").policy.penalty == -1


@pytest.mark.parametrize(
    ("task", "elites"), [("navigation", 100), ("reacher", 100), ("pushing", 100), ("cable_routing", 200)]
)
def test_the_elites_of_table_1(task, elites):
    settings = train_settings(f"task={task}", "preset=paper")
    agent = LS3Agent(action_spec=Bounded(low=-3.0, high=3.0, shape=(2,)), planner=as_dict(settings.planner))
    assert agent.planner().optimizer.num_elites == elites


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_fits_the_library(preset):
    settings = train_settings(f"preset={preset}")
    planner = LS3Agent(
        action_spec=Bounded(low=-3.0, high=3.0, shape=(2,)),
        planner=as_dict(settings.planner),
        **as_dict(settings.agent),
    ).planner()
    assert planner.horizon == settings.planner.horizon
    assert planner.optimizer.num_candidates == settings.planner.num_candidates


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_change_the_effort_not_the_safety_thresholds(preset):
    settings = flat(as_dict(train_settings(f"preset={preset}")))
    for key in ("planner.safe_set_threshold", "planner.constraint_threshold", "buffer.gamma", "loss.gamma_safe_set"):
        assert settings[key] == TABLE_1[key]


def test_arguments_win_over_the_preset():
    settings = train_settings("preset=smoke", "planner.num_candidates=33", "seed=7")
    assert settings.planner.num_candidates == 33
    assert settings.seed == 7


def test_a_run_is_named_after_task_preset_and_seed_and_after_a_baseline():
    assert name_of(train_settings("preset=smoke", "seed=4")) == "navigation-smoke-seed4"
    assert name_of(train_settings("algorithm=bc", "preset=smoke", "seed=4")) == "bc-navigation-smoke-seed4"


def test_every_domain_has_a_file_of_settings_and_every_file_a_domain():
    assert choices_of("task") == sorted(ls3_envs.DOMAINS)
    assert choices_of("algorithm") == sorted(ALGORITHMS)
    for path in (CONF / "tuned").glob("*.yaml"):
        task, preset = path.stem.rsplit("-", 1)
        assert task in choices_of("task")
        assert preset in choices_of("preset")
    for path in (CONF / "comparison").glob("*.yaml"):
        algorithm, preset = path.stem.rsplit("-", 1)
        assert algorithm in choices_of("algorithm")
        assert preset in choices_of("preset")


def test_the_preset_paper_keeps_the_defaults_of_the_implementations_that_the_paper_cites():
    sac = train_settings("algorithm=sacfd", "preset=paper")
    assert sac.encoder == "conv"
    assert (sac.policy.alpha, sac.policy.tau, sac.policy.updates_per_step) == (0.2, 0.005, 1)
    assert (sac.policy.batch_size, sac.policy.hidden, sac.policy.lr) == (256, (256, 256), 3e-4)
    awac = train_settings("algorithm=awac", "preset=paper").policy
    assert (awac.batch_size, awac.temperature, awac.tau, awac.updates_per_step, awac.lr) == (1024, 2.0, 0.005, 1, 3e-4)


# --- what is refused ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "error", "message"),
    [
        ("task=moon_landing", ValueError, r"^task must be one of cable_routing, navigation, .*; got 'moon_landing'\.$"),
        ("task=navigaton", ValueError, r"^task must be one of .*; got 'navigaton': did you mean navigation\?$"),
        ("preset=fast", ValueError, r"^preset must be one of cpu, paper, smoke; got 'fast'\."),
        ("tuned=foo", ValueError, r"^tuned must be one of cable_routing-cpu, .*; got 'foo'\."),
        ("planner.num_candidate=5", ValueError, r"^planner has no setting num_candidate: did you mean planner\.num_c"),
        ("sead=1", ValueError, r"^The run has no setting sead: did you mean seed\? It has: algorithm, "),
        ("+planner.num_candidate=5", ValueError, r"^planner has no setting num_candidate: .* It has: horizon, "),
        ("+planner.foo=1", ValueError, r"^planner has no setting foo\. It has: horizon, "),
        ("horizon=5", ValueError, r"^The run has no setting horizon: did you mean task\.horizon or planner\.horizon\?"),
        ("seed.x=5", ValueError, r"^seed is one setting, not a section: seed\.x is none\. Write seed=VALUE\."),
        ("algorithm=dqn", ValueError, "algorithm must be one of ls3, sacfd, awac, bc; got 'dqn'"),
    ],
)
def test_unknown_names_are_refused_with_what_there_is(override, error, message):
    with pytest.raises(error, match=message):
        train_settings(override)


@pytest.mark.parametrize(
    ("algorithm", "override", "message"),
    [
        ("sacfd", "planner.horizon=9", r"planner\.horizon=9: sacfd has no planner\. It has: .*policy, recovery\."),
        ("sacfd", "+planner.horizon=9", r"sacfd has no planner"),
        ("awac", "offline.dynamics_steps=3", r"awac has no offline\. It has: "),
        ("bc", "online.fraction=0.3", r"bc has no online\.fraction\. Its online has: updates, "),
        ("bc", "policy.penalty=-3", r"bc has no policy\.penalty\. Its policy has: hidden, "),
        ("awac", "policy.risk.gamma=0.5", r"awac has no policy\.risk\."),
        ("ls3", "policy.penalty=-3", r"ls3 has no policy\. It has: .*planner\."),
        ("ls3", "recovery=true", r"ls3 has no recovery\."),
    ],
)
def test_settings_that_only_other_algorithms_have_are_refused(algorithm, override, message):
    with pytest.raises(ValueError, match=message):
        train_settings(f"algorithm={algorithm}", "preset=cpu", override)


@pytest.mark.parametrize(
    ("others", "override", "remedy"),
    [
        (["algorithm=bc", "encoder=conv"], "vae.steps=5", "vae only matters with encoder=latents"),
        (["algorithm=awac", "encoder=conv"], "agent.num_dynamics=9", "agent only matters with encoder=latents"),
        (["algorithm=sacfd", "encoder=conv"], "++vae.steps=5", "vae only matters with encoder=latents"),
        (["algorithm=sacfd"], "policy.risk.gamma=0.5", "policy.risk only matters with recovery=true"),
    ],
)
def test_arguments_that_nothing_reads_are_refused_with_what_makes_them_matter(others, override, remedy):
    with pytest.raises(ValueError, match=re.escape(f"{override}: {remedy}. Add that, or leave ")):
        train_settings("preset=smoke", *others, override)
    train_settings("preset=smoke", *others)  # what files bring is left unread
    train_settings("preset=smoke", others[0], remedy.split()[-1], override)


def test_what_matters_to_the_vae_of_a_baseline_can_be_set():
    overrides = ("vae.steps=5", "agent.num_dynamics=9", "buffer.success_tail=7")
    settings = as_dict(train_settings("algorithm=bc", "preset=smoke", *overrides))
    assert (settings["vae"]["steps"], settings["agent"]["num_dynamics"]) == (5, 9)


def test_files_bring_the_settings_of_all_algorithms_and_each_is_left_its_own():
    settings = as_dict(train_settings("algorithm=sacfd", "preset=cpu", "task=pushing"))
    assert not {"planner", "optim", "loss", "offline"} & set(settings)
    assert set(settings["online"]) == {"updates", "episodes_per_update"}


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("agent.layers", r"^agent has no setting layers\. It has: latent_dim, "),
        ("planner.horizn", r"^planner has no setting horizn\. It has: horizon, "),  # of a section that bc lacks
        ("policy.risk.gama", r"^policy\.risk has no setting gama\. It has: gamma, threshold, offline_steps\."),
        ("pictrues", r"^The run has no setting pictrues"),
    ],
)
def test_a_file_with_a_setting_that_nobody_has_is_refused(setting, message):
    config = OmegaConf.create(as_dict(train_settings("algorithm=bc", "preset=smoke")))
    OmegaConf.update(config, setting, 3, force_add=True)
    with pytest.raises(ValueError, match=message):
        settings_from(config, ALGORITHMS["bc"].settings_class)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("vae.steps=0", r"^vae\.steps must be at least 1, got 0"),
        ("vae.schedule=cosine", r"^vae\.schedule"),
        ("vae.warmup=[0.5,0.5]", r"^vae\.warmup"),
        ("vae.warmup=[0.5,1.5]", r"^vae\.warmup"),
        ("vae.prediction_weight=-1.0", r"^vae\.prediction_weight"),
        ("vae.autocast=bf16", r"^vae\.autocast"),
        ("vae.prediction_horizon=0", r"^vae\.prediction_horizon"),
        ("vae.checkpoint=/nowhere.pt", r"^vae\.checkpoint .*there is none at /nowhere\.pt"),
        ("optim.autocast=bf16", r"^optim\.autocast"),
        ("optim.lr=-1.0", r"^optim\.lr"),
        ("loss.timed_out_weight=-0.1", r"^loss\.timed_out_weight"),
        ("loss.mean_latents=[value]", r"^loss\.mean_latents"),
        ("loss.dynamics_horizon=0", r"^loss\.dynamics_horizon"),
        ("online.updates=-1", r"^online\.updates"),
        ("online.episodes_per_update=0", r"^online\.episodes_per_update"),
        ("online.fraction=1.0", r"^online\.fraction"),
        ("online.dynamics_steps=-1", r"^online\.dynamics_steps"),
        ("evaluation.episodes=0", r"^evaluation\.episodes"),
        ("task.horizon=0", r"^task\.horizon"),
        ("task.offline_episodes=0", r"^task\.offline_episodes"),
        ("task.name=moon", r"^task\.name must be one of 'navigation', .*got 'moon'"),
    ],
)
def test_impossible_settings_are_refused_by_their_full_names(override, message):
    train_settings("preset=smoke")
    with pytest.raises(ValueError, match=message):
        train_settings("preset=smoke", override)


@pytest.mark.parametrize(
    ("algorithm", "override"),
    [
        ("bc", "encoder=resnet"),
        ("bc", "policy.lr=0"),
        ("bc", "policy.hidden=[0]"),
        ("bc", "policy.batch_size=0"),
        ("bc", "policy.cloning_steps=-1"),
        ("bc", "vae.checkpoint=/nowhere.pt"),
        ("sacfd", "policy.penalty=3"),
        ("sacfd", "policy.alpha=0"),
        ("sacfd", "policy.tau=0"),
        ("sacfd", "policy.initial_std=0"),
        ("sacfd", "policy.risk.threshold=1.5"),
        ("sacfd", "policy.risk.gamma=-0.5"),
        ("sacfd", "recovery=7"),
        ("awac", "policy.temperature=0"),
        ("awac", "policy.updates_per_step=-1"),
        ("awac", "policy.critic_steps=-1"),
    ],
)
def test_impossible_settings_of_baselines_are_refused_by_their_full_names(algorithm, override):
    name = override.split("=")[0].replace(".", r"\.")
    with pytest.raises((ValueError, TypeError), match=f"^{name}"):
        train_settings(f"algorithm={algorithm}", "preset=smoke", override)


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"config\.yaml is missing"):
        settings_of_run(tmp_path)
    (tmp_path / "config.yaml").write_text("algorithm: dqn\n")
    with pytest.raises(ValueError, match=r"config\.yaml: algorithm must be one of ls3, .*got 'dqn'"):
        settings_of_run(tmp_path)
