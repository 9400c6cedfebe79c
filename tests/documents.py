"""Runs the Python that a document shows."""

import re
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "docs"


def python_blocks(name):
    """The code of each Python block of ``docs/<name>``."""
    text = (FOLDER / name).read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)


def run(name, blocks=None, names=None):
    """Run all blocks of ``docs/<name>``, or these, behind one another; returns the names that they leave."""
    names = {} if names is None else names
    for block in python_blocks(name) if blocks is None else blocks:
        exec(compile(block, name, "exec"), names)
    return names
