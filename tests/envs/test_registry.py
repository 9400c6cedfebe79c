"""The table of domains: what it builds, collects and refuses."""

import pytest
import torch

from ls3_envs import DOMAINS, NavigationEnv, VisualConstraintEnv, collect_offline, domain, make


def test_navigation_is_in_the_table_with_the_papers_numbers():
    row = domain("navigation")
    assert row is DOMAINS["navigation"]
    assert row.env is NavigationEnv
    # 50 demonstrations, 50 violating trajectories, and no additional random data (section 1.3.1).
    assert {kind: data.episodes for kind, data in row.offline.items()} == {"success": 50, "constraint": 50}


@pytest.mark.parametrize("name", sorted(DOMAINS))
def test_every_domain_can_be_made(name: str):
    env = make(name, num_worlds=2, seed=0)
    assert isinstance(env, VisualConstraintEnv)
    assert env.batch_size == (2,)
    assert env.reset()["pixels"].shape == (2, 3, 64, 64)


def test_make_passes_its_options_on():
    env = make("navigation", num_worlds=3, horizon=7, start="random", seed=1)
    assert (env.num_worlds, env.horizon, env.start) == (3, 7, "random")
    assert torch.equal(env.reset()["state"], NavigationEnv(3, horizon=7, start="random", seed=1).reset()["state"])


def test_offline_data_repeat_with_the_seed():
    first, same, other = (collect_offline("navigation", "success", episodes=2, seed=s) for s in (0, 0, 1))
    assert first.batch_size == (2, 100)
    assert first["pixels"].dtype == torch.uint8
    assert torch.equal(first["next", "state"], same["next", "state"])
    assert torch.equal(first["action"], same["action"])
    assert not torch.equal(first["action"], other["action"])


def test_unknown_domains_are_answered_with_the_known_ones():
    for ask in (domain, make, lambda name: collect_offline(name, "success")):
        with pytest.raises(ValueError, match=r"Unknown domain 'navigaton'\. Known domains: .*navigation"):
            ask("navigaton")


def test_unknown_kinds_of_data_are_answered_with_the_known_ones():
    with pytest.raises(ValueError, match="no offline data 'rand'; it has: constraint, success"):
        collect_offline("navigation", "rand")


def test_no_episodes_are_refused():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        collect_offline("navigation", "success", episodes=0)
