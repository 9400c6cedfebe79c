"""Any setting of any run, changed to anything: taken where the documentation allows it, refused by name otherwise."""

import copy
import functools
import math
import re
import sys

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.configuration import train_settings
from ls3_recipes.options import as_dict, build, leaves
from ls3_recipes.relevance import prune

INF = math.inf
# What the documentation says, by hand: low and high of whole numbers and of numbers; "(" and "[" as in mathematics.
WHOLE = {
    **dict.fromkeys(
        [
            "agent.latent_dim",
            "agent.num_dynamics",
            "agent.num_values",
            "buffer.capacity",
            "evaluation.episodes",
            "loss.dynamics_horizon",
            "online.episodes_per_update",
            "optim.batch_size",
            "optim.target_interval",
            "planner.horizon",
            "planner.num_candidates",
            "planner.num_particles",
            "planner.optim_steps",
            "policy.batch_size",
            "vae.batch_size",
            "vae.prediction_horizon",
            "vae.steps",
        ],
        1,
    ),
    **dict.fromkeys(
        [
            "offline.classifier_steps",
            "offline.dynamics_steps",
            "offline.value_steps",
            "online.classifier_steps",
            "online.dynamics_steps",
            "online.updates",
            "online.value_td_steps",
            "planner.max_relaxations",
            "policy.cloning_steps",
            "policy.critic_steps",
            "policy.risk.offline_steps",
            "seed",
        ],
        0,
    ),
}
WHOLE_OR_NULL = dict.fromkeys(
    ["buffer.success_tail", "planner.num_elites", "task.horizon", "task.offline_episodes", "threads", "vae.enlarge_to"],
    1,
)
NUMBERS = {
    **dict.fromkeys(
        [
            "buffer.gamma",
            "loss.gamma_safe_set",
            "planner.p_random",
            "planner.p_constant",
            "policy.risk.gamma",
            "policy.risk.threshold",
        ],
        ("[", 0, 1, "]"),
    ),
    "online.fraction": ("[", 0, 1, ")"),
    **dict.fromkeys(
        ["planner.constraint_threshold", "planner.relaxation", "planner.safe_set_threshold"], ("(", 0, 1, ")")
    ),
    "policy.tau": ("(", 0, 1, "]"),
    "policy.penalty": ("(", -INF, 0, "]"),
    **dict.fromkeys(
        [
            "optim.dynamics_lr",
            "optim.lr",
            "policy.alpha",
            "policy.initial_std",
            "checkpoint_minutes",
            "planner.max_ms",
            "policy.lr",
            "policy.temperature",
            "vae.lr",
        ],
        ("(", 0, INF, ")"),
    ),
    **dict.fromkeys(
        [
            "loss.timed_out_weight",
            "planner.noise_scale",
            "policy.updates_per_step",
            "vae.beta",
            "vae.prediction_weight",
        ],
        ("[", 0, INF, ")"),
    ),
}
FLAGS = {
    "agent.background",
    "agent.control_affine",
    "loss.zero_at_goal",
    "pictures",
    "recovery",
}
WORDS = {
    "encoder": ("latents", "conv"),
    "optim.autocast": (True, False, "auto"),
    "planner.engine": ("auto", "fused", "rollout"),
    "planner.precision": ("auto", "fp32", "bf16"),
    "planner.safe_set_reduction": ("mean", "min"),
    "tracker": ("wandb",),
    "task.name": ("navigation", "reacher", "pushing", "cable_routing"),
    "vae.autocast": (True, False, "auto"),
    "vae.schedule": ("constant", "onecycle"),
}
SIZES = {"agent.dynamics_hidden", "agent.value_hidden", "agent.classifier_hidden", "policy.hidden"}
PAIRS = {"vae.warmup"}
TEXTS = {"algorithm", "preset", "device", "output"}
PATHS = {"data", "scratch_dir", "vae.checkpoint", "output"}
OR_NULL = {"data", "output", "scratch_dir", "vae.checkpoint", "vae.warmup"}
OR_NULL |= {"planner.constraint_threshold", "planner.max_ms", "planner.safe_set_threshold", "tracker"}


def is_whole(value, low):
    whole = type(value) is int or (type(value) is float and value.is_integer())
    return whole and low <= value < 2**63


def is_number(value, low=-INF, high=INF, opening="(", closing=")"):
    if type(value) not in (int, float) or abs(value) > sys.float_info.max or not math.isfinite(value):
        return False
    return (low < value or (opening == "[" and value == low)) and (value < high or (closing == "]" and value == high))


def is_allowed(name, value):
    """Whether the documentation allows a value, whatever the other settings are."""
    if value is None and (name in OR_NULL or name in WHOLE_OR_NULL):
        return True
    if name in WHOLE or name in WHOLE_OR_NULL:
        return is_whole(value, (WHOLE | WHOLE_OR_NULL)[name]) and (name != "seed" or value <= 10**14)
    if name in NUMBERS:
        opening, low, high, closing = NUMBERS[name]
        return is_number(value, low, high, opening, closing)
    if name in FLAGS:
        return type(value) is bool
    if name in WORDS:
        return any(type(value) is type(word) and value == word for word in WORDS[name])
    if name in SIZES:
        return isinstance(value, list) and all(is_whole(item, 1) for item in value)
    if name in PAIRS:
        if not (isinstance(value, list) and len(value) == 2 and all(map(is_number, value))):
            return False
        low, high = value
        return 0 <= low < high <= 1 if name == "vae.warmup" else 0 < low <= high <= 1
    if name == "loss.mean_latents":
        return isinstance(value, list) and all(item in ("dynamics", "constraint", "goal") for item in value)
    if name == "agent.action_scale":
        scales = value if isinstance(value, list) else [value]
        return value == "box" or all(is_number(scale, 0) for scale in scales)
    assert name in TEXTS | PATHS, f"{name} is new: say above what it may be"
    if type(value) is not str or name == "vae.checkpoint":
        return False  # no file is there
    if name == "device":
        return value in ("auto", "cpu", "cuda") or re.fullmatch("cuda:[0-9]{1,4}", value) is not None
    return name not in PATHS or bool(value.strip() and "\0" not in value)


#: Settings that only fit with others, which then are named, too.
TOGETHER = {"planner.num_candidates", "planner.num_elites", "planner.p_random", "planner.p_constant"}


@functools.cache
def composed(algorithm, preset):
    chosen = train_settings(f"algorithm={algorithm}", f"preset={preset}", "task=pushing")
    return as_dict(chosen), leaves(type(chosen))


RUNS = [(algorithm, preset) for algorithm in ALGORITHMS for preset in ("cpu", "paper", "smoke")]
NUMBER = st.one_of(
    st.sampled_from([0, 1, -1, 2, 0.0, -0.0, 0.5, 1.0, 1.5, 1e3, math.nan, INF, -INF, 1e308, 10**9, 10**30, 2**63]),
    st.integers(-(10**6), 10**6),
    st.floats(),
)
WORD = st.one_of(
    st.sampled_from(
        ["", " ", "ten", "1", "1e-3", "nan", ".inf", "true", "maybe", "null", "auto", "max", "best", "box"]
    ),
    st.text(max_size=6),
)
LEAF = st.one_of(NUMBER, WORD, st.booleans(), st.none())
VALUE = st.one_of(LEAF, NUMBER, st.lists(LEAF, max_size=3), st.lists(st.floats(0, 1), min_size=2, max_size=2))


def put(values, name, value):
    changed = copy.deepcopy(values)
    *path, last = name.split(".")
    section = changed
    for key in path:
        section = section[key]
    section[last] = value
    return changed


def refused(settings_class, values):
    """The settings, or the line that they are refused with."""
    try:
        return build(settings_class, prune(values, settings_class)), None
    except (ValueError, TypeError) as error:
        return None, str(error)


def same(got, value):
    if isinstance(value, list):
        return isinstance(got, tuple) and len(got) == len(value) and all(map(same, got, value))
    if {type(got), type(value)} == {int, float}:
        return float(got) == float(value)
    return got == value and type(got) is type(value)


@settings(max_examples=4000)
@given(run=st.sampled_from(RUNS), number=st.integers(0, 10**6), value=VALUE)
@example(run=("ls3", "smoke"), number=0, value="ten")
@example(run=("ls3", "smoke"), number=0, value=10**400)  # too large for a float, which Python says in its own way
def test_a_changed_setting_is_what_the_documentation_says_or_refused_by_name(run, number, value):
    values, names = composed(*run)
    name = names[number % len(names)]
    changed, settings_class = put(values, name, value), ALGORITHMS[run[0]].settings_class
    made, line = refused(settings_class, changed)
    if line is None:
        assert is_allowed(name, value), f"{name}={value!r} was taken"
        got = functools.reduce(getattr, name.split("."), made)
        assert same(got, value)
        if name in WHOLE:
            assert type(got) is int
        if name in NUMBERS and got is not None:
            assert type(got) is float
    else:
        assert not is_allowed(name, value) or name in TOGETHER, f"{name}={value!r}: {line}"
        section, _, last = name.rpartition(".")
        assert name in line or (line.startswith(f"{section}.") and last in line), line
        assert "\n" not in line
        assert len(line) < 2000


@settings(max_examples=300)
@given(run=st.sampled_from(RUNS), number=st.integers(0, 10**6), where=st.integers(0, 30), letter=st.sampled_from("xz_"))
def test_a_misspelt_name_is_refused_with_its_section(run, number, where, letter):
    values, names = composed(*run)
    name = names[number % len(names)]
    section, _, last = name.rpartition(".")
    misspelt = last[: where % len(last)] + letter + last[where % len(last) + 1 :]
    new = f"{section}.{misspelt}" if section else misspelt
    if new in names:
        return
    _, line = refused(ALGORITHMS[run[0]].settings_class, put(values, new, 1))
    assert line.startswith(f"{section or 'The run'} has no setting {misspelt}")
    if len(last) > 4:
        assert f"did you mean {name}?" in line or "did you mean" in line


@pytest.mark.parametrize(("algorithm", "preset"), RUNS)
def test_every_setting_is_in_the_table_above_and_every_preset_is_allowed_by_it(algorithm, preset):
    values, names = composed(algorithm, preset)
    for name in names:
        value = functools.reduce(lambda section, key: section[key], name.split("."), values)
        assert is_allowed(name, value), name
    made, line = refused(ALGORITHMS[algorithm].settings_class, values)
    assert line is None
    assert as_dict(made) == values


@settings(max_examples=60)
@given(run=st.sampled_from(RUNS), number=st.integers(0, 10**6), value=st.one_of(LEAF, st.lists(LEAF, max_size=2)))
def test_the_same_holds_for_arguments_of_the_command_line(run, number, value):
    names = composed(*run)[1]
    name = names[number % len(names)]
    if name in ("algorithm", "preset") or (run[0] != "ls3" and name.startswith("policy.risk")):
        return  # files are chosen by these; risk is not read without recovery
    argument = f"{name}={value}" if not isinstance(value, str) else f"{name}={value!r}"
    try:
        made = train_settings(f"algorithm={run[0]}", f"preset={run[1]}", "task=pushing", argument)
    except (ValueError, TypeError) as error:
        section, _, last = name.rpartition(".")
        line = str(error)
        assert name in line or (line.startswith(f"{section}.") and last in line), line
        assert "\n" not in line
    else:
        got = functools.reduce(getattr, name.split("."), made)
        assert is_allowed(name, [*got] if isinstance(got, tuple) else got)
