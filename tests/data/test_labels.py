import pytest
import torch

from ls3_torchrl.data import after_violation, in_success, length_without_idle_end, reward_to_go, timed_out


def test_reward_to_go_by_hand():
    reward = torch.tensor([[-1.0], [-1.0], [0.0], [-1.0]])
    # -1 - .5 (1 + .5 (0 + .5 * 1)), read from the end backwards.
    assert reward_to_go(reward, 0.5).flatten().tolist() == [-1.625, -1.25, -0.5, -1.0]


def test_reward_to_go_includes_the_reward_of_the_step_itself():
    # Both of V's equations share this convention, so that switching between them moves nothing.
    assert reward_to_go(torch.tensor([[-3.0]]), 0.9).item() == -3.0


@pytest.mark.parametrize("gamma", [0.0, 0.7, 0.99, 1.0])
def test_reward_to_go_of_a_batch_equals_the_sum(gamma):
    torch.manual_seed(0)
    reward = torch.randn(3, 2, 7, 1)
    expected = torch.zeros_like(reward)
    for t in range(7):
        for i in range(t, 7):
            expected[..., t, :] += gamma ** (i - t) * reward[..., i, :]
    torch.testing.assert_close(reward_to_go(reward, gamma), expected)


@pytest.mark.parametrize(
    ("success", "expected"),
    [
        ([0, 0, 0], [0, 0, 0]),
        ([0, 0, 1], [1, 1, 1]),
        ([0, 1, 0, 0], [1, 1, 0, 0]),  # what comes after the last visit is not in the trajectory to the goal
        ([1, 0, 1, 0], [1, 1, 1, 0]),
    ],
)
def test_in_success_by_hand(success, expected):
    label = in_success(torch.tensor(success).bool().unsqueeze(-1))
    assert label.dtype == torch.bool
    assert label.flatten().int().tolist() == expected


def test_in_success_keeps_the_rows_of_a_batch_apart():
    success = torch.zeros(2, 5, 1, dtype=torch.bool)
    success[0, 3] = True
    assert in_success(success).squeeze(-1).int().tolist() == [[1, 1, 1, 1, 0], [0, 0, 0, 0, 0]]


@pytest.mark.parametrize(
    ("success", "constraint", "expected"),
    [
        ([0, 0, 0], [0, 0, 0], True),
        ([0, 1, 0], [0, 0, 0], False),
        ([0, 0, 0], [1, 0, 0], False),
        ([0, 0, 1], [0, 1, 0], False),
    ],
)
def test_timed_out_is_neither_a_success_nor_a_violation(success, constraint, expected):
    outcome = (torch.tensor(values).bool().unsqueeze(-1) for values in (success, constraint))
    assert timed_out(*outcome).flatten().tolist() == [expected] * 3


def test_timed_out_keeps_the_rows_of_a_batch_apart():
    success = torch.zeros(2, 5, 1, dtype=torch.bool)
    success[0, 3] = True
    assert timed_out(success, torch.zeros_like(success)).squeeze(-1).int().tolist() == [[0] * 5, [1] * 5]


def test_after_violation_marks_the_steps_behind_the_first_violation_row_by_row():
    constraint = torch.zeros(3, 5, 1, dtype=torch.bool)
    constraint[0, 2:] = True
    constraint[1, 1] = True  # even where the flag does not stay
    assert after_violation(constraint).squeeze(-1).int().tolist() == [[0, 0, 0, 1, 1], [0, 0, 1, 1, 1], [0] * 5]


@pytest.mark.parametrize(
    ("success", "tail", "left"),
    [
        ([0, 0, 0], 1, 3),  # never done: nothing to leave out
        ([0, 1, 1, 1], 1, 2),
        ([0, 1, 1, 1], 2, 3),
        ([0, 1, 1, 1], 9, 4),
        ([1, 1, 0, 1], 1, 4),  # an earlier success that did not last stays whole
        ([1, 1], 1, 1),
    ],
)
def test_the_idle_end_by_hand(success, tail, left):
    assert length_without_idle_end(torch.tensor(success).bool().unsqueeze(-1), tail) == left
