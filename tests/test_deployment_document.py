"""The document on deployment does what it says: its Python runs as it stands."""

import documents


def test_the_document_on_deployment_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = documents.run("deployment.md")
    assert len(names["milliseconds"]) == 20
    told = capsys.readouterr().out
    assert "median" in told
    assert "f_C" in told
    assert sorted(path.suffix for path in (tmp_path / "exported").iterdir()) == [".json"] + 6 * [".pt2"]
