"""The README's promises: its Python runs, and its commands name files and settings that exist."""

import re
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_python_blocks_run_one_after_another():
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len(blocks) >= 2
    namespace: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), namespace)
    assert namespace["robots"]["action"].shape == (4, 2)
    assert all(p.grad is not None for p in namespace["loss"].safe_set_params.values(True, True))


def test_the_python_of_the_other_documents_runs_by_itself():
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "comparisons.md").read_text(), flags=re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "comparisons.md", "exec"), {})


@pytest.mark.parametrize("line", re.findall(r"^python recipes/.*$", README, flags=re.MULTILINE))
def test_commands_compose(line):
    _, script, *overrides = line.split("#")[0].split()
    assert (ROOT / script).is_file()
    with initialize_config_dir(str(ROOT / "recipes" / "conf"), version_base="1.3"):
        compose(Path(script).stem, overrides)


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"make (\w+)", README):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


@pytest.mark.parametrize("name", ["docs/deviations.md", "docs/learning.md", "README.md"])
def test_settings_that_the_documents_name_exist(name):
    with initialize_config_dir(str(ROOT / "recipes" / "conf"), version_base="1.3"):
        config = compose("ls3", [])
    groups = "agent|vae|offline|online|optim|loss|planner|evaluation"
    named = re.findall(rf"`(?:[^`]* )?((?:{groups})\.[a-z_]+)", (ROOT / name).read_text())
    named = [key for key in named if key.split(".")[1] not in ("pt", "py", "gif")]
    missing = {key for key in named if OmegaConf.select(config, key, default=...) is ...}
    assert not missing


def test_files_that_the_documents_link_to_exist():
    documents = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
    for document in documents:
        for link in re.findall(r"\]\((?!http)([^)#]+)\)", document.read_text()):
            assert (document.parent / link).exists(), f"{document.name}: {link}"
