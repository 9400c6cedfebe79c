"""The documentation site: nothing public is left out, and its quick start runs. `make docs` builds it."""

import re
from pathlib import Path

import documents
import pytest
from torchrl.data import Bounded

from ls3_envs.registry import lazy_classes
from ls3_recipes.shipped import shipped_agents
from ls3_torchrl import LS3Agent

ROOT = Path(__file__).parents[1]
REFERENCE = (documents.FOLDER / "api" / "index.rst").read_text(encoding="utf-8")
PACKAGES = [
    package.relative_to(root).parent
    for root in (ROOT, ROOT / "envs")
    for name in ("ls3_torchrl", "ls3_envs")
    for package in sorted((root / name).rglob("__init__.py"))
    if "__all__" in package.read_text(encoding="utf-8")
]


def test_the_reference_has_every_package_that_says_what_is_public():
    listed = re.findall(r"^   (ls3_\S+)$", REFERENCE, flags=re.MULTILINE)
    assert len(PACKAGES) >= 10
    assert {".".join(package.parts) for package in PACKAGES} <= set(listed)


def test_the_reference_has_every_group_of_options():
    for file in sorted((ROOT / "ls3_torchrl" / "options").glob("*.py")):
        for name in re.findall(r"^class (\w+Options|AgentArchitecture)\b", file.read_text(encoding="utf-8"), re.M):
            module = f"ls3_torchrl.options.{file.stem}.{name}"
            assert module in REFERENCE or name in (ROOT / "ls3_torchrl/trainers/__init__.py").read_text(), module


def test_every_page_can_be_reached():
    index = (documents.FOLDER / "index.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"<([\w/]+)>$", index, flags=re.MULTILINE))
    pages = {str(page.relative_to(documents.FOLDER).with_suffix("")) for page in documents.FOLDER.rglob("*.md")}
    assert pages - {"index"} == listed - {"api/index"}


def test_the_reference_has_every_environment_and_demonstrator():
    classes = lazy_classes()
    assert len(classes) >= 14
    assert [name for name in classes if f"   ls3_envs.{name}\n" not in REFERENCE] == []


def test_every_agents_card_is_a_page():
    assert len(shipped_agents()) >= 3
    for name in shipped_agents():
        page = (documents.FOLDER / "agents" / f"{name}.md").read_text(encoding="utf-8")
        assert f"recipes/ls3_recipes/agents/{name}/card.md" in page


@pytest.mark.slow
def test_the_quick_start_runs_with_an_agent_at_its_place(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs/navigation").mkdir(parents=True)
    spec = Bounded(low=-3.0, high=3.0, shape=(2,))
    LS3Agent(action_spec=spec, latent_dim=8).save("runs/navigation/agent.pt")  # untrained: it only has to act
    short = [block.replace("rollout(100,", "rollout(3,") for block in documents.python_blocks("quick_start.md")]
    assert "rollout(3," in short[0]
    names = documents.run("quick_start.md", short)
    assert names["episodes"].batch_size == (4, 3)
    assert "violations: 0" in capsys.readouterr().out
