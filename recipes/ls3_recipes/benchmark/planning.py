"""How long plans take, how many operations they are, and what bf16 changes in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from statistics import fmean, median
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Bounded

from ls3_recipes.algorithms.settings.ls3 import LS3Settings
from ls3_recipes.benchmark.timing import Bench
from ls3_recipes.options import as_dict
from ls3_torchrl import LS3Agent
from ls3_torchrl.modules.ensemble import EnsembleMLP
from ls3_torchrl.planners import ImaginationNoise, LS3Planner


def permissive(agent: LS3Agent) -> LS3Agent:
    """Make every plan of an untrained agent feasible: the most work that a plan of four rounds can be."""
    with torch.no_grad():
        for head, bias in ((agent.constraint, -20.0), (agent.goal, -20.0), (agent.safe_set, 20.0)):
            layers = [layer for layer in head.network.modules() if isinstance(layer, nn.Linear)]
            layers[-1].bias.fill_(bias)
    return agent


def plan_flops(agent: LS3Agent, options: dict[str, Any]) -> float:
    """Floating-point operations of the matrix products in one plan of which every candidate is feasible."""

    def network(sizes: Sequence[int]) -> int:
        return sum(a * b for a, b in pairwise(sizes))

    def head(module: nn.Module) -> int:
        return sum(layer.weight.numel() for layer in module.modules() if isinstance(layer, nn.Linear))

    def member(net: EnsembleMLP) -> int:
        return network([net.weights[0].shape[1], *(weight.shape[2] for weight in net.weights)])

    steps = member(agent.dynamics.network) + head(agent.constraint) + head(agent.goal)
    end = head(agent.safe_set) + agent.value.num_members * member(agent.value.network)
    paths = options["num_candidates"] * options["num_particles"] * options["optim_steps"]
    return 2.0 * paths * (options["horizon"] * steps + end)


def time_plans(
    bench: Bench,
    settings: LS3Settings,
    spec: Bounded,
    batches: Sequence[int],
    device: torch.device,
    *,
    reference: bool,
) -> None:
    """Plans of a preset: the reference, the fused path in each precision, and batches of environments."""
    torch.manual_seed(0)
    agent = permissive(LS3Agent(action_spec=spec, **as_dict(settings.agent))).to(device)
    options, name = as_dict(settings.planner), settings.preset
    flops = plan_flops(agent, options)

    def planner(**changes: Any) -> LS3Planner:
        return agent.planner(spec, **(options | changes))

    def plan(policy: LS3Planner, batch: int) -> Callable[[], object]:
        latent = torch.randn(batch, agent.architecture.latent_dim, device=device)
        return lambda: policy.plan(latent)

    base = f"plan, {name}, reference"
    if reference:
        bench.time(base, plan(planner(engine="rollout"), 1))
    for precision in ("fp32", "bf16"):
        seconds = bench.time(f"plan, {name}, {precision}", plan(planner(precision=precision), 1), against=base)
        bench.rows[-1]["gflops"] = flops / seconds / 1e9
    for batch in batches:
        if batch > 1:
            figure = f"plan, {name}, auto, each of {batch}"
            bench.time(figure, plan(planner(), batch), per=batch, against=base)


@torch.no_grad()
def agreement(agent: LS3Agent, options: dict[str, Any], spec: Bounded, frames: Tensor) -> dict[str, float]:
    """What bf16 changes in the plans of a trained agent, from some images.

    Args:
        agent: trained; only then do its heads say anything.
        options: of a planner.
        spec: bounds of one action.
        frames: images ``[n, C, 64, 64]`` to plan from.

    Returns:
        ``value_error``: median over images of how far, relatively, the value of the plan chosen in bf16 lies from
        that of the plan chosen in fp32, both scored in fp32 under the same noise. ``feasibility``: fraction of random
        candidates whose feasibility the precisions disagree on.
    """
    exact, rough = (agent.planner(spec, **(options | {"precision": precision})) for precision in ("fp32", "bf16"))
    errors, disagreeing = [], []
    space = exact.action_spec.space
    for frame in frames:
        latent = exact.encode(TensorDict({"pixels": frame[None].to(space.low.device)}, [1]))
        noise = exact.sample_noise(1)
        plans = torch.cat([planner.plan(latent, noise=noise).actions for planner in (exact, rough)])[None]
        drawn = ImaginationNoise(noise.members[0], noise.dynamics[0])
        threshold = torch.full((1, 1), exact.safe_set_threshold or 0.0, device=latent.device)
        one, other = exact.score_plans(exact.imagine(latent, plans, drawn), threshold).score[0]
        errors.append(float((one - other).abs() / one.abs().clamp(min=1.0)))
        uniform = torch.rand(1, exact.optimizer.num_candidates, exact.horizon, *space.low.shape, device=latent.device)
        candidates = space.low + (space.high - space.low) * uniform
        verdicts = [p.score_plans(p.imagine(latent, candidates, drawn), threshold).feasible for p in (exact, rough)]
        disagreeing.append(float((verdicts[0] != verdicts[1]).float().mean()))
    return {"value_error": median(errors), "feasibility": fmean(disagreeing)}
