"""Where jobs are carried out: each launcher starts the same processes."""

import os
import sys
import time

import pytest

from ls3_recipes.sweep.launchers import Local, make_launcher
from ls3_recipes.sweep.task import Task, start

RUN = "preset=smoke", "device=cpu"


def collecting(folder, name="data"):
    return Task(("data", str(folder / name), "", *RUN), str(folder / "logs" / f"{name}.log"), str(folder))


def refused(folder):
    return Task(("data", str(folder / "x"), "", "preset=nope"), str(folder / "logs" / "x.log"), str(folder))


def test_cores_are_shared_out():
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert Local().slots == cores
    assert Local(workers=1)._threads == cores
    assert Local(threads=1, workers=3)._shares() in ([set()] * 3, Local(threads=1, workers=3)._free)
    assert Local(workers=1, threads=max(1, cores - 1))._shares() == [set()] or cores == 1  # others may be there
    assert Local(workers=10 * cores)._shares() == [set()] * (10 * cores)
    with pytest.raises(ValueError, match="workers must be at least 1, got 0"):
        Local(workers=0)


def test_settings_of_launchers_are_checked(tmp_path):
    assert isinstance(make_launcher(None, tmp_path), Local)
    with pytest.raises(ValueError, match="'cloud'"):
        make_launcher({"name": "cloud"}, tmp_path)
    with pytest.raises(ValueError, match=r"hydra\.launcher\.workers"):
        make_launcher({"name": "local", "worker": 1}, tmp_path)
    with pytest.raises(TypeError, match=r"hydra\.launcher\.workers must be a whole number"):
        make_launcher({"name": "local", "workers": "all"}, tmp_path)


def test_slurm_is_refused_where_there_is_none(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ValueError, match=r"no srun.*hydra\.launcher\.cluster=local"):
        make_launcher({"name": "slurm"}, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["local", "ray", "slurm"])
def test_a_launcher_tells_how_tasks_ended(tmp_path, name):
    options = {"local": {"workers": 2}, "ray": {"num_cpus": 2}, "slurm": {"cluster": "local", "threads": 1}}[name]
    if name != "local":
        pytest.importorskip({"slurm": "submitit"}.get(name, name))
    launcher = make_launcher({"name": name, **options}, tmp_path)
    try:
        good, bad = launcher.submit(collecting(tmp_path)), launcher.submit(refused(tmp_path))
        assert good.result(timeout=120) == 0
        assert bad.result(timeout=120) == 1
    finally:
        launcher.close()
    assert (tmp_path / "data" / "description.json").is_file() or any((tmp_path / "data").iterdir())
    assert "preset must be one of" in (tmp_path / "logs" / "x.log").read_text()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a run goes on alone")
def test_a_task_ends_with_the_process_that_started_it(tmp_path):
    task = Task(("vae", str(tmp_path / "vae"), "", *RUN, "vae.steps=1000000"), str(tmp_path / "log"), str(tmp_path))
    child = os.fork()
    if child == 0:  # starts it, and is killed
        process = start(task, 1)
        (tmp_path / "number").write_text(str(process.pid))
        time.sleep(600)
        os._exit(0)
    metrics = tmp_path / "vae" / "metrics.csv"
    while not metrics.is_file() or metrics.read_bytes().count(b"\n") < 2:  # until it has learnt something
        time.sleep(0.05)
    number = int((tmp_path / "number").read_text())
    os.kill(child, 9)
    os.waitpid(child, 0)
    for _ in range(1200):
        try:
            os.kill(number, 0)
        except ProcessLookupError:
            break
        time.sleep(0.05)
    else:
        pytest.fail("It goes on.")
    assert any((tmp_path / "vae" / "checkpoints").glob("run-*"))  # it has saved its state
