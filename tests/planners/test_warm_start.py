"""The last plan, carried from step to step."""

import pytest
import torch
from tensordict import TensorDict

from ls3_torchrl.planners import WarmStart

LOW, HIGH = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0])


@pytest.mark.parametrize("plan_key", ["plan", ("ls3", "plan")])
@pytest.mark.parametrize("batch", [[], [6], [2, 3]])
def test_what_is_written_is_read_one_step_on_shifted_and_open_at_the_end(plan_key, batch):
    torch.manual_seed(0)
    warm = WarmStart(LOW, HIGH, 3, plan_key, "is_init")
    rows = torch.Size(batch).numel()
    mean, std = torch.randn(rows, 3, 2), torch.rand(rows, 3, 2) + 0.1
    td = TensorDict({}, batch)
    warm.write(td, mean, std)
    got_mean, got_std = warm.read(td["next"], rows)
    assert torch.equal(got_mean[:, :2], mean[:, 1:])
    assert torch.equal(got_std[:, :2], std[:, 1:])
    assert (got_mean[:, 2] == torch.tensor([0.0, 2.0])).all()
    assert (got_std[:, 2] == torch.tensor([0.5, 1.0])).all()


def test_rows_that_begin_an_episode_start_from_the_whole_box():
    warm = WarmStart(LOW, HIGH, 2, "plan", "is_init")
    plan = {"mean": torch.full((3, 2, 2), 0.7), "std": torch.full((3, 2, 2), 0.1)}
    plan["std"][2] = 0.0  # what the primer leaves after a reset
    td = TensorDict({"plan": plan, "is_init": torch.tensor([[False], [True], [False]])}, [3])
    mean, std = warm.read(td, 3)
    assert (mean[0] == 0.7).all()
    for row in (1, 2):
        assert (mean[row] == torch.tensor([0.0, 2.0])).all()
        assert (std[row] == torch.tensor([0.5, 1.0])).all()


def test_without_a_plan_there_is_no_warm_start():
    assert WarmStart(LOW, HIGH, 2, "plan", "is_init").read(TensorDict({}, [3]), 3) == (None, None)
