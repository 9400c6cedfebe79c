"""Carrying particles through plans with a snapshot of the dynamics: all particles of a member in one product."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ls3_torchrl.layers import run_layers, run_stacked
from ls3_torchrl.modules.dynamics import EnsembleDynamics
from ls3_torchrl.modules.relu import relu_
from ls3_torchrl.planners.snapshot import Snapshot


class Grouping(NamedTuple):
    """How the particles of one step are put together by the member that moves them.

    Attributes:
        sorted: particles, those of one member after those of another, int64 ``[P]``.
        back: where each particle went, int64 ``[P]``.
        members: members that move any, with how many each moves.
    """

    sorted: Tensor
    back: Tensor
    members: list[tuple[int, int]]


def group_by_member(members: Tensor) -> list[Grouping]:
    """Of members ``[H, P]`` that move particles, the grouping of each step."""
    sorts, backs, counts = [], [], []
    for step in members.tolist():  # in plain Python: these are a hundred numbers, and an operation on tensors is slow
        sorts.append(sorted(range(len(step)), key=step.__getitem__))
        backs.append(sorted(range(len(step)), key=sorts[-1].__getitem__))
        counts.append([(m, step.count(m)) for m in sorted(set(step))])
    orders = torch.tensor(sorts + backs).unbind()
    return [Grouping(*of_step) for of_step in zip(orders[: len(sorts)], orders[len(sorts) :], counts, strict=True)]


def unroll(
    dynamics: EnsembleDynamics,
    snapshot: Snapshot,
    latent: Tensor,
    row_of: Tensor | None,
    plan: Tensor,
    members: Tensor,
    groups: list[Grouping] | None,
    noise: Tensor | None,
) -> Tensor:
    """P particles of R plans: the latents ``[H, P, R, D]`` that they visit, in layer precision.

    Args:
        dynamics: whose layers the snapshot holds.
        snapshot: the layers.
        latent: where plans start, ``[k, D]``.
        row_of: the latent of each plan, int64 ``[R]``; ``None`` when there is one for all.
        plan: actions ``[H, R, A]``.
        members: member that moves each particle, ``[H, P]``.
        groups: the same, grouped; with ``None`` the weights are gathered instead, and nothing waits for the device.
        noise: ``[H, P, R or 1, D]``; ``None`` when it is zero.
    """
    (horizon, rows, _), particles, d = plan.shape, members.shape[1], latent.shape[-1]
    units = (plan / dynamics.action_scale).float()
    if dynamics.control_affine:
        units = units.unsqueeze(-1).expand(-1, -1, -1, d).contiguous()
    path = torch.empty(horizon, particles, rows, d, dtype=snapshot.dtype, device=latent.device)
    state, x = latent, latent.to(snapshot.dtype).expand(particles, -1, -1)
    for t, (unit, arrived) in enumerate(zip(units.unbind(), path.unbind(), strict=True)):
        if not dynamics.control_affine:
            x = _of_plans(x, row_of, rows) if t == 0 else x
            x = torch.cat([x, unit.to(x.dtype).expand(particles, -1, -1)], -1)
        output = _move_together(snapshot, x, members[t]) if groups is None else _move_by_member(snapshot, x, groups[t])
        output = output.float()
        if t == 0:
            # Control-affine networks have not seen any action yet: plans from one latent share what was written.
            output = _of_plans(output, row_of, rows) if dynamics.control_affine else output
            state = _of_plans(state, row_of, rows)
        delta, log_scale, *gain = output.split(d, -1)
        state = state + delta
        for change, along in zip(gain, unit.unbind(1), strict=False):  # none where the network has seen the action
            state.addcmul_(change, along)
        if noise is not None:
            state.addcmul_(log_scale.clamp(*dynamics.log_scale_bounds).exp_(), noise[t])
        x = arrived.copy_(state)
    return path


def _of_plans(x: Tensor, row_of: Tensor | None, rows: int) -> Tensor:
    """What is known of latents ``[..., k, n]`` for each plan ``[..., R, n]``."""
    return x.expand(*x.shape[:-2], rows, -1) if row_of is None else x.index_select(-2, row_of)


def _move_by_member(snapshot: Snapshot, x: Tensor, group: Grouping) -> Tensor:
    """The dynamics' output for particles ``[P, R, in]``, one member and all of its particles at a time."""
    x = x.index_select(0, group.sorted)
    counts = {count for _, count in group.members}
    if len(group.members) == len(snapshot.members) > 1 and len(counts) == 1:
        moved = run_stacked(x.reshape(len(group.members), -1, x.shape[-1]), snapshot.stacked)
    else:
        parts = x.split([count for _, count in group.members])
        moved = torch.cat(
            [
                run_layers(part.reshape(-1, x.shape[-1]), snapshot.members[member])
                for part, (member, _) in zip(parts, group.members, strict=True)
            ]
        )
    return moved.reshape(*x.shape[:-1], -1).index_select(0, group.back)


def _move_together(snapshot: Snapshot, x: Tensor, member: Tensor) -> Tensor:
    """The same in batched products with gathered weights: nothing here waits for the device."""
    last = len(snapshot.stacked) - 1
    for i, (weight, bias) in enumerate(snapshot.stacked):
        x = torch.baddbmm(bias[member], x, weight[member])
        if i < last:
            x = relu_(x)
    return x
