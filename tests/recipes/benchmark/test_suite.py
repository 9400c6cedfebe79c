"""The benchmark runs, writes what it measured, and counts operations as they are."""

import json
import sys

import pytest
import torch
from torch import nn
from torchrl.data import Bounded

from ls3_recipes.benchmark.planning import agreement, permissive, plan_flops
from ls3_recipes.benchmark.reference import ReferenceVAE
from ls3_recipes.benchmark.suite import run_benchmark
from ls3_recipes.benchmark.timing import Bench
from ls3_recipes.command_settings import BenchmarkSettings
from ls3_recipes.commands import benchmark as command
from ls3_recipes.configuration import compose_settings
from ls3_torchrl import LS3Agent


def test_the_benchmark_writes_its_figures_and_ratios(tmp_path, capsys):
    out = tmp_path / "bench"
    settings = [
        "presets=[smoke]",
        "domains=[navigation]",
        "batches=[1,2]",
        "seconds=0.01",
        "device=cpu",
        "figures=[planning,updates,vae,environments,buffer]",
        f"output={out}",
    ]
    run_benchmark(compose_settings("benchmark", BenchmarkSettings, settings))
    written = json.loads((out / "benchmark.json").read_text())
    # Nothing of the table is cut, whatever the terminal's width.
    table, printed = (out / "benchmark.md").read_text(), capsys.readouterr().out
    assert all(row["what"] in table and row["what"] in printed for row in written["rows"])
    assert "…" not in printed
    rows = {row["what"]: row for row in written["rows"]}
    assert all(row["median_ms"] > 0 and row["runs"] >= 1 for row in rows.values())
    for figure in (
        "plan, smoke, fp32",
        "plan, smoke, auto, each of 2",
        "dynamics step, smoke, bf16",
        "value step, smoke, fp32",
        "VAE step of 256, fp32",
    ):
        row = rows[figure]
        assert row["times_faster"] == pytest.approx(rows[row["against"]]["median_ms"] / row["median_ms"])
    assert rows["plan, smoke, fp32"]["share_of_peak"] > 0
    assert rows["step with pixels, navigation, each of 2"]["per_cpu_second"] > 0


def test_operations_of_a_plan_by_hand():
    agent = LS3Agent(2, latent_dim=3, dynamics_hidden=[4], value_hidden=[5], classifier_hidden=[6], num_values=7)
    options = {"num_candidates": 11, "num_particles": 2, "optim_steps": 3, "horizon": 5}
    dynamics, head, value = (3 + 2) * 4 + 4 * 6, 3 * 6 + 6 * 1, 3 * 5 + 5 * 1
    by_hand = 2 * 11 * 2 * 3 * (5 * (dynamics + 2 * head) + head + 7 * value)
    assert plan_flops(agent, options) == by_hand


def test_every_plan_of_a_permissive_agent_is_feasible():
    torch.manual_seed(0)
    agent = permissive(LS3Agent(2, latent_dim=4))
    planner = agent.planner(Bounded(low=-1.0, high=1.0, shape=(2,)), num_candidates=20, num_elites=2, num_particles=2)
    result = planner.plan(torch.randn(3, 4))
    assert not result.fallback.any()
    assert result.iterations.tolist() == [4, 4, 4]


def test_the_reference_vae_has_the_layers_of_the_agents():
    agent = LS3Agent(2, latent_dim=4)
    reference = ReferenceVAE(agent)
    assert sum(p.numel() for p in reference.parameters()) == sum(
        p.numel() for half in (agent.encoder, agent.decoder) for p in half.parameters()
    )
    kinds = {type(layer) for layer in reference.modules() if isinstance(layer, (nn.Conv2d, nn.ConvTranspose2d))}
    assert kinds == {nn.Conv2d, nn.ConvTranspose2d}
    assert reference.loss(torch.zeros(2, 3, 64, 64, dtype=torch.uint8)).isfinite()


def test_bf16_agrees_closely_and_fp32_with_itself_exactly(monkeypatch):
    torch.manual_seed(0)
    agent = LS3Agent(2, latent_dim=4, value_hidden=[32], classifier_hidden=[32], dynamics_hidden=[32])
    spec = Bounded(low=-1.0, high=1.0, shape=(2,))
    options = {"num_candidates": 60, "num_elites": 6, "num_particles": 2, "horizon": 3, "safe_set_threshold": 0.5}
    frames = torch.randint(256, (4, 3, 64, 64), dtype=torch.uint8)
    found = agreement(agent, options, spec, frames)
    assert 0.0 <= found["value_error"] < 0.2
    assert 0.0 <= found["feasibility"] < 0.5
    plan = LS3Agent.planner
    monkeypatch.setattr(LS3Agent, "planner", lambda self, spec, **o: plan(self, spec, **(o | {"precision": "fp32"})))
    same = agreement(agent, options, spec, frames)
    assert same["value_error"] < 1e-6  # two plans scored side by side may be summed in another order
    assert same["feasibility"] == 0.0


def test_what_takes_long_is_timed_once():
    bench, calls = Bench(seconds=5.0), []
    bench.time("long", lambda: calls.append(1), once=True)
    assert len(calls) == 1
    assert bench.rows[0]["runs"] == 1
    assert bench.rows[0]["iqr_ms"] == 0.0
    assert bench.rows[0]["median_ms"] > 0.0


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("presets=[]", r"at least one, such as presets="),
        ("domains=[moon]", r"domains must be one of 'navigation', .*got 'moon'"),
        ("batches=[0]", "batches must be at least 1"),
        ("seconds=0", "seconds must be a finite number above 0"),
    ],
)
def test_what_cannot_be_timed_is_refused_before_anything_is(override, message):
    with pytest.raises(ValueError, match=message):
        compose_settings("benchmark", BenchmarkSettings, [override])


def test_the_former_name_of_the_reference_is_read(monkeypatch, capfd, tmp_path):
    seen = []
    monkeypatch.setattr(sys, "argv", ["ls3"])
    monkeypatch.setattr(command, "run_benchmark", seen.append)
    command.main(["plain=false", "seconds=1", f"output={tmp_path / 'new'}"])
    assert capfd.readouterr().err == "ls3 benchmark: plain is now reference\n"
    assert [(settings.reference, settings.seconds) for settings in seen] == [(False, 1)]


def test_the_task_can_be_chosen_although_hydra_has_a_folder_of_that_name():
    assert compose_settings("benchmark", BenchmarkSettings, ["task=reacher"]).task == "reacher"
