"""What only some data need is imported when it is used, and its absence is told with what to install."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ls3_torchrl.data import episode_from_images, load_lerobot, load_minari, pixels_from_images, save_minari

OPTIONAL = ("PIL", "av", "gymnasium", "h5py", "minari", "pyarrow")
LEROBOT = Path(__file__).with_name("lerobot_v3")
NO = np.zeros(1)


@pytest.mark.parametrize(
    ("package", "call"),
    [
        ("minari", lambda: load_minari("mine/robot-v0")),
        ("minari", lambda: save_minari({}, "mine/robot-v0")),
        ("h5py", lambda: save_minari({}, "mine/robot-v0")),
        ("pyarrow", lambda: load_lerobot(LEROBOT, camera="wrist", constraint=False)),
        ("av", lambda: load_lerobot(LEROBOT, camera="top", constraint=False)),
        ("PIL", lambda: load_lerobot(LEROBOT, camera="wrist", constraint=False)),
        ("PIL", lambda: episode_from_images(["a.png", "b.png"], NO[:, None], NO, NO, NO)),
        ("PIL", lambda: pixels_from_images(np.zeros((48, 64, 3), dtype=np.uint8))),
    ],
)
def test_a_missing_package_is_named_with_the_extra_that_brings_it(package, call, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModuleNotFoundError, match=r"needs .*pip install 'ls3-torchrl\[data\]'") as refused:
        call()
    assert refused.value.name


def test_the_library_imports_without_any_of_them():
    absent = f"import sys\nfor name in {OPTIONAL}: sys.modules[name] = None\n"
    code = absent + "import ls3_torchrl.data as data\nprint(len([getattr(data, name) for name in data.__all__]))"
    # TorchRL itself looks for some of them; what it makes of their absence is not what is tested here.
    run = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert int(run.stdout) > 25


def test_the_extra_names_all_that_is_needed():
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    extra = re.search(r"^data = \[(.*?)\]\n", text, flags=re.DOTALL | re.MULTILINE).group(1)
    assert set(re.findall(r'"([a-z]+)', extra)) == {"minari", "pyarrow", "av", "pillow"}
