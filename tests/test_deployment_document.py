"""The document on deployment does what it says: its Python runs as it stands."""

import re
from pathlib import Path

DOCUMENT = Path(__file__).parents[1] / "docs" / "deployment.md"
BLOCKS = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_the_document_on_deployment_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in BLOCKS:
        exec(compile(block, DOCUMENT.name, "exec"), names)
    assert len(names["milliseconds"]) == 20
    assert "median" in capsys.readouterr().out
    assert sorted(path.suffix for path in (tmp_path / "exported").iterdir()) == [".json"] + 6 * [".pt2"]
