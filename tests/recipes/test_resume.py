"""Which folder a run goes on in, what is refused, and what a run's folder is enough for."""

import json
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch

from ls3_recipes import resume, versions
from ls3_recipes.algorithms import ls3
from ls3_recipes.commands.train import main
from ls3_recipes.configuration import settings_of_run, train_settings
from ls3_recipes.decided import decided
from ls3_recipes.experiment import Experiment
from ls3_recipes.options import as_dict
from ls3_recipes.progress import HeldRandomState, Progress, Worlds
from ls3_recipes.protocol import run_experiment
from ls3_recipes.resume import begun_with, open_folder
from ls3_recipes.rollout import collect_demonstrations, make_env
from ls3_recipes.run_files import read_metrics
from ls3_recipes.run_folder import AGENTS, RunFolder
from ls3_torchrl.data import Tag, TaggedReplayBuffer, save_episodes
from ls3_torchrl.planners import LS3Planner

# TorchRL warns about classes of its own while its collectors are imported.
pytestmark = pytest.mark.filterwarnings("ignore:Creating .* which inherits from WeightUpdaterBase:DeprecationWarning")
CPU = torch.device("cpu")
RELIABILITY = Path(__file__).parents[2] / "docs" / "reliability.md"


def settings(*overrides):
    return train_settings("preset=smoke", "device=cpu", "threads=1", "pictures=false", *overrides)


def settled(chosen):
    return decided(chosen, CPU, begun_with(chosen))


def begun(*overrides):
    """A run that was cut off after its folder was made; as another process would find it."""
    folder = open_folder(settled(settings(*overrides)))
    folder.close()
    return folder.path


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


# --- which folder -----------------------------------------------------------------------------------------------


def test_a_run_without_output_gets_a_folder_named_after_it(elsewhere):
    path = begun("seed=3")
    assert path.parent.name == "runs"
    assert path.name.startswith("navigation-smoke-seed3-2")
    assert settings_of_run(path).output == str(path)
    assert begun("algorithm=awac").name.startswith("awac-navigation-smoke-seed0-2")


def test_the_same_command_goes_on_in_the_newest_folder_of_the_same_run(capsys):
    path = begun()
    assert begun() == path
    assert f"Continuing the run in {path}" in capsys.readouterr().out.replace("\n", "")
    other = begun("seed=1")
    assert other != path
    assert begun("seed=1") == other


def test_a_changed_setting_code_or_package_starts_afresh(monkeypatch):
    path = begun()
    assert begun("vae.lr=0.5") != path
    monkeypatch.setattr(versions, "code", lambda: "other")
    assert begun() != path


def test_a_finished_run_is_left_alone_and_a_new_one_begins():
    path = begun()
    (path / "summary.json").write_text("{}")
    assert begun() != path


def test_runs_that_start_in_the_same_second_do_not_collide(monkeypatch):
    class Frozen(resume.datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 1, 2, 3, 4, 5)

    monkeypatch.setattr(resume, "datetime", Frozen)
    folders, failed, gate = [], [], threading.Barrier(6)
    chosen = settled(settings())

    def start():
        try:
            gate.wait()
            folders.append(open_folder(chosen))
        except Exception as error:  # to be looked at in the main thread
            failed.append(error)

    threads = [threading.Thread(target=start) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
    assert len({folder.path for folder in folders}) == 6
    for folder in folders:
        folder.close()


def test_an_output_of_the_same_run_is_gone_on_with():
    assert begun("output=mine") == begun("output=mine")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda path: None, r"holds a run of other settings: seed=0 there, 1 here.*another output=DIR"),
        (lambda path: (path / "config.yaml").unlink(), r"exists already.*output=DIR"),
    ],
)
def test_an_output_of_anything_else_is_refused(change, said):
    change(begun("output=mine"))
    with pytest.raises(FileExistsError, match=said):
        begun("output=mine", "seed=1")


def test_a_finished_output_is_refused():
    path = begun("output=mine")
    (path / "summary.json").write_text("{}")
    with pytest.raises(FileExistsError, match="is finished, and no run overwrites another"):
        begun("output=mine")


@pytest.mark.parametrize("about", [{"torch": "2.0"}, {"format": "ls3_recipes.run", "version": 99}])
def test_a_run_of_another_version_is_refused_with_a_clear_word(about):
    path = begun("output=mine")
    (path / "versions.json").write_text(json.dumps(about))
    with pytest.raises(FileExistsError, match="left by another version of this program"):
        begun("output=mine")


def test_changed_code_is_said_where_a_run_is_gone_on_with_by_name(monkeypatch, capsys):
    begun("output=mine")
    monkeypatch.setattr(versions, "code", lambda: "other")
    begun("output=mine")
    said = capsys.readouterr().out.replace("\n", " ")
    assert "code changed since it began" in said


def test_a_second_process_is_kept_out_and_a_dead_one_is_not(elsewhere):
    script = (
        "import sys; from ls3_recipes.run_folder import RunFolder; folder = RunFolder(sys.argv[1]);"
        "print('open', flush=True); sys.stdin.read()"
    )
    path = begun("output=mine")
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "open\n"
    with pytest.raises(FileExistsError, match=r"Another process is writing to .*mine"):
        begun("output=mine")
    process.kill()
    process.communicate()
    assert begun("output=mine") == path


def test_what_a_killed_process_had_begun_to_write_is_removed():
    path = begun("output=mine")
    (path / "episodes").mkdir()
    (path / "episodes" / ".update_001.0123.partial").mkdir()
    (path / ".summary.json.4567.partial").write_text("half")
    begun("output=mine")
    assert not list(path.rglob("*.partial"))


# --- what was decided when it began -----------------------------------------------------------------------------


def test_what_a_measurement_decides_is_decided_once(monkeypatch):
    fast = {"precision": "bf16"}
    monkeypatch.setattr("ls3_recipes.decided.fastest_precision", lambda _: fast["precision"])
    path = begun("output=mine")
    written = settings_of_run(path)
    assert (written.vae.autocast, written.optim.autocast, written.planner.precision) == (True, True, "bf16")
    fast["precision"] = "fp32"  # under load the timing may come out otherwise
    again = settled(settings("output=mine"))
    assert as_dict(again) == as_dict(written)
    assert begun("output=mine") == path
    assert settled(settings()).planner.precision == "fp32"  # another run


def test_the_number_of_threads_is_kept_for_the_whole_run():
    chosen = train_settings("preset=smoke", "device=cpu", "output=mine")
    torch.set_num_threads(2)
    open_folder(decided(chosen, CPU, begun_with(chosen))).close()
    torch.set_num_threads(1)
    assert decided(chosen, CPU, begun_with(chosen)).threads == 2


def test_what_was_asked_for_by_name_is_not_another_run_s_choice():
    begun("output=mine", "planner.precision=bf16")
    with pytest.raises(FileExistsError, match=r"planner.precision='bf16' there, 'fp32' here"):
        begun("output=mine", "planner.precision=fp32")


# --- by name, on the command line -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["resume=nowhere"], "nowhere holds no run: config.yaml is missing"),
        (
            ["resume=mine", "seed=3"],
            "only data, scratch_dir, checkpoint_minutes, pictures, tracker may be given anew, got seed=3",
        ),
        (["resume=mine", "checkpoint_minutes=often"], "checkpoint_minutes must be a finite number, got 'often'"),
        (["resume="], "resume needs the folder of a run"),
    ],
)
def test_what_cannot_be_resumed_is_refused_in_one_line(arguments, said):
    begun("output=mine")
    with pytest.raises(SystemExit, match=said) as stopped:
        main(arguments)
    assert "\n" not in str(stopped.value)


def test_a_run_is_resumed_by_its_folder(monkeypatch, capsys):
    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    path = begun("output=mine", "online.updates=0")
    main([f"resume={path}"])
    assert (path / "summary.json").is_file()
    main([f"resume={path}"])  # a loop that starts it until it succeeds comes to its end
    assert "is finished: nothing is left to do" in capsys.readouterr().out.replace("\n", " ")


# --- what lies elsewhere now, or is gone ------------------------------------------------------------------------


@pytest.fixture
def episodes(tmp_path):
    """A function that makes a folder of episodes of a seed."""

    def make(name, seed):
        shutil.rmtree(tmp_path / name, ignore_errors=True)
        offline = collect_demonstrations(settings().task, seed)
        return save_episodes(offline, tmp_path / name, task="navigation", seed=seed)

    return make


def test_other_episodes_than_those_it_began_with_are_refused(episodes, tmp_path):
    data = episodes("data", 0)
    begun("output=mine", f"data={data}")
    episodes("data", 1)
    with pytest.raises(FileExistsError, match="began with other episodes than those in data="):
        begun("output=mine", f"data={data}")
    episodes("data", 0)
    begun("output=mine", f"data={data}")
    (tmp_path / "data").rename(tmp_path / "moved")
    begun("output=mine", f"data={tmp_path / 'moved'}")


def test_places_may_be_others_when_a_run_goes_on(monkeypatch, episodes, tmp_path):
    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    data = episodes("data", 0)
    begun("output=mine", "online.updates=0", f"data={data}", f"scratch_dir={tmp_path / 'scratch'}")
    data.rename(tmp_path / "moved")
    with pytest.raises(SystemExit, match="data"):
        main(["resume=mine"])
    main(["resume=mine", f"data={tmp_path / 'moved'}", f"scratch_dir={tmp_path / 'other'}", "checkpoint_minutes=7"])
    assert Path("mine/summary.json").is_file()


def test_a_vae_that_is_gone_is_not_trained_anew_in_its_place(run_folder, tmp_path):
    shutil.copy(run_folder / "agent.pt", tmp_path / "vae.pt")
    begun("output=mine", f"vae.checkpoint={tmp_path / 'vae.pt'}")
    (tmp_path / "vae.pt").unlink()
    with pytest.raises(SystemExit, match=r"vae.checkpoint=.*vae.pt is gone, and was not taken over yet"):
        main(["resume=mine"])


@pytest.mark.parametrize("name", ["br[x]acket", "br[/b]k", "a b ü"])
def test_a_folder_of_any_name_is_named_as_it_is(capsys, name):
    begun(f"output='{name}'")
    begun(f"output='{name}'")
    assert f"Continuing the run in {name}," in capsys.readouterr().out


def test_a_table_of_metrics_that_was_torn_before_the_first_state_is_begun_anew(monkeypatch):
    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    path = begun("output=mine", "online.updates=0")
    with (path / "metrics.csv").open("a") as file:
        file.write("0.1,VAE,0,lo")
    main([f"resume={path}"])
    assert {row["phase"] for row in read_metrics(path)} >= {"VAE", "Goal"}


def test_an_agent_of_another_name_is_left_alone():
    folder = RunFolder.make("run", {})
    (folder.path / "checkpoints").mkdir(exist_ok=True)
    (folder.path / "checkpoints" / "agent_best.pt").write_bytes(b"mine")
    folder.thin_out_agents(300, 0)
    assert (folder.path / "checkpoints" / "agent_best.pt").is_file()
    folder.close()


# --- what is on the disk ----------------------------------------------------------------------------------------


def test_finished_episodes_are_on_the_disk_before_the_next_are_planned(monkeypatch):
    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    plan, counts = LS3Planner.forward, []

    def forward(self, *args, **kwargs):
        counts.append(len(list((experiment[0].folder.path / "episodes").glob("update_*"))))
        return plan(self, *args, **kwargs)

    experiment, collector = [], Experiment._collector

    def begin(self, *args):
        experiment.append(self)
        monkeypatch.setattr(LS3Planner, "forward", forward)
        return collector(self, *args)

    monkeypatch.setattr(Experiment, "_collector", begin)
    run_experiment(settings("output=mine", "online.updates=3"))
    steps = 12
    rounds = counts[
        len(counts) - 4 * steps :
    ]  # three of episodes, and the evaluation; what was called before is a test
    assert [rounds[i * steps] for i in range(4)] == [0, 1, 2, 3]


def test_a_folder_is_enough_to_rebuild_the_buffer(monkeypatch):
    monkeypatch.setattr(ls3, "probe", lambda *_: {})
    held = []
    finish = Experiment.finish
    monkeypatch.setattr(Experiment, "finish", lambda self: [held.append(self.buffer), finish(self)][1])
    run_experiment(settings("output=mine"))
    buffer = TaggedReplayBuffer(35_000, latent_dim=8)
    documented: dict = {}
    block = re.search(r"```python\n(.*?)```", RELIABILITY.read_text(), flags=re.DOTALL)
    exec(compile(block[1], "reliability.md", "exec"), documented)
    documented["refill"](buffer, Path("mine/demonstrations"), Path("mine"))
    own = held[0].transitions.storage[:]
    same = [key for key in own.keys(True, True) if key not in ("loc", "scale", ("next", "loc"), ("next", "scale"))]
    assert (buffer.transitions.storage[:].select(*same) == own.select(*same)).all()
    assert (buffer.frames.storage[:] == held[0].frames.storage[:]).all()
    assert buffer.count(tags=[Tag.ONLINE]) == 2 * 2 * 12


def test_agents_of_a_long_run_are_thinned_out_evenly():
    folder = RunFolder.make("run", {})
    (folder.path / "checkpoints").mkdir(exist_ok=True)
    for update in range(301):
        folder.agent(update).write_bytes(b"")
        folder.thin_out_agents(300, update, 7 if update >= 7 else 0)
    kept = sorted(int(path.stem[-3:]) for path in (folder.path / "checkpoints").glob("agent_*.pt"))
    assert kept == sorted({*range(0, 301, 3), 7})
    assert len(kept) <= AGENTS + 2
    folder.close()


def test_no_agent_of_the_papers_run_is_removed():
    folder = RunFolder.make("run", {})
    (folder.path / "checkpoints").mkdir(exist_ok=True)
    for update in range(26):
        folder.agent(update).write_bytes(b"")
        folder.thin_out_agents(25, update, 0)
    assert len(list((folder.path / "checkpoints").glob("agent_*.pt"))) == 26
    folder.close()


# --- states of its parts ----------------------------------------------------------------------------------------


def test_random_streams_that_were_not_taken_up_yet_are_saved_as_they_were():
    torch.manual_seed(1)
    streams = HeldRandomState()
    state = streams.state_dict()
    expected = torch.rand(3)
    other = HeldRandomState()
    other.load_state_dict(state)
    torch.rand(5)  # what is made before all is taken up
    again = HeldRandomState()
    again.load_state_dict(other.state_dict())
    again.release()
    assert torch.equal(torch.rand(3), expected)
    again.release()  # nothing is held any more
    assert not torch.equal(torch.rand(3), expected)


def test_seconds_of_the_processes_before_are_counted():
    progress = Progress()
    with progress.timed("vae"):
        during = progress.state_dict()
    assert during["seconds"]["vae"] >= 0.0
    other = Progress()
    other.load_state_dict(during | {"seconds": {"vae": 100.0}})
    with other.timed("vae"):
        pass
    assert 100.0 <= other.seconds["vae"] < 160.0


@pytest.mark.parametrize("task", ["navigation", "reacher", "pushing", "cable_routing"])
def test_worlds_begin_their_next_episodes_again(task):
    of_task = settings(f"task={task}").task
    one, other = (make_env(of_task, 2, seed, CPU) for seed in (1, 2))
    one.reset()
    one.rollout(5)
    first = one.reset()
    Worlds(other).load_state_dict(Worlds(one).state_dict())
    again = other.reset()
    assert torch.equal(first["pixels"], again["pixels"])
    assert torch.equal(one.reset()["state"], other.reset()["state"])
