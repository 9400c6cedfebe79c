"""The document on filter and calibration does what it says: its Python runs as it stands."""

import documents


def test_the_document_on_safety_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = documents.run("safety.md")
    assert "intervention_rate" in capsys.readouterr().out
    assert names["seen"]["filter", "intervened"].shape == (4, 1)
    assert names["found"].violations == 19
    assert 0.0 < names["planner"].constraint_threshold <= 0.2
