"""Classes by address, and a package that needs MuJoCo only where a domain does."""

import os
import subprocess
import sys
import textwrap

import pytest

import ls3_envs
from ls3_envs import Lazy


def test_it_imports_at_the_first_call_and_not_before():
    sys.modules.pop("colorsys", None)
    lazy = Lazy("colorsys:rgb_to_hsv")
    assert "colorsys" not in sys.modules
    assert lazy(0.5, 0.5, 0.5) == (0.0, 0.0, 0.5)
    assert lazy.load() is sys.modules["colorsys"].rgb_to_hsv


@pytest.mark.parametrize(
    "address", ["fractions", "fractions:", "fractions.Fraction", ":Fraction", "a b:C", "fractions:a.b"]
)
def test_other_addresses_are_refused(address):
    with pytest.raises(ValueError, match=r"'package\.module:Name', got"):
        Lazy(address)


def test_addresses_of_nothing_say_what_is_not_there():
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'ls3_envs\.navigaton'"):
        Lazy("ls3_envs.navigaton:NavigationEnv").load()
    with pytest.raises(AttributeError, match=r"'ls3_envs\.navigation' has no 'NavigatonEnv'"):
        Lazy("ls3_envs.navigation:NavigatonEnv").load()


def test_the_tables_classes_are_attributes_of_the_package():
    from ls3_envs import NavigationEnv, ReacherViolator
    from ls3_envs.demonstrators.reacher import ReacherViolator as Same
    from ls3_envs.navigation import NavigationEnv as TheSame

    assert NavigationEnv is TheSame
    assert ReacherViolator is Same
    assert {"CableWanderer", "SequentialPushingEnv", "make"} <= set(dir(ls3_envs))
    with pytest.raises(AttributeError, match="'ls3_envs' has no attribute 'NavigatonEnv'"):
        _ = ls3_envs.NavigatonEnv


def test_every_address_of_the_table_leads_somewhere():
    for row in ls3_envs.DOMAINS.values():
        assert issubclass(row.env.load(), ls3_envs.VisualConstraintEnv)
        for data in row.offline.values():
            assert issubclass(data.policy.load(), ls3_envs.demonstrators.Scripted)


def test_navigation_needs_no_mujoco_and_the_others_say_that_they_do():
    code = """
        import sys
        for name in ("mujoco", "mujoco_warp", "warp", "dm_control"):
            sys.modules[name] = None  # importing it raises ModuleNotFoundError, as if it were not installed
        import gymnasium
        import ls3_envs
        assert ls3_envs.make("navigation", 2, seed=0).rollout(3)["next", "pixels"].shape == (2, 3, 3, 64, 64)
        assert ls3_envs.collect_offline("navigation", "constraint", episodes=1).batch_size == (1, 100)
        assert gymnasium.make("ls3/Navigation-v0").reset()[0].shape == (64, 64, 3)
        for ask in (lambda: ls3_envs.make("reacher"), lambda: ls3_envs.CableRoutingEnv):
            try:
                ask()
            except ModuleNotFoundError as error:
                assert "needs the package 'mujoco', which is not installed" in str(error), error
                assert "pip install 'ls3-torchrl[envs]'" in str(error), error
            else:
                raise AssertionError("nothing was said")
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, env=dict(os.environ), check=False
    )
    assert done.returncode == 0, done.stderr
