"""A disk that fills up at any moment: a clear error, the state that was saved before is whole, and the run goes on."""

import functools
import random
import shutil

from tiny_runs import ALWAYS, LS3, TINY, Moment, Run, differences, finished

DISK = 96 * 2**20


def fill(folder):
    """Leave no byte free."""
    with (folder / "filler").open("ab", buffering=0) as file:
        size = 2**20
        while size:
            try:
                file.write(b"\0" * size)
            except OSError:
                size //= 2


def test_a_full_disk_is_named_and_the_run_goes_on_when_there_is_room(small_disk, tmp_path, soak):
    disk, chance = small_disk(DISK), random.Random(0)
    counting = Run([*LS3, ALWAYS, f"output={tmp_path / 'uncut'}"], tmp_path / "log", Moment(None, None))
    assert counting.ended() == 0, counting.said()
    calls = int(counting.said().split("calls ")[-1].split()[0])
    for number in range(10 if soak else 1):
        folder, log = disk / "run", tmp_path / f"log{number}"
        moment = Moment(chance.randint(1, calls), functools.partial(fill, disk))
        run = Run([*LS3, ALWAYS, f"output={folder}"], log, moment)
        code = run.ended()
        said = run.said()
        print(f"full in {run.phase}, call {moment.call}: code {code}: {said.strip().splitlines()[-1][:160]}")
        (disk / "filler").unlink(missing_ok=True)
        if code:
            assert code == 1
            assert "No space left on device" in said
            assert "Traceback" not in said
            assert str(disk) in said.replace("\n", "")
            finished(folder, [*LS3, ALWAYS])
        assert differences(tmp_path / "uncut", folder) == []
        shutil.rmtree(folder)


def test_a_disk_without_room_for_a_memory_mapped_buffer_is_named(small_disk, tmp_path):
    disk = small_disk(2 * 2**20)
    scratch = f"scratch_dir={disk / 'scratch'}"
    run = Run([*TINY, scratch, f"output={tmp_path / 'run'}"], tmp_path / "log")
    assert run.ended() == 1  # not by SIGBUS
    assert "No space left on device" in run.said()
    assert str(disk) in run.said().replace("\n", "")
