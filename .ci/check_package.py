"""What is checked of wheel, sdist and installed package: ``check_package.py archives DIST``, ``bare`` or ``readme``."""

import importlib.util
import re
import sys
import tarfile
import zipfile
from pathlib import Path

NEEDED = (
    "ls3_torchrl/__init__.py",
    "ls3_torchrl/py.typed",
    "ls3_torchrl/trainers/__init__.py",
    "ls3_envs/__init__.py",
    "ls3_envs/py.typed",
    "ls3_recipes/commands/train.py",
    "ls3_recipes/conf/train.yaml",
    "ls3_recipes/conf/algorithm/ls3.yaml",
    "ls3_recipes/conf/preset/cpu.yaml",
    "ls3_recipes/conf/task/navigation.yaml",
    "ls3_recipes/conf/tuned/pushing-cpu.yaml",
    "ls3_recipes/conf/comparison/sacfd-cpu.yaml",
    "ls3_recipes/conf/sweep/figure1.yaml",
    "ls3_recipes/conf/hydra/launcher/ray.yaml",
    "ls3_recipes/agents/navigation/agent.pt",
    "ls3_recipes/report/page.html.j2",
    "ls3_recipes/py.typed",
)
EXTRAS = ("hydra", "omegaconf", "gymnasium", "mujoco", "mujoco_warp", "cv2", "matplotlib", "PIL", "rich", "tensorboard")
EXTRAS += ("av", "scipy", "minari", "pyarrow", "h5py")


def check_archives(folder: Path) -> None:
    """Both hold all packages with their data, no tests; no link of the description is relative."""
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
        names = wheel.namelist()
        metadata = wheel.read(next(name for name in names if name.endswith(".dist-info/METADATA"))).decode()
    with tarfile.open(next(folder.glob("*.tar.gz"))) as sdist:
        sources = sdist.getnames()
    for needed in NEEDED:
        assert needed in names, f"the wheel lacks {needed}"
        assert any(name.endswith(f"/{needed}") for name in sources), f"the sdist lacks {needed}"
    strangers = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert strangers == {"ls3_torchrl", "ls3_envs", "ls3_recipes"}, f"the wheel holds {strangers}"
    relative = re.findall(r"\]\((?!https?:|#)[^)]*\)", metadata)
    assert not relative, f"relative links in the description: {relative}"
    assert "https://raw.githubusercontent.com/" in metadata, "the description shows no picture"


def check_bare() -> None:
    """The library imports without anything of the extras, which an environment without extras does not have."""
    import ls3_torchrl
    import ls3_torchrl.baselines
    import ls3_torchrl.data
    import ls3_torchrl.objectives
    import ls3_torchrl.planners
    import ls3_torchrl.trainers

    assert "site-packages" in ls3_torchrl.__file__, ls3_torchrl.__file__
    there = [name for name in EXTRAS if importlib.util.find_spec(name) is not None]
    assert not there, f"installed without extras: {there}"
    agent = ls3_torchrl.LS3Agent(action_dim=2, latent_dim=4)
    assert agent.architecture.latent_dim == 4


def check_readme() -> None:
    """The README's Python runs, one block after another."""
    blocks = re.findall(r"```python\n(.*?)```", Path("README.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(blocks) >= 2, "README.md has no Python"
    namespace: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), namespace)


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    {"archives": lambda: check_archives(Path(rest[0])), "bare": check_bare, "readme": check_readme}[what]()
    print(f"{what}: fine")
