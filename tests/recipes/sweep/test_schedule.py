"""Jobs of a sweep, carried out by a launcher that does them in this process."""

from concurrent.futures import Future
from pathlib import Path

import pytest

from ls3_recipes.interrupts import Interrupts
from ls3_recipes.rollouts import roll_out
from ls3_recipes.run_files import read_json
from ls3_recipes.sweep.index import Index
from ls3_recipes.sweep.jobs import Job
from ls3_recipes.sweep.launchers import Launcher
from ls3_recipes.sweep.schedule import Schedule
from ls3_recipes.sweep.task import Task
from ls3_torchrl.files import save_json_atomically


class Instant(Launcher):
    """Does at once what a function says; those of more than one slot end in the order in which they began."""

    def __init__(self, do, slots=2):
        self.do, self.slots, self.begun, self.stopped = do, slots, [], False

    def submit(self, task):
        self.begun.append(task.arguments[1].rsplit("/", 1)[-1])
        future = Future()
        try:
            future.set_result(self.do(task))
        except RuntimeError as error:
            future.set_exception(error)
        return future

    def stop(self):
        self.stopped = True


def finish(task, minutes=1.0):
    save_json_atomically({"minutes": minutes}, f"{task.arguments[1]}/summary.json")
    Path(task.arguments[1], "config.yaml").touch()
    return 0


def job(folder, name, *needs, kind="train"):
    return Job(name, kind, folder / name, (), needs)


def carry_out(tmp_path, jobs, launcher):
    index = Index(tmp_path / "jobs.csv", jobs)
    schedule = Schedule({job.name: job for job in jobs}, index, launcher, tmp_path / "logs", "")
    with Interrupts() as interrupts:
        schedule.carry_out(interrupts)
    return index


def test_jobs_begin_when_what_they_need_is_there(tmp_path):
    jobs = [
        job(tmp_path, "vae", kind="vae"),
        job(tmp_path, "a", "vae"),
        job(tmp_path, "b", "vae"),
        job(tmp_path, "c", "b"),
    ]
    launcher = Instant(finish)
    index = carry_out(tmp_path, jobs, launcher)
    assert launcher.begun[0] == "vae"
    assert launcher.begun.index("b") < launcher.begun.index("c")
    assert set(index.states.values()) == {"finished"}
    assert read_json(tmp_path / "c" / "summary.json")


def test_one_that_fails_costs_only_those_that_need_it(tmp_path):
    def do(task):
        if task.arguments[1].endswith("bad"):
            raise RuntimeError("worker lost")
        if task.arguments[1].endswith("worse"):
            (tmp_path / "logs").mkdir(exist_ok=True)
            (tmp_path / "logs" / "worse.log").write_text("50%\r100%\nls3 sweep: no room is left.\n\n")
            return 1
        return finish(task)

    jobs = [job(tmp_path, "bad"), job(tmp_path, "after", "bad"), job(tmp_path, "last", "after")]
    jobs += [job(tmp_path, "worse"), job(tmp_path, "good")]
    index = carry_out(tmp_path, jobs, Instant(do))
    assert index.states == {
        "bad": "failed",
        "after": "not begun",
        "last": "not begun",
        "worse": "failed",
        "good": "finished",
    }
    assert index.errors["bad"] == "worker lost"
    assert index.errors["after"] == "bad failed"
    assert index.errors["worse"] == "ls3 sweep: no room is left."
    table = (tmp_path / "jobs.csv").read_text()
    assert "worker lost" in table
    assert "good,train,finished,1.0" in table


def test_one_that_says_it_is_done_and_is_not_has_failed(tmp_path):
    index = carry_out(tmp_path, [job(tmp_path, "liar")], Instant(lambda task: 0))
    assert index.states == {"liar": "failed"}


def test_a_run_without_its_settings_or_its_rollouts_is_not_finished(tmp_path):
    run = job(tmp_path, "a")
    finish(Task(("train", str(tmp_path / "a")), "", ""))
    assert run.is_done()
    rollouts = Job("a-rollouts", "rollouts", tmp_path / "a", ("2",), ("a",))
    assert not rollouts.is_done()
    with pytest.raises(FileNotFoundError, match="no run: config"):
        roll_out(tmp_path / "nowhere", 2)
    (tmp_path / "a" / "config.yaml").unlink()
    assert not run.is_done()


def test_what_is_finished_is_not_done_again(tmp_path):
    jobs = [job(tmp_path, "a"), job(tmp_path, "b")]
    finish(Task(("train", str(tmp_path / "a")), "", ""), minutes=2.0)
    launcher = Instant(finish)
    carry_out(tmp_path, jobs, launcher)
    assert launcher.begun == ["b"]


def test_the_table_keeps_the_jobs_of_earlier_calls(tmp_path):
    earlier = [job(tmp_path, "a"), job(tmp_path, "b")]
    carry_out(tmp_path, earlier, Instant(finish))
    path = tmp_path / "jobs.csv"
    path.write_text(path.read_text().replace("b,train,finished", "b,train,running"))  # as a kill leaves it
    index = carry_out(tmp_path, [job(tmp_path, "c")], Instant(finish))
    assert index.states == {"c": "finished"}
    lines = path.read_text().splitlines()
    assert [line.split(",")[0] for line in lines[1:]] == ["c", "a", "b"]
    assert "a,train,finished,1.0" in lines[2]
    assert "b,train,cut off,1.0" in lines[3]
    for damage in ("name,kind\nd,train\n", "", "\x00", path.read_text() + "one,too,few\n"):
        path.write_text(damage)
        carry_out(tmp_path, [job(tmp_path, "c")], Instant(finish))
        assert path.read_text().splitlines() == lines[:2]


def test_data_and_vaes_that_were_deleted_are_made_again_for_unfinished_runs_alone(tmp_path):
    def jobs(*names):
        of_all = [job(tmp_path, "data", kind="data"), job(tmp_path, "vae", "data", kind="vae")]
        return [*of_all, *(job(tmp_path, name, "data", "vae") for name in names)]

    finish(Task(("train", str(tmp_path / "a")), "", ""), minutes=2.0)
    launcher = Instant(finish)
    index = carry_out(tmp_path, jobs("a"), launcher)
    assert launcher.begun == []
    assert index.states == {"data": "not needed", "vae": "not needed", "a": "finished"}
    index = carry_out(tmp_path, jobs("a", "b"), launcher)
    assert launcher.begun == ["data", "vae", "b"]
    assert set(index.states.values()) == {"finished"}


def test_ctrl_c_stops_what_is_under_way_and_says_so(tmp_path):
    import os
    import signal

    class Slow(Instant):
        def submit(self, task):
            self.begun.append(task.arguments[1])
            os.kill(os.getpid(), signal.SIGINT)
            return Future()

    launcher, jobs = Slow(finish, slots=1), [job(tmp_path, "a"), job(tmp_path, "b")]
    with pytest.raises(KeyboardInterrupt):
        carry_out(tmp_path, jobs, launcher)
    assert launcher.stopped
    assert "a,train,cut off" in (tmp_path / "jobs.csv").read_text()
    assert "b,train,waiting" in (tmp_path / "jobs.csv").read_text()
