"""Mistakes that people make, and the one line that each gets before anything is made or trained."""

import sys

import pytest
import torch

from ls3_recipes import collection, offline_data
from ls3_recipes.benchmark import suite
from ls3_recipes.commands import main
from ls3_recipes.experiment import Experiment
from ls3_recipes.shipped import quoted, shipped_agents

SHIPPED = shipped_agents()["navigation"]
TRAIN = ("train", "preset=smoke")
#: Arguments, and what the line says beside the command's name.
MISTAKES = {
    "types": [
        ((*TRAIN, "seed=abc"), "seed must be a whole number, got 'abc'."),
        ((*TRAIN, "seed="), "seed must be a whole number, got ''."),
        ((*TRAIN, "seed=1.5"), "seed must be a whole number, got 1.5."),
        ((*TRAIN, "seed=true"), "seed must be a whole number, got True."),
        ((*TRAIN, "seed=null"), "seed must be a whole number, got None."),
        ((*TRAIN, "seed=[1]"), "seed must be a whole number, got [1]."),
        ((*TRAIN, "vae.lr=fast"), "vae.lr must be a finite number, got 'fast'."),
        ((*TRAIN, "vae.lr='1e-3'"), "vae.lr must be a finite number, got '1e-3'."),
        ((*TRAIN, "online.updates=ten"), "online.updates must be a whole number, got 'ten'."),
        ((*TRAIN, "offline.dynamics_steps=1.5"), "offline.dynamics_steps must be a whole number, got 1.5."),
        ((*TRAIN, "pictures=maybe"), "pictures must be true or false, got 'maybe'."),
        ((*TRAIN, "pictures=1"), "pictures must be true or false, got 1."),
        ((*TRAIN, "loss.zero_at_goal=sometimes"), "loss.zero_at_goal must be true or false"),
        ((*TRAIN, "agent.value_hidden=16"), "agent.value_hidden must be a list of whole numbers, got 16."),
        (
            (*TRAIN, "agent.value_hidden=[16,big]"),
            "agent.value_hidden must be a list of whole numbers, got [16, 'big'].",
        ),
        ((*TRAIN, "vae.warmup=[0.5]"), "vae.warmup must be a list of 2 finite numbers, or null, got [0.5]."),
        ((*TRAIN, "loss.mean_latents=goal"), "loss.mean_latents must be a list of texts, got 'goal'."),
        ((*TRAIN, "output=2024"), "output must be text, or null, got 2024. Put it in quotes"),
        ((*TRAIN, "data=[a,b]"), "data must be text, or null, got ['a', 'b']."),
        ((*TRAIN, "online=3"), "online is a section, got 3: set online.KEY=VALUE."),
        ((*TRAIN, "online=null"), "online is a section, got null: set online.KEY=VALUE."),
        (("evaluate", "run=x", "episodes=few"), "episodes must be a whole number, got 'few'."),
        (
            ("evaluate", "run=x", "planner.horizon=long"),
            "planner.horizon must be a whole number, or 'as trained', got 'long'.",
        ),
        (("report", "runs=[1,2]"), "runs must be a list of texts, or text, got [1, 2]."),
        (("benchmark", "batches=8"), "batches must be a list of whole numbers, got 8."),
        (("benchmark", "smoke=perhaps"), "smoke must be true or false, got 'perhaps'."),
        (("collect", "seed=first"), "seed must be a whole number, got 'first'."),
    ],
    "ranges": [
        ((*TRAIN, "evaluation.episodes=0"), "evaluation.episodes must be at least 1, got 0."),
        ((*TRAIN, "seed=-1"), "seed must lie between 0 and "),
        ((*TRAIN, "seed=1000000000000000000000"), "seed must lie within 64 bits"),
        ((*TRAIN, "threads=0"), "threads must be at least 1, or null"),
        ((*TRAIN, "threads=-2"), "threads must be at least 1, or null"),
        ((*TRAIN, "online.dynamics_steps=-3"), "online.dynamics_steps must be at least 0, got -3."),
        ((*TRAIN, "planner.noise_scale=nan"), "planner.noise_scale must be a finite number, got nan."),
        ((*TRAIN, "planner.noise_scale=-inf"), "planner.noise_scale must be a finite number, got -inf."),
        ((*TRAIN, "vae.lr=inf"), "vae.lr must be a finite number, got inf."),
        ((*TRAIN, "loss.timed_out_weight=nan"), "loss.timed_out_weight must be a finite number, got nan."),
        ((*TRAIN, "agent.action_scale=0"), "agent.action_scale must be a finite number above 0, got 0.0."),
        ((*TRAIN, "agent.value_hidden=[0]"), "agent.value_hidden must be at least 1, got 0."),
        ((*TRAIN, "buffer.gamma=1.5"), "buffer.gamma must lie in [0, 1], got 1.5."),
        ((*TRAIN, "planner.relaxation=1"), "planner.relaxation must lie strictly between 0 and 1"),
        ((*TRAIN, "planner.num_elites=99"), "planner.num_elites must lie between 1 and num_candidates = 20, got 99."),
        ((*TRAIN, "algorithm=sacfd", "policy.tau=7"), "policy.tau must lie in [0, 1], got 7.0."),
        ((*TRAIN, "algorithm=sacfd", "recovery=perhaps"), "recovery must be true or false, got 'perhaps'."),
        (("evaluate", "run=x", "episodes=0"), "episodes must be at least 1, got 0."),
        (("benchmark", "seconds=nan"), "seconds must be a finite number, got nan."),
        (("benchmark", "threads=0"), "threads must be at least 1, or null"),
        (("benchmark", "batches=[0]"), "batches must be at least 1, got 0."),
        (("benchmark", "batches=[]"), "batches must name at least one"),
        (("benchmark", "task=moon"), "task must be one of 'navigation'"),
        (("collect", "task.offline_episodes=0"), "task.offline_episodes must be at least 1, got 0."),
        (("collect", "task.horizon=7"), "task.horizon matters to ls3 train alone, got 7"),
    ],
    "together": [
        ((*TRAIN, "loss.dynamics_horizon=500"), "loss.dynamics_horizon must not exceed the 12 steps of an episode"),
        ((*TRAIN, "planner.horizon=13"), "planner.horizon must not exceed the 12 steps of an episode, got 13."),
        (
            (*TRAIN, "vae.prediction_weight=1", "vae.prediction_horizon=13"),
            "vae.prediction_horizon must not exceed the 12 steps of an episode, got 13.",
        ),
        ((*TRAIN, "buffer.capacity=100"), "buffer.capacity must be at least 624, the transitions of the offline data"),
        (
            (*TRAIN, "buffer.capacity=20", "buffer.success_tail=1"),
            "buffer.capacity must be at least 24, the transitions of the offline data and of the episodes",
        ),
        ((*TRAIN, "agent.action_scale=[1,2,3]"), "agent.action_scale must be one positive number or one for each of 2"),
    ],
    "names": [
        ((*TRAIN, "planner.horizn=3"), "planner has no setting horizn: did you mean planner.horizon?"),
        ((*TRAIN, "+planner.horizn=3"), "planner has no setting horizn: did you mean planner.horizon?"),
        ((*TRAIN, "+planner.foo=1"), "planner has no setting foo. It has: horizon, "),
        ((*TRAIN, "sed=1"), "The run has no setting sed: did you mean seed?"),
        ((*TRAIN, "updates=3"), "The run has no setting updates: did you mean online.updates?"),
        ((*TRAIN, "planer.horizon=3"), "The run has no setting planer.horizon: did you mean "),
        ((*TRAIN, "seed.value=3"), "seed is one setting, not a section"),
        ((*TRAIN, "Seed=1"), "The run has no setting Seed: did you mean seed?"),
        (("train", "task=nope"), "task must be one of cable_routing, navigation, pushing, reacher; got 'nope'."),
        (("train", "task=navigtion"), "got 'navigtion': did you mean navigation?"),
        (("train", "preset=nope"), "preset must be one of cpu, paper, smoke; got 'nope'."),
        (("train", "algorithm=nope"), "algorithm must be one of ls3, sacfd, awac, bc; got 'nope'."),
        (("train", "algorithm=sacfdd"), "got 'sacfdd': did you mean sacfd?"),
        ((*TRAIN, "tuned=foo"), "tuned must be one of cable_routing-cpu, "),
        ((*TRAIN, "task={horizon:3}"), "task is chosen by name, got {'horizon': 3}"),
        (("collect", "task=nope"), "task must be one of cable_routing"),
        (("collect", "preset=smoke"), "ls3 collect has no preset."),
        (("evaluate", "episods=3"), "The run has no setting episods: did you mean episodes?"),
        (("evaluate", "task=reacher"), "ls3 evaluate has no task."),
        (("report", "run=[a]"), "The run has no setting run: did you mean runs?"),
        (("benchmark", "preset=cpu"), "ls3 benchmark has no preset."),
        (("benchmark", "presets=[nope]"), "preset must be one of cpu, paper, smoke; got 'nope'."),
        (("benchmark", "domains=[moon]"), "domains must be one of "),
    ],
    "syntax": [
        ((*TRAIN, "seed==3"), "seed==3: the value of seed cannot be read. Close brackets and quotes"),
        ((*TRAIN, "planner.delta=["), "planner.delta=[: the value of planner.delta cannot be read."),
        ((*TRAIN, "output='half"), "output='half: the value of output cannot be read."),
        ((*TRAIN, "output=a(b)"), "output=a(b): the value of output cannot be read."),
        ((*TRAIN, "output=läufe"), "output=läufe: the value of output cannot be read."),
        ((*TRAIN, "seed"), "'seed' is no setting: write KEY=VALUE, such as seed=VALUE."),
        ((*TRAIN, "=3"), "'=3' is no setting: write KEY=VALUE."),
        ((*TRAIN, "seed=1", "seed=2"), "seed is given twice: seed=1 and seed=2. Leave one out."),
        ((*TRAIN, "vae.agent=a.pt", "vae.checkpoint=b.pt"), "vae.checkpoint is given twice"),
        ((*TRAIN, "seed=1,2"), "seed=1,2: one run has one value of seed."),
        ((*TRAIN, "output=${nowhere}"), "These settings make no configuration: Interpolation key 'nowhere' not found"),
        ((*TRAIN, "~planner.horizn"), "planner has no setting horizn"),
    ],
    "files": [
        ((*TRAIN, "output=''"), "output must be the path of a file or folder, got ''."),
        ((*TRAIN, "output=a_file"), "The output folder a_file exists already"),
        ((*TRAIN, "output=a_file/run"), "output=a_file/run cannot be made: "),
        ((*TRAIN, "output=" + 300 * "x"), "the name is too long"),
        ((*TRAIN, "scratch_dir=a_file"), "a_file is no folder that can be written to."),
        ((*TRAIN, "scratch_dir=''"), "scratch_dir must be the path of a file or folder, got ''."),
        ((*TRAIN, "data=nowhere"), "nowhere holds no episodes"),
        ((*TRAIN, "data=a_file"), "a_file"),
        ((*TRAIN, "vae.checkpoint=nowhere.pt"), "vae.checkpoint must be null or the file of a trained agent"),
        ((*TRAIN, "vae.checkpoint=a_file"), "vae.checkpoint: a_file "),
        (
            ("train", f"vae.checkpoint={quoted(SHIPPED / 'agent.pt')}"),
            f"vae.checkpoint: {SHIPPED / 'agent.pt'} is a compact file, whose agent has no decoder, ",
        ),
        (("evaluate",), "run must be given: it has no default."),
        (("evaluate", "run=nowhere"), "nowhere holds no run: config.yaml is missing."),
        (("evaluate", "run=a_file"), "a_file holds no run: config.yaml is missing."),
        (("report",), "No runs: pass their folders"),
        (("report", "runs=[nowhere]"), "nowhere holds no run: there is no config.yaml in it, nor anywhere below."),
        (("collect", "output=a_file/data"), "output=a_file/data cannot be made: "),
        (
            ("benchmark", "agent=nowhere.pt"),
            "nowhere.pt is not an agent file (ls3_torchrl.agent): there is no such file. Check the path.",
        ),
        (("benchmark", "output=a_file/b"), "output=a_file/b cannot be made: "),
        (
            ("train", "--config-dir", "nowhere"),
            "--config-dir must name a folder with YAML files; there is none at 'nowhere'",
        ),
        (("gallery", "a_file/x.png"), "FILE=a_file/x.png cannot be made: "),
        (("gallery", "picture.docx"), "FILE must end in one of ."),
    ],
    "devices": [
        ((*TRAIN, "device=cud"), "device must be auto, cpu, cuda or cuda:N, got 'cud'."),
        ((*TRAIN, "device=gpu"), "device must be auto, cpu, cuda or cuda:N, got 'gpu'."),
        ((*TRAIN, "device=''"), "device must be auto, cpu, cuda or cuda:N, got ''."),
        (("benchmark", "device=tpu"), "device must be auto, cpu, cuda or cuda:N, got 'tpu'."),
    ],
}


@pytest.fixture
def at_the_door(tmp_path, monkeypatch):
    """A folder with nothing but one file, in which no work may begin."""

    def work(*args, **kwargs):
        pytest.fail("the work began")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ls3"])
    monkeypatch.setattr(Experiment, "start", work)
    monkeypatch.setattr(offline_data, "collect_demonstrations", work)
    monkeypatch.setattr(collection, "collect_demonstrations", work)
    monkeypatch.setattr(suite, "matmul_peak", work)
    (tmp_path / "a_file").write_text("precious")
    return tmp_path


def refusal(arguments):
    """The line that a command ends with."""
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert isinstance(stopped.value.code, str), "the code is not 1, or there is no line"
    return stopped.value.code


@pytest.mark.parametrize(
    ("arguments", "message"),
    [pytest.param(*row, id=f"{kind}: {' '.join(row[0])[:60]}") for kind, rows in MISTAKES.items() for row in rows],
)
def test_a_mistake_gets_one_line_and_leaves_nothing(at_the_door, arguments, message):
    line = refusal(arguments)
    assert line.startswith(f"ls3 {arguments[0]}: ")
    assert message in line
    assert "\n" not in line
    assert len(line) < 700
    assert [path.name for path in at_the_door.iterdir()] == ["a_file"]
    assert (at_the_door / "a_file").read_text() == "precious"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device to choose")
@pytest.mark.parametrize("device", ["cuda", "cuda:1"])
@pytest.mark.parametrize("command", [TRAIN, ("benchmark",)])
def test_a_device_that_is_not_there_is_refused(at_the_door, command, device):
    assert f"device={device} was asked for, but PyTorch sees no CUDA" in refusal([*command, f"device={device}"])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"vae: [1, 2\n", "mine.yaml is no YAML: "),
        (b"vae:\n\tsteps: 3\n", "mine.yaml is no YAML: "),
        (b"# @package _global_\npreset: mine\n# \xe4\n", "mine.yaml is damaged: it is no text in UTF-8"),
        (
            b"# @package _global_\npreset: mine\nvae: {stepps: 3}\n",
            "vae has no setting stepps: did you mean vae.steps?",
        ),
        (b"# @package _global_\npreset: mine\nvae: {steps: many}\n", "vae.steps must be a whole number, got 'many'."),
        (b"# @package _global_\npreset: mine\nvae:\n", "vae is a section, got null: set vae.KEY=VALUE."),
        (b"# @package _global_\npreset: mine\nplaner: {horizon: 3}\n", "The run has no setting planer"),
        (b"- 1\n- 2\n", "mine.yaml must begin with the line '# @package _global_'."),
        (b"# @package _global_\n- 1\n- 2\n", "In 'preset/mine': "),
    ],
)
def test_what_is_wrong_in_a_users_file_is_named(at_the_door, content, said):
    (at_the_door / "cd" / "preset").mkdir(parents=True)
    (at_the_door / "cd" / "preset" / "mine.yaml").write_bytes(content)
    line = refusal(["train", "--config-dir", "cd", "preset=mine"])
    assert said in line
    assert "\n" not in line
    assert sorted(path.name for path in at_the_door.iterdir()) == ["a_file", "cd"]


def test_without_opencv_what_needs_it_is_refused_and_the_rest_runs(at_the_door, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    line = refusal([*TRAIN, "vae.enlarge_to=1000"])
    assert "vae.enlarge_to needs OpenCV, which cannot be imported" in line
    assert "vae.enlarge_to=null" in line
    with pytest.raises(pytest.fail.Exception, match="the work began"):
        main([*TRAIN, "device=cpu"])


def test_a_folder_that_cannot_be_written_to_is_refused(at_the_door, monkeypatch):
    monkeypatch.setattr("ls3_recipes.run_files.os.access", lambda *_: False)
    for arguments in (TRAIN, ("collect",), ("benchmark",)):
        line = refusal([*arguments, "output=new/run"])
        assert f"output=new/run cannot be made: {at_the_door} cannot be written to." in line
    assert "x.png cannot be made" in refusal(["gallery", "new/x.png"])


def test_ctrl_c_ends_with_the_shells_code_and_one_line(at_the_door, monkeypatch, capsys):
    def interrupt(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(Experiment, "start", interrupt)
    with pytest.raises(SystemExit) as stopped:
        main([*TRAIN, "device=cpu"])
    assert stopped.value.code == 130
    assert capsys.readouterr().err.splitlines()[-1] == "ls3 train: stopped by Ctrl-C."
