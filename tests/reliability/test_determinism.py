"""What decides the bits of a run, and what only their last ones."""

import pytest
import torch
from tiny_runs import LS3, differences, finished

OPEN = [argument for argument in LS3 if not argument.startswith("threads=")]
BF16 = ["preset=smoke", "device=cpu", "threads=1", "pictures=false", "vae.autocast=true", "optim.autocast=true"]


def weights(folder):
    """Of the agent that was trained on the demonstrations."""
    return torch.load(folder / "checkpoints" / "agent_000.pt", weights_only=True)["state_dict"]


def furthest(one, other):
    """Largest difference of any weight, in units of the largest weight of its tensor."""
    pairs = zip(weights(one).values(), weights(other).values(), strict=True)
    return max(float((a - b).abs().max() / a.abs().max().clamp(min=1e-6)) for a, b in pairs)


@pytest.fixture(scope="module")
def one_thread(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("threads") / "one", [*OPEN, "threads=1"])


def test_the_same_seed_and_threads_give_the_same_bits_and_other_threads_the_same_but_for_rounding(one_thread, tmp_path):
    two, again = (finished(tmp_path / name, [*OPEN, "threads=2"]) for name in ("two", "again"))
    assert differences(two, again) == []
    assert furthest(one_thread, two) < 1e-3  # after 31 steps; rounding grows as training goes on


def test_in_bf16_the_same_seed_gives_the_same_bits_too_but_others_than_fp32(one_thread, tmp_path, soak):
    run = [*BF16, "planner.precision=bf16"]
    one = finished(tmp_path / "one", run)
    if soak:
        assert differences(one, finished(tmp_path / "again", run)) == []
    assert 0.0 < furthest(one_thread, one) < 0.5
