"""Which runs a sweep consists of."""

import pytest

from ls3_recipes.sweep.jobs import jobs_of, vae_depends_on
from ls3_recipes.sweep.plan import planned_runs

ARMS = [["algorithm=ls3"], ["algorithm=sacfd", "recovery=true"]]


def names(runs):
    return [run.name for run in runs]


def test_every_arm_has_every_combination_and_the_first_seed_comes_first():
    runs = planned_runs(ARMS, ["seed=range(2)", "task=navigation,reacher"], ["preset=smoke"])
    assert names(runs) == [
        "ls3-navigation-seed0",
        "ls3-reacher-seed0",
        "sacfd-navigation-recovery=true-seed0",
        "sacfd-reacher-recovery=true-seed0",
        "ls3-navigation-seed1",
        "ls3-reacher-seed1",
        "sacfd-navigation-recovery=true-seed1",
        "sacfd-reacher-recovery=true-seed1",
    ]
    assert runs[3].settings.recovery
    assert {run.settings.preset for run in runs} == {"smoke"}


def test_arguments_take_the_place_of_what_a_file_says():
    arms = [["planner.horizon=1,3,5"]]
    runs = planned_runs(arms, ["seed=range(10)"], ["seed=7", "planner.horizon=2,4", "preset=smoke"])
    assert names(runs) == ["ls3-navigation-horizon=2-seed7", "ls3-navigation-horizon=4-seed7"]
    assert [run.settings.planner.horizon for run in runs] == [2, 4]


def test_no_threshold_is_a_value_like_others():
    runs = planned_runs([["planner.safe_set_threshold=0.5,null"]], [], ["preset=smoke"])
    assert [run.settings.planner.safe_set_threshold for run in runs] == [0.5, None]
    assert names(runs)[1] == "ls3-navigation-safe_set_threshold=null-seed0"


def test_names_of_many_settings_fit_a_file_system_and_stay_apart():
    many = [f"planner.{name}" for name in ("relaxation=0.75", "noise_scale=0.5", "safe_set_reduction=min")]
    many += ["online.fraction=0.25", "loss.timed_out_weight=0.5", "vae.prediction_weight=12.5", "optim.lr=0.001"]
    arms = [[*many, f"loss.gamma_safe_set={gamma}"] for gamma in (0.5, 0.6)]
    one, other = names(planned_runs(arms, [], ["preset=smoke"]))
    assert one != other
    for name in (one, other):
        assert name.startswith("ls3-navigation-relaxation=0.75-noise_scale=0.5-")
        assert name.endswith("-seed0")
        assert len(name.encode()) < 180
    assert one == names(planned_runs(arms[:1], [], ["preset=smoke"]))[0]


def test_what_no_run_can_have_is_refused_before_any_begins():
    with pytest.raises(ValueError, match=r"planner\.horizon must not|planner\.horizon must be at least 1"):
        planned_runs([[]], ["seed=0,1"], ["planner.horizon=3,0"])
    with pytest.raises(ValueError, match="did you mean planner"):
        planned_runs([[]], [], ["planner.horizn=3"])
    with pytest.raises(ValueError, match="has no planner"):
        planned_runs(ARMS, [], ["planner.horizon=3"])


@pytest.mark.parametrize(
    ("given", "wrong"), [("seed=range(0)", "no value in it"), ("seed=glob(*)", "glob.. is not known")]
)
def test_values_that_are_none_are_refused(given, wrong):
    with pytest.raises(ValueError, match=rf"{wrong}.*\. Write the values of seed as A,B"):
        planned_runs([[]], [], [given, "preset=smoke"])


def test_two_runs_of_one_name_are_refused():
    with pytest.raises(ValueError, match="would both be called"):  # the last parts of two settings' names
        planned_runs([["task.horizon=12"], ["planner.horizon=12"]], ["seed=0"], ["preset=smoke"])


@pytest.mark.parametrize(
    ("arms", "given"),
    [([[]], "threads=1,2"), ([[]], "pictures=true,false"), ([["planner.horizon=3"], []], "seed=0")],
)
def test_two_runs_that_would_do_the_same_are_refused(arms, given):
    with pytest.raises(ValueError, match="would do the same"):
        planned_runs(arms, [], ["preset=smoke", given])


def test_values_that_are_no_list_are_refused_with_how_to_write_them():
    for given in ("seed=glob(*)", "seed=interval(0,3)"):
        with pytest.raises(ValueError, match=r"Write the values of seed as A,B or range"):
            planned_runs([[]], [], ["preset=smoke", given])
    with pytest.raises(ValueError, match="output=x: the sweep itself says where its runs go"):
        planned_runs([["output=x"]], [], ["preset=smoke"])


def test_runs_of_one_seed_share_what_they_do_not_differ_in(tmp_path):
    runs = planned_runs([*ARMS, ["algorithm=ls3", "vae.beta=0.1"]], ["seed=0,1"], ["preset=smoke"])
    jobs = jobs_of(runs, tmp_path, rollouts=5)
    kinds = [job.kind for job in jobs.values()]
    assert {kind: kinds.count(kind) for kind in kinds} == {"data": 2, "vae": 4, "train": 6, "rollouts": 6}
    one, other = (jobs[name] for name in ("ls3-navigation-seed0", "sacfd-navigation-recovery=true-seed0"))
    assert one.needs == other.needs
    assert jobs["ls3-navigation-beta=0.1-seed0"].needs[0] == one.needs[0]  # the demonstrations
    assert jobs["ls3-navigation-beta=0.1-seed0"].needs[1] != one.needs[1]
    order = list(jobs)
    assert all(order.index(need) < order.index(name) for name, job in jobs.items() for need in job.needs)


def test_what_a_run_is_given_is_not_made(tmp_path):
    run = planned_runs([[]], [], ["preset=smoke", f"data={tmp_path}"])
    assert [job.kind for job in jobs_of(run, tmp_path, 0).values()] == ["vae", "train"]
    run = planned_runs([["algorithm=awac"]], [], ["preset=smoke", "encoder=conv"])
    assert [job.kind for job in jobs_of(run, tmp_path, 0).values()] == ["data", "train"]


def test_a_vae_depends_on_what_it_is_trained_on_and_how():
    def depends(*overrides):
        return vae_depends_on(planned_runs([[]], [], ["preset=smoke", *overrides])[0].settings)

    assert depends() == depends("planner.horizon=2", "optim.lr=0.5", "online.updates=1")
    changes = ("seed=1", "vae.steps=7", "agent.latent_dim=9", "task.offline_episodes=4", "buffer.success_tail=3")
    assert len({repr(depends(change)) for change in changes} | {repr(depends())}) == 6
    assert depends() == depends("algorithm=awac")
