"""The documents' promises: their Python runs, and their commands name files and settings that exist."""

import re
import runpy
from pathlib import Path

import documents
import pytest
import torch

from ls3_recipes.algorithms import ALGORITHMS
from ls3_recipes.benchmark.suite import BenchmarkSettings
from ls3_recipes.command_settings import SweepSettings
from ls3_recipes.commands.calibrate import CalibrateSettings
from ls3_recipes.commands.collect import CollectSettings
from ls3_recipes.commands.evaluate import EvaluateSettings
from ls3_recipes.commands.report import ReportSettings
from ls3_recipes.commands.sweep import divided
from ls3_recipes.configuration import compose_settings, register, settings_class_of, train_settings
from ls3_recipes.options import as_dict
from ls3_recipes.renamed import REMOVED, RENAMED
from ls3_recipes.shipped import with_shipped_agents
from ls3_recipes.sweep.plan import planned_runs

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
SETTINGS = {
    "calibrate": CalibrateSettings,
    "collect": CollectSettings,
    "evaluate": EvaluateSettings,
    "report": ReportSettings,
    "benchmark": BenchmarkSettings,
}
register("benchmark", BenchmarkSettings)


def test_python_blocks_run_one_after_another(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # they leave files
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len(blocks) >= 2
    namespace: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), namespace)
    assert namespace["robots"]["action"].shape == (4, 2)
    assert all(p.grad is not None for p in namespace["loss"].safe_set_params.values(True, True))


@pytest.mark.parametrize("name", ["comparisons.md", "agents.md"])
def test_the_python_of_the_other_documents_runs_by_itself(name):
    blocks = documents.python_blocks(name)
    assert blocks
    for block in blocks:
        documents.run(name, [block])


def test_the_pipeline_that_goes_on_does_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    refill, pipeline = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "reliability.md").read_text(), flags=re.DOTALL
    )
    exec(compile(refill, "reliability.md", "exec"), {})  # what it does is a test of continued runs
    first: dict = {}
    torch.manual_seed(0)
    exec(compile(pipeline, "reliability.md", "exec"), first)
    assert "going on" not in capsys.readouterr().out
    again: dict = {}
    torch.manual_seed(0)
    exec(compile(pipeline, "reliability.md", "exec"), again)
    assert "going on" in capsys.readouterr().out
    assert again["trainer"].dynamics.steps == 20  # and not 40
    for name, weights in first["agent"].state_dict().items():
        assert torch.equal(weights, again["agent"].state_dict()[name])


def commands():
    """What the documents tell to type: ``ls3 COMMAND …`` and ``python recipes/DOOR.py …``, in blocks of shell."""
    for document in DOCUMENTS:
        for block in re.findall(r"```(?:bash|sh|console)?\n(.*?)```", document.read_text(), flags=re.DOTALL):
            whole = re.sub(r"\\\n\s*", "", block)
            yield from re.findall(r"^(?:\$ )?((?:ls3 |python recipes/)[^\n]*)$", whole, flags=re.MULTILINE)


def test_there_are_commands_to_check():
    assert len(list(commands())) >= 4


@pytest.mark.parametrize("line", sorted(set(commands())))
def test_commands_compose(line):
    words = [word.strip("\"'") for word in line.split("#")[0].split()]
    if words[0] == "python":
        door = ROOT / words[1]
        assert door.is_file()
        name, overrides = door.stem, words[2:]
        command = "train" if name in ALGORITHMS else name
        overrides = [f"algorithm={name}", *overrides] if command == "train" else overrides
    else:
        command, overrides = words[1], words[2:]
    # The files of runs that the reader will have are not there.
    overrides = [re.sub(r"^(vae\.checkpoint)=.*", rf"\1={ROOT / 'README.md'}", override) for override in overrides]
    if [word.partition("=")[0] for word in overrides] == ["resume"]:
        return  # of a run that the reader will have
    if command == "train":
        compose_settings("train", settings_class_of(overrides), overrides)
    elif command == "sweep":
        own, of_runs = divided(overrides)
        sweep = compose_settings(command, SweepSettings, own)
        assert planned_runs(sweep.arms, sweep.settings, of_runs)
    elif command in SETTINGS:
        overrides = with_shipped_agents(command, overrides) if command in ("calibrate", "evaluate") else overrides
        overrides = [word for word in overrides if "=" in word]  # folders of runs that the reader will have
        compose_settings(command, SETTINGS[command], overrides + (["runs=[a]"] if command == "report" else []))
    else:
        assert command in ("gallery", "--help")


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"`?make (\w+)", README):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_settings_that_the_documents_name_exist_and_by_their_present_names(document):
    parts = [as_dict(train_settings(f"algorithm={algorithm}")) for algorithm in ("ls3", "sacfd", "awac")]
    sections = {key for part in parts for key, value in part.items() if isinstance(value, dict)}
    known = {f"{section}.{name}" for part in parts for section in sections & set(part) for name in part[section]}
    known |= {f"agent.{ending}" for ending in ("pt", "py")} | {"evaluation.gif", "evaluation.mp4"}
    known |= set(REMOVED) if document.name == "ablations.md" else set()  # it tells what went, and why
    text = document.read_text()
    named = re.findall(rf"`(?:[^`]* )?((?:{'|'.join(sections)})\.[a-z_]+\b)(?!\()", text)
    missing = set(named) - known
    assert not missing
    assert not [old for old in RENAMED if re.search(rf"(?<![\w.]){re.escape(old)}(?![\w.])", text)]


def test_files_that_the_documents_link_to_exist():
    for document in DOCUMENTS:
        for link in re.findall(r"\]\((?!http)([^)#]+)\)", document.read_text()):
            assert (document.parent / link).exists(), f"{document.name}: {link}"


def test_the_description_for_package_indexes_has_no_relative_link(monkeypatch):
    made: dict = {}
    monkeypatch.setattr("setuptools.setup", lambda **options: made.update(options))
    runpy.run_path(str(ROOT / "setup.py"))
    described = made["long_description"]
    assert made["long_description_content_type"] == "text/markdown"
    assert described.count("](") == README.count("](")
    assert not re.findall(r"\]\((?!https?:|#)", described)
    for picture in re.findall(r"!\[[^\]]*\]\(([^)]*)\)", described):
        assert picture.startswith("https://raw.githubusercontent.com/")
