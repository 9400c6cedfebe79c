"""Library and environments stay strangers, and imports inside the library only go down."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LIBRARY, ENVIRONMENTS = ROOT / "ls3_torchrl", ROOT / "envs" / "ls3_envs"
RECIPES = {"ls3_recipes"} | {path.stem for path in (ROOT / "recipes").glob("*.py")}

# What each part of the library may import of it, besides itself.
MAY_IMPORT = {
    "_memory": set(),
    "_values": set(),
    "exceptions": set(),
    "options": {"_values"},
    "_checks": {"_values", "exceptions"},
    "modules": {"_checks"},
    "objectives": {"_checks", "layers", "modules"},
    "layers": {"_checks", "modules"},
    "planners": {"_checks", "_memory", "_values", "layers", "modules", "options"},
    "data": {"_checks", "exceptions", "files", "halves", "modules", "options"},
    "baselines": {"_checks", "modules", "objectives"},
    "files": set(),
    "halves": {"_memory"},
    "agent": {"_checks", "files", "modules", "options", "planners"},
    "deployment": {"_checks", "agent", "data", "modules", "options"},
    "trainers": {
        "_checks",
        "_memory",
        "agent",
        "data",
        "exceptions",
        "files",
        "halves",
        "layers",
        "modules",
        "objectives",
        "options",
    },
    "__init__": {"agent"},
}


def imported(source: str, package: str) -> set[str]:
    """Absolute names of all modules that ``source``, a module in ``package``, imports, wherever it does."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = ".".join(
                    [*package.split(".")[: len(package.split(".")) - node.level + 1], *filter(None, [base])]
                )
            # "from package import part" may import a submodule as well as a name.
            names |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    return names


def files_of(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.py"))


def package_of(path: Path, root: Path) -> str:
    return ".".join(path.relative_to(root).parent.parts)


def part_of(path: Path) -> str:
    """The part of the library that a file belongs to: its subpackage, or its own name."""
    first = path.relative_to(LIBRARY).parts[0]
    return first.removesuffix(".py")


def forbidden(source: str, part: str, package: str) -> set[str]:
    """What a file of ``part`` imports of the library although it must not."""
    parts = set()
    for name in imported(source, package):
        if name.startswith("ls3_torchrl."):
            other = name.split(".")[1]
            # "from ls3_torchrl import LS3Agent" names no part: it is the agent by the front door.
            parts.add(other if other in MAY_IMPORT else "agent")
    return parts - MAY_IMPORT[part] - {part}


def test_there_is_something_to_check():
    assert len(files_of(LIBRARY)) > 15
    assert len(files_of(ENVIRONMENTS)) > 3


@pytest.mark.parametrize("path", files_of(LIBRARY), ids=lambda p: str(p.relative_to(ROOT)))
def test_the_library_knows_no_environment_and_no_recipe(path):
    roots = {name.split(".")[0] for name in imported(path.read_text(), package_of(path, ROOT))}
    assert not roots & ({"ls3_envs", "recipes"} | RECIPES)


@pytest.mark.parametrize("path", files_of(ENVIRONMENTS), ids=lambda p: str(p.relative_to(ROOT)))
def test_the_environments_know_no_library_and_no_recipe(path):
    roots = {name.split(".")[0] for name in imported(path.read_text(), package_of(path, ROOT / "envs"))}
    assert not roots & ({"ls3_torchrl", "recipes"} | RECIPES)


@pytest.mark.parametrize("path", files_of(LIBRARY), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_inside_the_library_only_go_down(path):
    part = part_of(path)
    assert part in MAY_IMPORT, f"{part} is new: say in MAY_IMPORT what it may import"
    assert forbidden(path.read_text(), part, package_of(path, ROOT)) == set()


def test_the_table_has_no_circle():
    done: set[str] = set()
    while len(done) < len(MAY_IMPORT):
        ready = {part for part, below in MAY_IMPORT.items() if part not in done and below <= done}
        assert ready, f"a circle among {set(MAY_IMPORT) - done}"
        done |= ready


@pytest.mark.parametrize(
    ("source", "part", "expected"),
    [
        ("import ls3_torchrl.agent", "planners", {"agent"}),
        ("from ls3_torchrl import LS3Agent", "data", {"agent"}),
        ("from ls3_torchrl import planners", "modules", {"planners"}),
        ("def f():\n    from ls3_torchrl.objectives import vae", "data", {"objectives"}),
        ("from ..planners.cem import CEMResult", "modules", {"planners"}),
        ("from .. import agent", "objectives", {"agent"}),
        ("from . import tags\nfrom .labels import in_success", "data", set()),
        ("from ls3_torchrl.modules.vae import PixelEncoder\nimport torch", "data", set()),
    ],
)
def test_the_check_itself_finds_what_it_should(source, part, expected):
    assert forbidden(source, part, f"ls3_torchrl.{part}") == expected


def test_no_two_test_files_have_one_name():
    # pytest imports them by their names alone.
    names = [path.name for path in (ROOT / "tests").rglob("*.py") if path.name != "conftest.py"]
    assert sorted(names) == sorted(set(names))
