"""Equation (2) restated by hand: the Gaussian negative log-likelihood of the next latent."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn

from ls3_torchrl.modules import EnsembleDynamics
from ls3_torchrl.objectives import EnsembleDynamicsLoss

DELTA = (0.5, -1.0)  # what each of two members adds to a latent of one dimension
SCALE = (0.5, 2.0)


def constant_dynamics() -> EnsembleDynamics:
    dynamics = EnsembleDynamics(1, 1, num_members=2, hidden=())
    with torch.no_grad():
        dynamics.network.weights[0].zero_()
        for m in range(2):
            dynamics.network.biases[0][m, 0] = torch.tensor([DELTA[m], math.log(SCALE[m])])
    return dynamics


def log_density(x: float, mean: float, std: float) -> float:
    return -0.5 * ((x - mean) / std) ** 2 - math.log(std) - 0.5 * math.log(2 * math.pi)


def transitions(latent: list, next_latent: list) -> TensorDict:
    z, z_next = torch.tensor(latent).unsqueeze(-1), torch.tensor(next_latent).unsqueeze(-1)
    return TensorDict({"latent": z, "action": torch.zeros_like(z), "next": {"latent": z_next}}, z.shape[:-1])


def test_loss_is_the_gaussian_negative_log_likelihood_over_rows_and_members():
    z, z_next = [0.0, 2.0, -1.0], [0.4, 2.0, 1.5]
    out = EnsembleDynamicsLoss(constant_dynamics())(transitions(z, z_next))
    pairs = [(a, b, m) for a, b in zip(z, z_next, strict=True) for m in range(2)]
    nll = -sum(log_density(b, a + DELTA[m], SCALE[m]) for a, b, m in pairs) / 6
    error = sum((a + DELTA[m] - b) ** 2 for a, b, m in pairs) / 6
    assert out["loss_dynamics"].item() == pytest.approx(nll, rel=1e-5)
    assert out["prediction_error"].item() == pytest.approx(error, rel=1e-5)
    assert out["loss_dynamics"].requires_grad
    assert not out["prediction_error"].requires_grad


def test_latent_dimensions_are_averaged():
    dynamics = EnsembleDynamics(2, 1, num_members=1, hidden=())
    with torch.no_grad():
        dynamics.network.weights[0].zero_()
        dynamics.network.biases[0].copy_(torch.tensor([[[1.0, 2.0, math.log(0.5), math.log(3.0)]]]))
    td = TensorDict(
        {"latent": torch.zeros(1, 2), "action": torch.zeros(1, 1), "next": {"latent": torch.tensor([[0.0, 5.0]])}},
        [1],
    )
    expected = -(log_density(0.0, 1.0, 0.5) + log_density(5.0, 2.0, 3.0)) / 2
    assert EnsembleDynamicsLoss(dynamics)(td)["loss_dynamics"].item() == pytest.approx(expected, rel=1e-5)


def test_bootstrap_column_m_teaches_member_m():
    z, z_next = [[0.0, 1.0], [2.0, -1.0]], [[0.4, 3.0], [2.0, 1.5]]
    out = EnsembleDynamicsLoss(constant_dynamics(), bootstrap=True)(transitions(z, z_next))
    cells = [(i, m) for i in range(2) for m in range(2)]
    nll = -sum(log_density(z_next[i][m], z[i][m] + DELTA[m], SCALE[m]) for i, m in cells) / 4
    assert out["loss_dynamics"].item() == pytest.approx(nll, rel=1e-5)


def test_bootstrap_gradient_of_a_member_ignores_the_other_columns():
    def gradient(next_latents: list) -> torch.Tensor:
        dynamics = constant_dynamics()
        batch = transitions([[0.0, 1.0]], next_latents)
        EnsembleDynamicsLoss(dynamics, bootstrap=True)(batch)["loss_dynamics"].backward()
        return dynamics.network.biases[0].grad

    before, after = gradient([[0.4, 3.0]]), gradient([[0.4, -7.0]])
    assert torch.equal(before[0], after[0])
    assert not torch.equal(before[1], after[1])


def test_equal_bootstrap_columns_equal_the_shared_batch():
    dynamics = EnsembleDynamics(3, 2, num_members=4, hidden=(8,))
    shared = TensorDict(
        {"latent": torch.randn(5, 3), "action": torch.randn(5, 2), "next": {"latent": torch.randn(5, 3)}}, [5]
    )
    columns = shared.unsqueeze(1).expand(5, 4).contiguous()
    plain = EnsembleDynamicsLoss(dynamics)(shared)
    bootstrapped = EnsembleDynamicsLoss(dynamics, bootstrap=True)(columns)
    torch.testing.assert_close(plain["loss_dynamics"], bootstrapped["loss_dynamics"])
    torch.testing.assert_close(plain["prediction_error"], bootstrapped["prediction_error"])


@pytest.mark.parametrize("columns", [[0.0, 1.0], [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]])
def test_a_bootstrap_batch_needs_one_column_per_member(columns: list):
    loss = EnsembleDynamicsLoss(constant_dynamics(), bootstrap=True)
    with pytest.raises(ValueError, match=r"latents of shape \[B, 2, D\]"):
        loss(transitions(columns, columns))


def test_nested_keys_of_loss_and_module():
    dynamics = EnsembleDynamics(
        3, 2, hidden=(8,), latent_key=("m", "z"), action_key=("m", "a"), next_latent_key=("m", "z2")
    )
    loss = EnsembleDynamicsLoss(dynamics)
    loss.set_keys(latent=("now", "z"), action=("agent", "a"), next_latent=("later", "z"))
    z, a, z_next = torch.randn(5, 3), torch.randn(5, 2), torch.randn(5, 3)
    nested = loss(TensorDict({"now": {"z": z}, "agent": {"a": a}, "later": {"z": z_next}}, [5]))
    flat = EnsembleDynamicsLoss(dynamics)(TensorDict({"latent": z, "action": a, "next": {"latent": z_next}}, [5]))
    assert torch.equal(nested["loss_dynamics"], flat["loss_dynamics"])


def test_misspelt_and_missing_keys():
    loss = EnsembleDynamicsLoss(constant_dynamics())
    with pytest.raises(ValueError, match="latents is not an accepted tensordict key"):
        loss.set_keys(latents="z")
    batch = transitions([0.0], [1.0])
    del batch["next", "latent"]
    with pytest.raises(KeyError, match=r"EnsembleDynamicsLoss needs the keys \[\('next', 'latent'\)\]"):
        loss(batch)


@pytest.mark.parametrize("bootstrap", [False, True])
def test_over_several_steps_every_member_carries_its_own_mean_on(bootstrap):
    # Two stretches of three steps; with bootstrap, a batch of one row with a stretch for each of two members.
    z, z_next = [[0.0, 9.0, 9.0], [2.0, 9.0, 9.0]], [[0.4, 2.0, 1.5], [1.0, 0.0, 2.0]]
    batch = transitions(z, z_next)
    pairs = [(b, m) for b in range(2) for m in range(2) if not bootstrap or b == m]
    if bootstrap:
        batch = batch.unsqueeze(0)
    out = EnsembleDynamicsLoss(constant_dynamics(), bootstrap=bootstrap, steps=3)(batch)
    ends = [(z_next[b][k], z[b][0] + (k + 1) * DELTA[m], SCALE[m]) for b, m in pairs for k in range(3)]
    nll = -sum(log_density(*end) for end in ends) / len(ends)
    error = sum((mean - x) ** 2 for x, mean, _ in ends) / len(ends)
    assert out["loss_dynamics"].item() == pytest.approx(nll, rel=1e-5)
    assert out["prediction_error"].item() == pytest.approx(error, rel=1e-5)


def test_single_transitions_are_no_stretches():
    loss = EnsembleDynamicsLoss(constant_dynamics(), steps=3)
    with pytest.raises(ValueError, match=r"steps=3\) needs stretches.*\[B, 3, D\].*got \[2, 1\]"):
        loss(transitions([0.0, 1.0], [1.0, 2.0]))
    with pytest.raises(ValueError, match="steps must be at least 1, got 0"):
        EnsembleDynamicsLoss(constant_dynamics(), steps=0)


def test_dynamics_overfit_eight_transitions(minimise):
    batch = TensorDict(
        {"latent": torch.randn(8, 4), "action": torch.randn(8, 2), "next": {"latent": torch.randn(8, 4)}}, [8]
    )
    loss = EnsembleDynamicsLoss(EnsembleDynamics(4, 2))
    before = loss(batch)["prediction_error"].item()
    first, last = minimise(loss, batch, "loss_dynamics", steps=300, lr=3e-3)
    assert last < first - 1.5  # nats a dimension: the predicted spread shrinks with the error
    assert loss(batch)["prediction_error"].item() < 0.05 * before


def test_predicted_scale_settles_at_the_spread_of_the_data(minimise):
    # The likelihood's optimum for one state with two equally frequent outcomes ±0.5 is N(0, 0.5²).
    batch = transitions([0.0, 0.0], [0.5, -0.5])
    dynamics = EnsembleDynamics(1, 1, num_members=1, hidden=())
    minimise(EnsembleDynamicsLoss(dynamics), batch, "loss_dynamics", steps=300, lr=3e-2)
    loc, scale = dynamics.distribution(torch.zeros(1, 1), torch.zeros(1, 1))
    assert loc.item() == pytest.approx(0.0, abs=0.02)
    assert scale.item() == pytest.approx(0.5, rel=0.03)


def test_loss_names_its_keys():
    loss = EnsembleDynamicsLoss(constant_dynamics())
    loss.set_keys(action=("agent", "a"))
    assert loss.in_keys == ["latent", ("agent", "a"), ("next", "latent")]
    assert loss.out_keys == ["loss_dynamics", "prediction_error"]
    assert "loss_dynamics" in repr(loss)


def test_loss_compiles_in_one_graph():
    loss = EnsembleDynamicsLoss(EnsembleDynamics(4, 2, hidden=(8,)))
    batch = TensorDict({"latent": torch.randn(6, 4), "action": torch.randn(6, 2)}, [6])
    batch["next"] = {"latent": torch.randn(6, 4)}
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(batch)["loss_dynamics"], loss(batch)["loss_dynamics"])


# Dynamics of other makes


class Single(TensorDictModuleBase):
    """One network without members: the mean is z + w a, the spread a constant."""

    in_keys = [("model", "z"), ("model", "a")]  # noqa: RUF012
    out_keys = [("model", "next_z")]  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(0.5))

    def distribution(self, latent: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = latent + self.weight * action
        return mean, torch.full_like(mean, 2.0)


def test_a_single_network_that_gives_mean_and_standard_deviation():
    dynamics = Single()
    loss = EnsembleDynamicsLoss(dynamics)
    loss.set_keys(latent=("now", "z"))
    z, a, z_next = [0.0, 2.0, -1.0], [1.0, -1.0, 0.5], [0.4, 2.0, 1.5]
    rows = {"action": torch.tensor(a)[:, None], "next": {"latent": torch.tensor(z_next)[:, None]}}
    out = loss(TensorDict({"now": {"z": torch.tensor(z)[:, None]}, **rows}, [3]))
    by_hand = -sum(log_density(y, x + 0.5 * u, 2.0) for x, u, y in zip(z, a, z_next, strict=True)) / 3
    assert out["loss_dynamics"].item() == pytest.approx(by_hand, rel=1e-5)
    out["loss_dynamics"].backward()
    assert dynamics.weight.grad.abs() > 0


def test_dynamics_that_lack_a_method_are_told_what_is_needed():
    plain = TensorDictModule(lambda z, a: z + a, ["latent", "action"], [("next", "latent")])
    with pytest.raises(
        TypeError, match=r"method distribution\(latent, action\).*TensorDictModule has none.*Prediction"
    ):
        EnsembleDynamicsLoss(plain)
    with pytest.raises(
        TypeError, match=r"steps=3\) needs dynamics with a method unroll\(latent, action\).*Single has none"
    ):
        EnsembleDynamicsLoss(Single(), steps=3)
    with pytest.raises(TypeError, match=r"EnsembleDynamicsLoss\(bootstrap=True\) needs an ensemble.*Single is none"):
        EnsembleDynamicsLoss(Single(), bootstrap=True)


def test_a_distribution_of_ones_own_is_not_bypassed():
    class Still(EnsembleDynamics):
        def distribution(self, latent, action, *, per_member=False):
            loc, scale = super().distribution(latent, action, per_member=per_member)
            return 0.0 * loc, 0.0 * scale + 1.0

    batch = transitions([0.5, -2.0], [1.0, 3.0])
    out = EnsembleDynamicsLoss(Still(1, 1, hidden=()))(batch)
    assert out["prediction_error"].item() == pytest.approx((1.0 + 9.0) / 2)
    stretches = transitions([[0.5, 1.0]], [[1.0, 3.0]])
    out = EnsembleDynamicsLoss(Still(1, 1, hidden=()), steps=2)(stretches)
    assert out["prediction_error"].item() == pytest.approx((1.0 + 9.0) / 2)
