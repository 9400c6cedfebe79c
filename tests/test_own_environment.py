"""The document on own environments does what it says: its Python runs as it stands, and the agent learns."""

import re

import documents
import pytest

BLOCKS = documents.python_blocks("own_environment.md")


@pytest.mark.slow
def test_an_agent_learns_on_an_environment_that_this_project_does_not_own(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    training, *others = BLOCKS
    names = documents.run("own_environment.md", [training])
    episodes = [line for line in capsys.readouterr().out.splitlines() if " steps, violation: " in line]
    lengths = [int(line.split()[0]) for line in episodes]
    demonstrated = names["buffer"].transitions.storage[:]
    first = demonstrated["steps_left"][demonstrated["tag"] == 0]
    assert len(lengths) == 6
    # Every episode reaches the top, sooner than the demonstrations that violated nothing, and none goes too far back.
    assert sum(lengths[-3:]) / 3 < 0.9 * mean_length(first)
    assert not any("violation: True" in line for line in episodes)
    documents.run("own_environment.md", others, names)
    assert names["again"].horizon == 12
    assert len(names["buffer"]) == len(demonstrated) + 2 * names["steps"]
    assert names["robot"].foreign == ("encoder",)


def mean_length(steps_left):
    """Mean length of the episodes whose rows, one after another, say how many steps they have left."""
    before = [0, *steps_left[:-1].tolist()]
    lengths = [left for last, left in zip(before, steps_left.tolist(), strict=True) if left > last]
    return sum(lengths) / len(lengths)


def test_training_takes_forty_lines_of_public_names():
    code = [line for line in BLOCKS[0].splitlines() if line.strip() and not line.strip().startswith("#")]
    own = [line for line in code if not line.startswith(("import ", "from "))]
    assert len(own) <= 45
    assert not re.search(r"\._\w", BLOCKS[0])
