"""SIGKILL at any moment: the run goes on, and ends in the bits of one that was never cut off."""

import random
import shutil
import time

import pytest
from tiny_runs import ALWAYS, LS3, PHASES, TINY, Moment, Run, differences, finished, is_finished, kill_myself

from ls3_torchrl.data import load_episodes

BASELINES = {
    "recovery": [*TINY, "algorithm=sacfd", "recovery=true"],
    "awac": [*TINY, "algorithm=awac"],
    "convolutions": [*(a for a in TINY if not a.startswith("vae.")), "algorithm=sacfd", "encoder=conv"],
    "bc": [*TINY, "algorithm=bc"],
}


class Uncut:
    """A run that was not cut off, how long it took, and how often it called what brings files to the disk."""

    def __init__(self, folder, arguments):
        self.folder, self.arguments = folder / "uncut", arguments
        start = time.monotonic()
        run = Run([*arguments, ALWAYS, f"output={self.folder}"], folder / "uncut.log", Moment(None, None))
        assert run.ended() == 0, run.said()
        self.seconds = time.monotonic() - start
        self.calls = int(run.said().split("calls ")[-1].split()[0])


@pytest.fixture(scope="module")
def uncut(tmp_path_factory):
    return Uncut(tmp_path_factory.mktemp("ls3"), LS3)


def kill_by_phase(uncut, folder, phase, chance):
    """Kill a run soon after it has begun a phase."""
    run = Run([*uncut.arguments, ALWAYS, f"output={folder}"], f"{folder}.log", hold=phase).begun()
    while run.phase != phase and run.process.is_alive():
        time.sleep(0.0002)
    time.sleep(0.05 * chance.random() ** 3)
    run.process.kill()
    return run


def kill_by_clock(uncut, folder, _, chance):
    """Kill a run at any time."""
    run = Run([*uncut.arguments, ALWAYS, f"output={folder}"], f"{folder}.log").begun()
    time.sleep(uncut.seconds * chance.random())
    run.process.kill()
    return run


def kill_in_save(uncut, folder, _, chance):
    """Have a run kill itself between two calls of what brings files to the disk."""
    moment = Moment(chance.randint(1, uncut.calls), kill_myself)
    return Run([*uncut.arguments, ALWAYS, f"output={folder}"], f"{folder}.log", moment)


def killed_and_continued(uncut, folder, kill, phase, seed):
    """In what phases a run was killed; it is gone on with until it is finished, and compared."""
    chance, hit = random.Random(seed), []
    for _ in range(chance.randint(1, 3)):
        run = kill(uncut, folder, phase, chance)
        if run.ended() == -9:
            hit.append(run.phase)
        for episodes in sorted(folder.glob("episodes/update_*")):
            load_episodes(episodes)  # whole, or not there
    if not folder.exists() or not is_finished(folder):
        finished(folder, [*uncut.arguments, ALWAYS])
    assert differences(uncut.folder, folder) == []
    shutil.rmtree(folder)
    return hit


def moments(seed, phases, clock, saves):
    chance = random.Random(seed)
    chosen = [(kill_by_phase, phase) for phase in (PHASES if phases is None else chance.sample(PHASES, phases))]
    return [*chosen, *[(kill_by_clock, None)] * clock, *[(kill_in_save, None)] * saves]


def test_a_run_that_was_killed_ends_in_the_same_bits(uncut, tmp_path, soak):
    hit = []
    for seed, (kill, phase) in enumerate(moments(0, *((None, 18, 19) if soak else (2, 1, 2)))):
        where = killed_and_continued(uncut, tmp_path / "run", kill, phase, seed)
        hit += where
        print(f"{kill.__name__} {phase or ''}: killed in {where}, continued to the same bits")
    assert len(hit) >= (50 if soak else 3)
    if soak:
        assert set(hit) >= set(PHASES)


@pytest.mark.parametrize("name", BASELINES)
def test_so_does_a_run_of_the_comparisons(tmp_path, soak, name):
    if name != "recovery" and not soak:
        pytest.skip("part of the long form")
    uncut = Uncut(tmp_path, BASELINES[name])
    for seed, kill in enumerate([kill_in_save, kill_by_clock] * 5 if soak else [kill_in_save]):
        killed_and_continued(uncut, tmp_path / "run", kill, None, seed)


@pytest.mark.parametrize("task", ["reacher", "pushing", "cable_routing"])
def test_so_does_a_run_in_mujoco(tmp_path, soak, task):
    if not soak:
        pytest.skip("part of the long form")
    uncut = Uncut(tmp_path, [*LS3, f"task={task}"])
    for seed, phase in enumerate(["planning", "Safe set", "evaluation"]):
        killed_and_continued(uncut, tmp_path / "run", kill_by_phase, phase, seed)
