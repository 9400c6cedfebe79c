"""Imports inside the recipes only go down, and no file or function grows out of sight."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "recipes" / "ls3_recipes"

# What each part may import of the package, besides itself.
LOWEST = {"arguments", "extra", "options", "renamed", "console", "device", "figures", "typed"}
MAY_IMPORT: dict[str, set[str]] = {part: set() for part in LOWEST}
MAY_IMPORT["options"] = {"typed"}
MAY_IMPORT["device"] = {"run_settings"}
MAY_IMPORT["overrides"] = {"options", "renamed", "run_files", "typed"}
MAY_IMPORT["relevance"] = {"arguments", "options", "run_settings", "algorithms"}
MAY_IMPORT["run_settings"] = {"options"}
MAY_IMPORT["decided"] = {"run_settings"}
MAY_IMPORT["command_settings"] = {"options", "run_settings", "typed"}
MAY_IMPORT |= {part: set() for part in ("cpu_time", "run_files")}
MAY_IMPORT["progress"] = {"cpu_time"}
MAY_IMPORT["versions"] = {"device"}
MAY_IMPORT["interrupts"] = {"console"}
MAY_IMPORT["run_state"] = {"interrupts"}
MAY_IMPORT["run_logger"] = {"run_files"}
MAY_IMPORT["run_folder"] = {"run_files", "run_logger", "versions"}
MAY_IMPORT["resume"] = {"console", "options", "run_files", "run_folder", "run_settings", "versions"}
MAY_IMPORT["rollout"] = {"console", "run_settings"}
MAY_IMPORT["offline_data"] = {"console", "rollout", "run_settings", "seeding"}
MAY_IMPORT |= {part: set() for part in ("seeding", "tracker")}
MAY_IMPORT["rollout_files"] = {"run_files"}
MAY_IMPORT["plots"] = {"console", "run_files", "run_settings"}
MAY_IMPORT["algorithms"] = {"figures", "options", "run_settings", "plots"}
MAY_IMPORT["composition"] = {"arguments", "overrides", "run_files"}
MAY_IMPORT["configuration"] = LOWEST | {"composition", "overrides", "relevance"}
MAY_IMPORT["configuration"] |= {"run_files", "run_settings", "algorithms"}
MAY_IMPORT["together"] = {"options", "rollout", "run_files", "run_settings", "tracker"}
MAY_IMPORT["experiment"] = LOWEST | {"together", "run_settings", "rollout", "plots", "algorithms", "seeding", "tracker"}
MAY_IMPORT["experiment"] |= {"decided", "interrupts", "offline_data", "progress", "resume", "run_folder", "run_state"}
MAY_IMPORT["protocol"] = {"console", "experiment", "interrupts", "run_settings"}
MAY_IMPORT["rollouts"] = LOWEST | {"algorithms", "configuration", "rollout", "rollout_files", "seeding"}
MAY_IMPORT["report"] = LOWEST | {"algorithms", "configuration", "plots", "rollout", "run_files", "run_settings"}
MAY_IMPORT["sweep"] = LOWEST | {"command_settings", "configuration", "interrupts", "overrides", "protocol", "report"}
MAY_IMPORT["sweep"] |= {"resume", "rollout_files", "rollouts", "run_files", "run_folder", "run_settings"}
MAY_IMPORT["benchmark"] = LOWEST | {"command_settings", "run_settings", "run_files", "run_folder"}
MAY_IMPORT["benchmark"] |= {"algorithms", "configuration", "plots"}
MAY_IMPORT["collection"] = LOWEST | {"command_settings", "rollout", "run_files"}
MAY_IMPORT["evaluation"] = LOWEST | {"algorithms", "command_settings", "configuration", "plots", "rollout"}
MAY_IMPORT["evaluation"] |= {"run_files", "run_folder", "run_settings"}
MAY_IMPORT["calibration"] = MAY_IMPORT["evaluation"] | {"evaluation"}
MAY_IMPORT["shipped"] = {"arguments"}
MAY_IMPORT["commands"] = set(MAY_IMPORT)
MAY_IMPORT["__main__"] = {"commands"}
MAY_IMPORT["__init__"] = set()


def sources():
    return sorted(PACKAGE.rglob("*.py"))


def part_of(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("ls3_recipes"):
            assert node.level == 0
            parts = node.module.split(".")
            yield from ([parts[1]] if len(parts) > 1 else [alias.name for alias in node.names])


@pytest.mark.parametrize("path", sources(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_only_go_down(path):
    part = part_of(path)
    assert part in MAY_IMPORT, f"{part} is new: say in MAY_IMPORT what it may import"
    assert set(imported(ast.parse(path.read_text()))) - {part} <= MAY_IMPORT[part]


def test_the_table_has_no_circle():
    done: set[str] = set()
    while len(done) < len(MAY_IMPORT):
        ready = {part for part, below in MAY_IMPORT.items() if part not in done and below <= done}
        assert ready, f"a circle among {set(MAY_IMPORT) - done}"
        done |= ready


@pytest.mark.parametrize("path", sources(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_file_is_one_idea_and_a_function_one_thought(path):
    source = path.read_text()
    assert len(source.splitlines()) <= 300
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            assert node.end_lineno - node.lineno < 55, f"{node.name} has {node.end_lineno - node.lineno + 1} lines"


def test_no_setting_of_hydra_travels_below_the_doors():
    for path in sources():
        if part_of(path) not in ("configuration", "composition"):
            assert "DictConfig" not in path.read_text(), path.name
