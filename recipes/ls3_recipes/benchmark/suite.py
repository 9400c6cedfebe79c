"""How long everything takes on this machine, compared with a plain fp32 eager path in the same run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

import ls3_envs
from ls3_recipes.benchmark.environments import time_environment_steps, time_sampling
from ls3_recipes.benchmark.estimate import estimate, estimate_section
from ls3_recipes.benchmark.growth import growth_section, measure_growth
from ls3_recipes.benchmark.kernels import count_kernels, kernels_section
from ls3_recipes.benchmark.pictures import plot_growth, plot_runs
from ls3_recipes.benchmark.planning import agreement, time_plans
from ls3_recipes.benchmark.runs import runs_section, time_runs
from ls3_recipes.benchmark.tables import figures_section, show
from ls3_recipes.benchmark.timing import matmul_peak
from ls3_recipes.benchmark.updates import time_updates, time_vae
from ls3_recipes.benchmark.workbench import Workbench, make_workbench, preset_settings
from ls3_recipes.command_settings import GROWING, BenchmarkSettings
from ls3_recipes.console import console
from ls3_recipes.device import choose_device, hardware
from ls3_recipes.options import as_dict
from ls3_recipes.plots.style import draw
from ls3_recipes.run_files import require_new
from ls3_recipes.run_folder import RunFolder
from ls3_torchrl import LS3Agent
from ls3_torchrl.trainers.steps import threads


def run_benchmark(settings: BenchmarkSettings) -> dict:
    """Run the benchmark.

    Returns:
        What is written to ``benchmark.json``.

    Raises:
        ValueError: for presets and devices that there are none of; before anything is measured.
        RuntimeError: when a whole run fails.
    """
    settings = settings.at_their_size()
    device = choose_device(settings.device)
    require_new(settings.output)
    if settings.agent is not None:
        LS3Agent.load(settings.agent)
    presets = [preset_settings(settings.task, name) for name in settings.presets]
    for name in (settings.estimate, *settings.runs):
        preset_settings(settings.task, name)  # refused now, not after hours
    if settings.threads:
        torch.set_num_threads(settings.threads)
    folder = RunFolder.make(settings.output, as_dict(settings))
    work = make_workbench(settings, presets, device, folder.path)
    out: dict[str, Any] = {}
    for name in settings.chosen:
        out |= _MEASURE[name](work) or {}
    grown = [curve for name in GROWING for curve in out.pop(name, [])]
    pictures: dict[str, Callable[[], None]] = {}
    if grown:
        first = presets[0].preset
        out["growth"] = grown
        work.sections.insert(0, growth_section(grown, first))
        pictures["growth.png"] = lambda: plot_growth(folder.path / "growth.png", grown, first)
    if "runs" in out:
        pictures["runs.png"] = lambda: plot_runs(folder.path / "runs.png", out["runs"])
    out |= {"agreement": _agreements(work), "hardware": hardware(device), "rows": work.bench.rows}
    folder.write_json("benchmark.json", out)
    folder.close()
    draw(pictures)
    show([*([figures_section(work.bench.rows)] if work.bench.rows else []), *work.sections], folder.path)
    return out


def _planning(work: Workbench) -> dict[str, Any]:
    bench, settings = work.bench, work.settings
    kinds = {str(kind).removeprefix("torch."): kind for kind in (torch.float32, torch.bfloat16)}
    peaks = {name: matmul_peak(bench, kind, work.device) / 1e9 for name, kind in kinds.items()}
    for preset in work.presets:
        time_plans(bench, preset, work.spec, settings.batches, work.device, reference=settings.reference)
    for row in bench.rows:
        if "gflops" in row:
            row["share_of_peak"] = row["gflops"] / peaks["bfloat16" if row["what"].endswith("bf16") else "float32"]
    return {"peak_gflops": peaks}


def _updates(work: Workbench) -> None:
    for preset in work.presets:
        with threads(1):  # as the trainers do
            time_updates(work.bench, preset, work.spec, work.device, reference=work.settings.reference)


def _vae(work: Workbench) -> None:
    frames = work.episodes["pixels"].flatten(0, 1)
    time_vae(work.bench, work.presets[0], work.spec, frames, work.device, reference=work.settings.reference)


def _environments(work: Workbench) -> None:
    for name in work.settings.domains or tuple(ls3_envs.DOMAINS):
        for num_envs in work.settings.batches:
            time_environment_steps(work.bench, name, num_envs, work.device)


def _estimate(work: Workbench) -> dict[str, Any]:
    found = estimate(work)
    work.sections.append(estimate_section(found))
    return {"estimate": found}


def _kernels(work: Workbench) -> dict[str, Any]:
    counted = count_kernels(work)
    work.sections.append(kernels_section(counted))
    return {"kernels": counted}


def _runs(work: Workbench) -> dict[str, Any]:
    runs = time_runs(work)
    work.sections.extend(map(runs_section, runs))
    return {"runs": runs}


def _growing(figure: str) -> Callable[[Workbench], dict[str, Any]]:
    return lambda work: {figure: measure_growth(work, figure)}


#: What measures each figure.
_MEASURE: dict[str, Callable[[Workbench], dict[str, Any] | None]] = {
    "planning": _planning,
    "updates": _updates,
    "vae": _vae,
    "environments": _environments,
    "buffer": lambda work: time_sampling(work.bench, work.presets[0], work.spec, work.episodes),
    **{name: _growing(name) for name in GROWING},
    "estimate": _estimate,
    "kernels": _kernels,
    "runs": _runs,
}


def _agreements(work: Workbench) -> dict[str, Any]:
    """What bf16 changes in the plans of the trained agent, if one is given, by preset."""
    settings = work.settings
    if settings.agent is None:
        return {}
    trained = LS3Agent.load(settings.agent, device=work.device)
    frames = work.episodes["pixels"].flatten(0, 1)
    frames = frames[torch.linspace(0, len(frames) - 1, settings.states).long()]
    found = {}
    for preset in work.presets:
        figures = found[preset.preset] = agreement(trained, as_dict(preset.planner), work.spec, frames)
        console.print(
            f"bf16 for fp32, planner of {preset.preset}: value off by {figures['value_error']:.2%} in the median, "
            f"other feasibility for {figures['feasibility']:.2%} of candidates"
        )
    return found
