"""The document on filter and calibration does what it says: its Python runs as it stands."""

import re
from pathlib import Path

DOCUMENT = Path(__file__).parents[1] / "docs" / "safety.md"
BLOCKS = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_the_document_on_safety_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in BLOCKS:
        exec(compile(block, DOCUMENT.name, "exec"), names)
    assert "intervention_rate" in capsys.readouterr().out
    assert names["seen"]["filter", "intervened"].shape == (4, 1)
    assert names["found"].violations == 19
    assert 0.0 < names["planner"].constraint_threshold <= 0.2
