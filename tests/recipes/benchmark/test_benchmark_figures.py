"""Figures can be chosen; each leaves table and picture, and what is computed from them is right by hand."""

import json
import math
import sys

import pytest
import torch

from ls3_recipes.benchmark.estimate import Costs, counts
from ls3_recipes.benchmark.growth import SIZES, exponent
from ls3_recipes.benchmark.kernels import count_calls
from ls3_recipes.benchmark.runs import REST, by_phase
from ls3_recipes.benchmark.suite import _MEASURE, run_benchmark
from ls3_recipes.benchmark.workbench import make_workbench, preset_settings
from ls3_recipes.command_settings import FIGURES, GROWING, BenchmarkSettings
from ls3_recipes.commands import benchmark  # noqa: F401  (Hydra is told of its settings)
from ls3_recipes.configuration import compose_settings, train_settings
from ls3_recipes.experiment import Experiment
from ls3_recipes.interrupts import Interrupts
from ls3_torchrl.data import buffer as buffer_module

CPU = torch.device("cpu")


def settings(*overrides):
    return compose_settings("benchmark", BenchmarkSettings, ["device=cpu", *overrides])


def test_figures_are_all_or_those_that_are_asked_for():
    assert settings().chosen == FIGURES == tuple(_MEASURE)
    assert settings("figures=[images,buffer]").chosen == ("buffer", "images")
    assert set(GROWING) == set(SIZES)


@pytest.mark.parametrize("bad", ["[candidate]", "[planning,candidate]", "[]"])
def test_unknown_figures_are_refused_with_those_that_there_are(bad):
    with pytest.raises(ValueError, match=r"figures must be some of planning, updates, .*, runs; got") as error:
        settings(f"figures={bad}")
    assert "leave it out to measure all" in str(error.value)
    assert "candidate" not in bad or "did you mean candidates?" in str(error.value)


@pytest.mark.parametrize("override", ["runs=[cpv]", "estimate=cpv"])
def test_unknown_presets_are_refused_before_anything_is_measured(override, tmp_path):
    with pytest.raises(ValueError, match="cpv"):
        run_benchmark(settings("figures=[buffer]", override, f"output={tmp_path / 'out'}"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("power", [-0.5, 0.0, 0.48, 1.0, 2.0])
def test_exponents_of_powers_are_exact(power):
    sizes = [1, 2, 4, 8, 16]
    assert exponent(sizes, [3.7 * size**power for size in sizes]) == pytest.approx(power, abs=1e-9)


def test_an_exponent_needs_two_sizes_and_costs():
    for sizes, costs in (([4], [1.0]), ([4, 4], [1.0, 2.0]), ([1, 2], [0.0, 1.0])):
        with pytest.raises(ValueError, match="two sizes"):
            exponent(sizes, costs)


@pytest.fixture(scope="module")
def smallest(tmp_path_factory):
    """All new figures in one run at smoke size."""
    out = tmp_path_factory.mktemp("benchmark") / "out"
    chosen = ",".join((*GROWING, "estimate", "kernels", "runs"))
    return run_benchmark(settings("smoke=true", f"figures=[{chosen}]", f"output={out}")), out


def test_every_new_figure_leaves_table_and_picture(smallest):
    found, out = smallest
    assert json.loads((out / "benchmark.json").read_text()).keys() == found.keys()
    table = (out / "benchmark.md").read_text()
    for title in ("Cost as work grows", "Estimate for smoke", "What a GPU would be bound by", "A whole run of smoke"):
        assert f"## {title}" in table
    for name in ("growth.png", "runs.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    assert {curve["figure"] for curve in found["growth"]} == set(GROWING)
    for curve in found["growth"]:
        assert len(curve["sizes"]) == len(curve["median_ms"]) == len(curve["iqr_ms"]) == 2
        assert curve["exponent"] == pytest.approx(exponent(curve["sizes"], curve["median_ms"]))
        assert f"{curve['what']}, {curve['unit']}" in table
    assert (out / "runs" / "smoke" / "summary.json").is_file()


def test_the_estimate_is_the_sum_of_what_it_lists(smallest):
    found = smallest[0]["estimate"]
    assert all(row["hours"] == pytest.approx(row["count"] * row["ms"] / 3.6e6) for row in found["rows"])
    assert all(row["ms"] > 0.0 for row in found["rows"])
    assert found["hours"] == pytest.approx(sum(row["hours"] for row in found["rows"] if row["summed"]))


def test_counts_of_the_estimate_are_those_of_a_run(monkeypatch, tmp_path):
    """What a run does is counted where it is done."""
    encoded, planned = [], []
    plain = buffer_module.encode_frames

    def counted(encoder, frames, **options):
        encoded.append(len(frames))
        return plain(encoder, frames, **options)

    monkeypatch.setattr(buffer_module, "encode_frames", counted)
    run = train_settings("preset=smoke", "device=cpu", "pictures=false", f"output={tmp_path / 'run'}")
    with Interrupts() as interrupts:
        experiment = Experiment(run, interrupts)
        experiment.start()
        experiment.algorithm.policy.register_forward_hook(lambda _, __, out: planned.append(out.batch_size.numel()))
        experiment.collect()
        experiment.resume()
        experiment.train_offline()
        offline = {name: one.steps for name, one in experiment.algorithm.trainer.learners.items()}
        passes = len(encoded)
        experiment.improve_online()
        experiment.select()
        before = sum(planned)
        experiment.evaluate()
        summary = experiment.finish()
        experiment.folder.close()
    of_bench = settings("smoke=true", f"output={tmp_path / 'bench'}")
    costs = Costs(make_workbench(of_bench, [run], CPU, tmp_path), preset_settings("navigation", "smoke"))
    many = counts(run, costs.horizon, costs.frames)

    assert many["VAE", "VAE step"] == experiment.algorithm.vae.steps
    assert many["VAE", "frame encoded"] == sum(encoded[:passes])
    assert many["planning", "frame encoded"] == sum(encoded[passes:])
    for tag, episodes in experiment.offline.items():
        assert many["data", f"{tag.name.lower()} episode"] == len(episodes)
    for name, learner in experiment.algorithm.trainer.learners.items():
        assert many.get(("offline", name), 0) == offline[name]
        assert many.get(("updates", name), 0) == learner.steps - offline[name]
    assert many["planning", "world-step planned"] == summary["online"]["episodes"] * costs.horizon
    # TorchRL's collector asks the policy once for the keys that it writes.
    assert many["planning", "world-step planned"] == before - run.online.episodes_per_update
    assert many["evaluation", "world-step planned"] == sum(planned) - before
    assert many["evaluation", "world-step planned"] == summary["evaluation"]["episodes"] * costs.horizon


def test_counts_follow_the_presets():
    paper, cpu = (preset_settings("navigation", name) for name in ("paper", "cpu"))
    frames = dict.fromkeys(("success", "constraint"), 101.0)
    assert counts(paper, 100, frames)["updates", "value_td"] == 25 * 2000
    assert counts(paper, 100, frames)["planning", "world-step planned"] == 25 * 10 * 100
    assert counts(paper, 100, frames)["VAE", "frame encoded"] == 10_100
    assert counts(cpu, 100, frames)["VAE", "frame encoded"] == 2 * 10_100  # once more in units of their spread


def test_phases_and_the_rest_make_the_whole_run():
    summary = {"hardware": {"cores": 2}, "seconds": {"demonstrations": 2.0, "vae": 6.0}}
    summary["cpu_utilisation"] = {"demonstrations": 0.5, "vae": 1.0}
    run = by_phase(summary, seconds=10.0, busy=15.0)
    assert [phase["name"] for phase in run["phases"]] == ["data", "VAE", REST]
    assert sum(phase["seconds"] for phase in run["phases"]) == 10.0
    assert [phase["utilisation"] for phase in run["phases"]] == pytest.approx([0.5, 1.0, 1.0 / 4.0])
    silent = by_phase(summary | {"cpu_utilisation": {}}, seconds=10.0)
    assert not any("utilisation" in phase for phase in silent["phases"])


def test_a_whole_run_tells_how_busy_the_cores_were(smallest):
    (run,) = smallest[0]["runs"]
    used = [phase["utilisation"] for phase in run["phases"] if "utilisation" in phase]
    assert all(0.0 <= share <= 1.0 for share in used)
    if sys.platform == "linux":
        assert len(used) == len(run["phases"])


def test_operators_are_counted_once_and_products_by_hand():
    a, b = torch.ones(4, 8), torch.ones(8, 16)
    calls = count_calls(lambda: (a @ b).t().relu().sum().item())
    assert calls.operators == 4  # product, relu, sum, item; the transposed view is none
    assert calls.waits == 1
    assert calls.gflop == pytest.approx(2 * 4 * 8 * 16 / 1e9)


def test_a_plan_is_more_launches_than_products_at_smoke_size(smallest):
    counted = {row["what"]: row for row in smallest[0]["kernels"]}
    assert counted["plan, smoke"]["operators"] > 100
    assert all(row["gflop"] > 0.0 and math.isfinite(row["gflop"]) for row in counted.values())
