"""Recovery RL: the safety critic's Bellman equation by hand and in a corridor, and who acts when."""

import math

import pytest
import torch
from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.objectives import DDPGLoss, SoftUpdate

from ls3_torchrl.baselines import (
    RecoveryPolicy,
    SafetyCritic,
    SafetyCriticLoss,
    deterministic_actor,
    gaussian_actor,
)

SPEC = Bounded(low=-2.0, high=2.0, shape=(1,))


def constant(action: float, key: str = "loc") -> TensorDictModule:
    """A policy that always wants the same."""
    return TensorDictModule(lambda z: torch.full_like(z[..., :1], action), [key], ["action"])


def linear_critic(on_state: float, on_action: float, *, members: int = 1) -> SafetyCritic:
    """Logit on_state * z + on_action * a / 2, the action in units of half the box."""
    critic = SafetyCritic(SPEC, 1, num_members=members, hidden=())
    with torch.no_grad():
        critic.network.weights[0].copy_(torch.tensor([[on_state], [on_action]]).expand(members, 2, 1))
        critic.network.biases[0].zero_()
    return critic


def lagged(critic, policy, **options) -> SafetyCriticLoss:
    loss = SafetyCriticLoss(critic, policy, **options)
    SoftUpdate(loss, tau=0.05)
    return loss


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def transitions(z, action, z_next, violated) -> TensorDict:
    column = lambda values: torch.tensor(values).unsqueeze(-1)  # noqa: E731
    reached = {"loc": column(z_next), "constraint": column(violated)}
    return TensorDict({"loc": column(z), "action": column(action), "next": reached}, [len(z)])


def test_target_and_loss_by_hand():
    z, action, z_next, violated = [0.3, -1.0, 2.0], [1.0, -2.0, 0.5], [1.0, 2.0, -3.0], [False, True, False]
    loss = lagged(linear_critic(2.0, 0.5), constant(-1.0), gamma=0.95)
    batch = transitions(z, action, z_next, violated)
    targets = [
        float(c) + (1 - float(c)) * 0.95 * sigmoid(2.0 * b - 0.25) for b, c in zip(z_next, violated, strict=True)
    ]
    assert loss.target(batch).flatten().tolist() == pytest.approx(targets)
    assert targets[1] == 1.0
    judged = [sigmoid(2.0 * b + 0.25 * a) for b, a in zip(z, action, strict=True)]
    by_hand = sum(-(y * math.log(p) + (1 - y) * math.log(1 - p)) for p, y in zip(judged, targets, strict=True)) / 3
    losses = loss(batch)
    assert losses["loss_safety"].item() == pytest.approx(by_hand, rel=1e-5)
    assert losses["risk"].item() == pytest.approx(sum(judged) / 3, rel=1e-5)


def test_the_most_worried_member_speaks():
    critic = SafetyCritic(SPEC, 4, num_members=3)
    td = critic(TensorDict({"loc": torch.randn(7, 4), "action": torch.zeros(7, 1)}, [7]))
    torch.testing.assert_close(td["risk"], td["risk_logit"].sigmoid().amax(-1, keepdim=True))
    torch.testing.assert_close(td["safety"], -td["risk"])


def test_the_target_lags_and_the_policy_is_left_alone():
    critic, policy = linear_critic(2.0, 0.5), gaussian_actor(SPEC, 1, hidden=(4,))
    loss = lagged(critic, policy)
    batch = transitions([0.3], [1.0], [1.0], [False])
    torch.manual_seed(1)
    before = loss.target(batch)
    with torch.no_grad():
        critic.network.weights[0].mul_(-1.0)
    torch.manual_seed(1)
    torch.testing.assert_close(loss.target(batch), before)
    ours = {id(p) for p in loss.parameters()}
    assert not ours & {id(p) for p in policy.parameters()}
    loss(batch)["loss_safety"].backward()
    assert all(p.grad is None for p in policy.parameters())


def test_the_next_action_is_drawn_from_the_policy_whatever_the_exploration_type():
    loss = lagged(linear_critic(0.0, 4.0), gaussian_actor(SPEC, 1, hidden=(4,)))
    batch = transitions([0.0] * 50, [0.0] * 50, [0.0] * 50, [False] * 50)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert loss.target(batch).std() > 0.05


def test_risk_falls_by_gamma_with_every_step_from_the_cliff():
    # A corridor: from cell i one comes to cell i - 1, and from cell 1 over the cliff. Q_risk = gamma ** (i - 1).
    cells = torch.eye(5)
    flags = torch.tensor([True, False, False, False, False]).unsqueeze(-1)
    reached = {"loc": torch.cat([torch.zeros(1, 5), cells[:-1]]), "constraint": flags}
    batch = TensorDict({"loc": cells, "action": torch.zeros(5, 1), "next": reached}, [5])
    critic = SafetyCritic(SPEC, 5, hidden=(32,))
    loss = SafetyCriticLoss(critic, constant(0.0), gamma=0.5)
    updater = SoftUpdate(loss, tau=0.2)
    optimiser = torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], 1e-2)
    for _ in range(600):
        optimiser.zero_grad()
        loss(batch)["loss_safety"].backward()
        optimiser.step()
        updater.step()
    risk = critic(batch.select("loc", "action"))["risk"].flatten()
    torch.testing.assert_close(risk, 0.5 ** torch.arange(5.0), atol=0.05, rtol=0)


def test_a_policy_that_ascends_safety_learns_to_recover():
    critic = linear_critic(0.0, 4.0)  # the larger the action, the worse
    policy = deterministic_actor(SPEC, 1, hidden=(16,))
    loss = DDPGLoss(policy, critic, delay_value=False)
    loss.set_keys(state_action_value="safety")
    loss.make_value_estimator(gamma=0.9)
    over = {key: torch.zeros(16, 1, dtype=torch.bool) for key in ("done", "terminated")}
    reached = {"loc": torch.randn(16, 1), "reward": torch.zeros(16, 1), **over}
    batch = TensorDict({"loc": torch.randn(16, 1), "action": torch.zeros(16, 1), "next": reached}, [16])
    weights = [p.detach().clone() for p in critic.parameters()]
    optimiser = torch.optim.Adam(policy.parameters(), 1e-2)
    for _ in range(200):
        optimiser.zero_grad()
        loss(batch)["loss_actor"].backward()
        optimiser.step()
    assert (policy(batch.select("loc"))["action"] < -1.5).all()
    assert all(torch.equal(a, b) for a, b in zip(weights, critic.parameters(), strict=True))


def test_the_recovery_policy_takes_over_above_the_threshold_alone():
    critic = linear_critic(1.0, 0.0)
    policy = RecoveryPolicy(constant(1.5), constant(-1.5), critic, 0.8)
    edge = math.log(0.8 / 0.2)  # where the risk is the threshold
    z = torch.tensor([[-5.0], [edge - 0.01], [edge + 0.01], [5.0]])
    td = policy(TensorDict({"loc": z}, [4]))
    assert td["recovered"].flatten().tolist() == [False, False, True, True]
    assert td["action"].flatten().tolist() == [1.5, 1.5, -1.5, -1.5]
    assert (td["task_action"] == 1.5).all()
    torch.testing.assert_close(td["risk"], z.sigmoid())


@pytest.mark.parametrize(("threshold", "recovers"), [(1.0, False), (0.0, True)])
def test_the_ends_of_the_threshold(threshold, recovers):
    policy = RecoveryPolicy(constant(1.0), constant(-1.0), linear_critic(1.0, 0.0), threshold)
    assert policy(TensorDict({"loc": torch.randn(50, 1)}, [50]))["recovered"].all() == recovers


def test_any_policy_can_be_wrapped_and_keeps_its_keys():
    encoder = nn.Linear(4, 1)
    task = TensorDictSequential(TensorDictModule(encoder, ["sensors"], ["loc"]), gaussian_actor(SPEC, 1, hidden=(4,)))
    policy = RecoveryPolicy(task, deterministic_actor(SPEC, 1, hidden=(4,)), SafetyCritic(SPEC, 1, hidden=(4,)), 0.5)
    assert policy.in_keys == ["sensors"]
    assert set(policy.out_keys) == {*task.out_keys, "task_action", "risk", "recovered"}
    td = policy(TensorDict({"sensors": torch.randn(3, 2, 4)}, [3, 2]))
    assert td["action"].shape == (3, 2, 1)
    assert td["recovered"].shape == (3, 2, 1)
    assert "action_log_prob" in td
    # All of its networks are found by an optimiser, a device move or a checkpoint.
    assert set(dict(policy.named_children())) == {"task", "recovery", "safety_critic"}


def test_impossible_arguments_and_missing_keys_are_refused():
    critic = linear_critic(1.0, 0.0)
    with pytest.raises(ValueError, match=r"threshold must lie in \[0, 1\], got 1.5"):
        RecoveryPolicy(constant(0.0), constant(0.0), critic, 1.5)
    with pytest.raises(ValueError, match="gamma"):
        SafetyCriticLoss(critic, constant(0.0), gamma=1.5)
    with pytest.raises(KeyError, match="SafetyCritic needs the keys"):
        critic(TensorDict({"loc": torch.zeros(2, 1)}, [2]))
    with pytest.raises(KeyError, match="SafetyCriticLoss needs the keys"):
        lagged(critic, constant(0.0))(TensorDict({"loc": torch.zeros(2, 1)}, [2]))


def test_other_keys():
    critic = SafetyCritic(SPEC, 1, observation_key=("robot", "state"), hidden=(4,))
    loss = lagged(critic, constant(0.0, ("robot", "state")))
    loss.set_keys(action="done_action", constraint=("next", "cost"))
    batch = TensorDict(
        {
            "robot": {"state": torch.randn(5, 1)},
            "done_action": torch.zeros(5, 1),
            "next": {"robot": {"state": torch.randn(5, 1)}, "cost": torch.zeros(5, 1)},
        },
        [5],
    )
    assert loss(batch)["loss_safety"].shape == ()
    assert loss.in_keys == [("robot", "state"), ("next", "robot", "state"), "done_action", ("next", "cost")]


def test_loss_and_switch_compile():
    critic = SafetyCritic(SPEC, 1, hidden=(4,))
    batch = transitions([0.3, -1.0], [1.0, -2.0], [1.0, 2.0], [False, True])
    loss = lagged(critic, constant(0.5))
    compiled = torch.compile(loss, backend="aot_eager")
    torch.testing.assert_close(compiled(batch)["loss_safety"], loss(batch)["loss_safety"])
    policy = RecoveryPolicy(
        deterministic_actor(SPEC, 1, hidden=(4,)), deterministic_actor(SPEC, 1, hidden=(4,)), critic, 0.5
    )
    td = TensorDict({"loc": torch.randn(8, 1)}, [8])
    compiled = torch.compile(policy, backend="aot_eager")
    torch.testing.assert_close(compiled(td.copy())["action"], policy(td.copy())["action"])


# Keys and modules of other makes


def nested_critic(action_key: NestedKey = ("agent", "move")) -> SafetyCritic:
    return SafetyCritic(
        SPEC,
        1,
        hidden=(4,),
        observation_key=("robot", "state"),
        action_key=action_key,
        logit_key=("danger", "logit"),
        risk_key=("danger", "risk"),
        safety_key=("danger", "safety"),
    )


def test_the_critic_takes_its_keys():
    critic = nested_critic()
    assert critic.in_keys == [("robot", "state"), ("agent", "move")]
    assert critic.out_keys == [("danger", "logit"), ("danger", "risk"), ("danger", "safety")]
    td = critic(TensorDict({"robot": {"state": torch.randn(5, 1)}, "agent": {"move": torch.zeros(5, 1)}}, [5]))
    torch.testing.assert_close(td["danger", "risk"], td["danger", "logit"].sigmoid().amax(-1, keepdim=True))
    assert torch.equal(td["danger", "safety"], -td["danger", "risk"])


def test_the_loss_takes_the_critics_keys_and_others_by_set_keys():
    critic = nested_critic()
    policy = gaussian_actor(SPEC, 1, hidden=(4,), observation_key=("robot", "state"), action_key=("agent", "move"))
    loss = lagged(critic, policy)
    assert loss.in_keys == [
        ("robot", "state"),
        ("next", "robot", "state"),
        ("agent", "move"),
        ("next", "constraint"),
    ]
    z, z_next, action, violated = torch.randn(5, 1), torch.randn(5, 1), torch.randn(5, 1), torch.rand(5, 1) > 0.5
    batch = TensorDict(
        {
            "robot": {"state": z},
            "agent": {"move": action},
            "next": {"robot": {"state": z_next}, "constraint": violated},
        },
        [5],
    )
    torch.manual_seed(1)
    expected = loss(batch)["loss_safety"]
    loss.set_keys(observation="z", next_observation=("after", "z"), action="a", constraint=("after", "hit"))
    renamed = TensorDict({"z": z, "a": action, "after": {"z": z_next, "hit": violated}}, [5])
    torch.manual_seed(1)
    assert torch.equal(loss(renamed)["loss_safety"], expected)
    loss.set_keys(observation=None, next_observation=None, action=None, constraint=None)
    assert loss.in_keys[:2] == [("robot", "state"), ("next", "robot", "state")]


def foreign_critic() -> TensorDictModule:
    """A critic without members or keys of ours: the logit is z + a / 2."""
    linear = nn.Linear(2, 1, bias=False)
    with torch.no_grad():
        linear.weight.copy_(torch.tensor([[1.0, 0.5]]))

    class Critic(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.linear = linear

        def forward(self, state: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            logit = self.linear(torch.cat([state, action], -1))
            return logit, logit.sigmoid()

    return TensorDictModule(Critic(), ["state", "u"], [("c", "logit"), ("c", "probability")])


def test_the_loss_of_a_critic_and_a_policy_of_other_makes():
    critic = foreign_critic()
    policy = TensorDictModule(lambda z: torch.full_like(z, -1.0), [("my", "state")], [("my", "move")])
    loss = lagged(critic, policy, gamma=0.5)
    loss.set_keys(risk=("c", "probability"), policy_action=("my", "move"))
    z, action, z_next = torch.randn(5, 1), torch.randn(5, 1), torch.randn(5, 1)
    violated = torch.tensor([[True], [False], [False], [True], [False]])
    batch = TensorDict({"state": z, "u": action, "next": {"state": z_next, "constraint": violated}}, [5])
    target = torch.where(violated, 1.0, 0.5 * (z_next - 0.5).sigmoid())
    by_hand = nn.functional.binary_cross_entropy((z + 0.5 * action).sigmoid(), target)
    losses = loss(batch)
    torch.testing.assert_close(losses["loss_safety"], by_hand)
    losses["loss_safety"].backward()
    assert critic.module.linear.weight.grad.abs().sum() > 0
    loss.set_keys(risk="risk")
    with pytest.raises(KeyError, match=r"SafetyCriticLoss, of its critic, needs the keys \['risk'\]"):
        loss(batch)
    loss.set_keys(policy_action="action")
    with pytest.raises(KeyError, match=r"SafetyCriticLoss, of its policy, needs the keys \['action'\]"):
        loss(batch)


def test_recovery_among_modules_of_other_makes_and_keys():
    task = TensorDictModule(lambda z: (torch.full_like(z, 1.5), z), [("robot", "state")], [("agent", "move"), "note"])
    recovery = TensorDictModule(lambda z: torch.full_like(z, -1.5), [("robot", "state")], [("agent", "back")])
    critic = TensorDictModule(lambda z, a: z.sigmoid(), [("robot", "state"), "u"], [("danger", "p")])
    policy = RecoveryPolicy(
        task,
        recovery,
        critic,
        0.5,
        action_key=("agent", "move"),
        recovery_action_key=("agent", "back"),
        risk_key=("danger", "p"),
        task_action_key=("agent", "wanted"),
        recovered_key=("agent", "recovered"),
    )
    z = torch.tensor([[-1.0], [1.0]])
    td = policy(TensorDict({"robot": {"state": z}}, [2]))
    assert td["agent", "move"].flatten().tolist() == [1.5, -1.5]
    assert td["agent", "wanted"].flatten().tolist() == [1.5, 1.5]
    assert td["agent", "recovered"].flatten().tolist() == [False, True]
    torch.testing.assert_close(td["danger", "p"], z.sigmoid())
    assert policy.in_keys == [("robot", "state")]
    written = {key for key in td.keys(include_nested=True, leaves_only=True) if key != ("robot", "state")}
    assert written == set(policy.out_keys)


def test_the_critics_own_risk_key_is_taken():
    critic = nested_critic()
    task = constant(1.0, ("robot", "state"))
    policy = RecoveryPolicy(task, constant(-1.0, ("robot", "state")), critic, 0.5)
    assert policy.risk_key == ("danger", "risk")
    state = torch.randn(4, 1)
    td = policy(TensorDict({"robot": {"state": state}}, [4]))
    by_hand = critic.logits(state, torch.ones(4, 1)).amax(-1, keepdim=True).sigmoid()
    torch.testing.assert_close(td["danger", "risk"], by_hand)


@pytest.mark.parametrize(
    ("role", "options"),
    [
        ("task", {"action_key": "move"}),
        ("recovery", {"recovery_action_key": ("agent", "back")}),
        ("safety_critic", {"risk_key": "danger"}),
    ],
)
def test_a_module_that_does_not_write_its_key_is_refused(role: str, options: dict):
    with pytest.raises(
        ValueError, match=rf"RecoveryPolicy expects {role} to write .*Pass the key as {next(iter(options))}"
    ):
        RecoveryPolicy(constant(1.0), constant(-1.0), linear_critic(1.0, 0.0), 0.5, **options)


def test_a_risk_that_would_broadcast_over_actions_is_refused():
    critic = TensorDictModule(lambda z, a: z.squeeze(-1).sigmoid(), ["loc", "action"], ["risk"])
    policy = RecoveryPolicy(constant(1.0), constant(-1.0), critic, 0.5)
    with pytest.raises(ValueError, match=r"one risk for each action, of shape \[4, 1\] under 'risk', got \[4\]"):
        policy(TensorDict({"loc": torch.zeros(4, 1)}, [4]))


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_the_policy_computes_in_the_dtype_it_was_moved_to(dtype: torch.dtype):
    critic = SafetyCritic(SPEC, 3, hidden=(8,))
    policy = RecoveryPolicy(
        gaussian_actor(SPEC, 3, hidden=(8,)), deterministic_actor(SPEC, 3, hidden=(8,)), critic, 0.5
    )
    z = torch.randn(6, 3)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        before = policy(TensorDict({"loc": z}, [6]))
        after = policy.to(dtype)(TensorDict({"loc": z.to(dtype)}, [6]))
    assert after["risk"].dtype == dtype
    tolerance = 1e-5 if dtype == torch.float64 else 0.03
    for key in ("risk", "task_action"):
        torch.testing.assert_close(after[key].double(), before[key].double(), atol=tolerance, rtol=tolerance)
