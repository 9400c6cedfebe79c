"""The table of domains: what it builds, collects and refuses."""

import re
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from ls3_envs import DOMAINS, NavigationEnv, VisualConstraintEnv, collect_offline, domain, make


def test_navigation_is_in_the_table_with_the_papers_numbers():
    row = domain("navigation")
    assert row is DOMAINS["navigation"]
    assert row.env.load() is NavigationEnv
    # 50 demonstrations, 50 violating trajectories, and no additional random data (section 1.3.1).
    assert {kind: data.episodes for kind, data in row.offline.items()} == {"success": 50, "constraint": 50}


def test_the_other_domains_have_the_papers_numbers():
    numbers = {name: {kind: d.episodes for kind, d in row.offline.items()} for name, row in DOMAINS.items()}
    assert numbers["reacher"] == {"success": 50, "constraint": 50, "rand": 100}
    assert numbers["pushing"] == {"success": 500, "constraint": 300}
    # The paper's cable routing has no violating data of its own; the 50 are this project's.
    assert numbers["cable_routing"] == {"success": 420, "rand": 150, "constraint": 50}
    assert DOMAINS["reacher"].offline["rand"].env_options["horizon"] == 20


@pytest.mark.parametrize(
    ("name", "channels"), [("navigation", 3), ("reacher", 9), ("pushing", 3), ("cable_routing", 3)]
)
def test_every_domain_can_be_made(name: str, channels: int):
    env = make(name, num_envs=2, seed=0)
    assert isinstance(env.base_env, VisualConstraintEnv)
    assert env.batch_size == (2,)
    first = env.reset()
    assert first["pixels"].shape == (2, channels, 64, 64)
    assert first["is_init"].all()
    check_env_specs(env)


def test_frames_some_steps_apart_are_stacked_the_newest_last_and_the_first_repeats():
    env, single = (make("navigation", num_envs=2, frames=k, frame_stride=2, seed=0) for k in (3, 1))
    torch.manual_seed(0)
    stacked = env.rollout(7)
    torch.manual_seed(0)
    frames = single.rollout(7)["pixels"]
    for t in range(7):
        expected = torch.cat([frames[:, max(t - back, 0)] for back in (4, 2, 0)], -3)
        assert torch.equal(stacked["pixels"][:, t], expected)
    assert stacked["pixels"].dtype == torch.uint8


def test_reacher_stacks_three_frames_four_steps_apart():
    episode = make("reacher", num_envs=1, seed=0).rollout(12)
    oldest, middle, newest = episode["pixels"][0].unflatten(1, (3, 3)).unbind(1)
    assert torch.equal(oldest[10], newest[2])
    assert torch.equal(middle[10], newest[6])


def test_frames_are_stacked_the_newest_last():
    env, single = (make("navigation", num_envs=1, frames=k, seed=0) for k in (3, 1))
    stacked, alone = (e.rollout(4, set_to_zero_but_one) for e in (env, single))
    frames = alone["next", "pixels"][0]
    torch.testing.assert_close(stacked["pixels"][0, 0], alone["pixels"][0, 0].repeat(3, 1, 1))  # the first one, thrice
    torch.testing.assert_close(stacked["next", "pixels"][0, 3], torch.cat(list(frames[1:4])))


def set_to_zero_but_one(tensordict):
    return tensordict.set("action", torch.tensor([[3.0, 0.0]]))


def test_fewer_than_one_frame_are_refused():
    with pytest.raises(ValueError, match="frames must be at least 1, got 0"):
        make("navigation", frames=0)
    with pytest.raises(ValueError, match="frame_stride must be at least 1, got 0"):
        make("navigation", frame_stride=0)


def test_more_episodes_than_are_collected_at_once_begin_with_the_same_ones(monkeypatch):
    whole = collect_offline("navigation", "success", episodes=3, seed=4)
    monkeypatch.setattr("ls3_envs.making._SIDE_BY_SIDE", 2)
    parts = collect_offline("navigation", "success", episodes=3, seed=4)
    assert parts.batch_size == whole.batch_size
    assert torch.equal(parts["state"][:2, 0], whole["state"][:2, 0])
    assert not torch.equal(parts["state"][2, 0], parts["state"][0, 0])


def test_make_passes_its_options_on():
    env = make("navigation", num_envs=3, horizon=7, start="random", seed=1)
    assert (env.num_envs, env.horizon, env.start) == (3, 7, "random")
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


def test_the_document_names_every_domain_with_its_id_and_its_episodes():
    document = (Path(__file__).parents[2] / "docs" / "domains.md").read_text()
    rows = {
        line.split("|")[1].strip(): [cell.strip() for cell in line.split("|")[2:-1]]
        for line in document.splitlines()
        if line.startswith("| ")
    }
    assert [cell.strip("`") for cell in rows["name"]] == list(DOMAINS)
    assert [cell.strip("`") for cell in rows["Gymnasium"]] == [row.gym_id for row in DOMAINS.values()]
    for cell, row in zip(rows["success / rand / constraint episodes"], DOMAINS.values(), strict=True):
        numbers = [re.match(r"\d*", part.strip()).group() for part in cell.split("/")]
        found = {kind: int(n) for kind, n in zip(("success", "rand", "constraint"), numbers, strict=True) if n}
        assert found == {kind: data.episodes for kind, data in row.offline.items()}


def test_the_documents_python_runs(capsys):
    document = (Path(__file__).parents[2] / "docs" / "domains.md").read_text()
    (block,) = re.findall(r"```python\n(.*?)```", document, flags=re.DOTALL)
    exec(compile(block, "domains.md", "exec"), {})
    assert "of 8 violated" in capsys.readouterr().out
