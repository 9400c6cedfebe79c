"""Figures of episodes, by hand."""

import torch
from tensordict import TensorDict

from ls3_recipes.figures import best_update, episode_figures, means_of, summarise


def test_figures_of_episodes_by_hand():
    step = {
        "reward": torch.tensor([[-1.0, -1.0, 0.0], [-1.0, -1.0, -1.0]]).unsqueeze(-1),
        "success": torch.tensor([[False, False, True], [False] * 3]).unsqueeze(-1),
        "constraint": torch.tensor([[False] * 3, [False, True, False]]).unsqueeze(-1),
    }
    figures = episode_figures(TensorDict({"next": step}, [2, 3]))
    assert figures["return"].tolist() == [-2.0, -3.0]
    assert figures["success"].tolist() == [True, False]
    assert figures["violation"].tolist() == [False, True]
    assert means_of(figures) == {"mean_return": -2.5, "mean_success": 0.5, "mean_violation": 0.5}
    # Over all episodes of all parts, not a mean of means.
    one = {name: value[:1] for name, value in figures.items()}
    assert summarise([figures, one]) == {
        "success_rate": 0.6667,
        "violation_rate": 0.3333,
        "return_mean": -2.333,
        "return_std": 0.471,
        "episodes": 3,
    }


def test_the_best_update_violates_least_then_returns_most_and_is_the_latest_of_equals():
    def figures(violation, *returns):
        return {"violation": torch.tensor(violation).bool(), "return": torch.tensor(returns)}

    rounds = [figures([0, 1], -9.0, -9.0), figures([0, 0], -40.0, -50.0), figures([0, 0], -44.0, -46.0)]
    assert best_update(rounds) == 2
    assert best_update(rounds[:2]) == 1
    assert best_update(rounds[:1]) == 0
