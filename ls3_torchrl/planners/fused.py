"""Imagining candidate plans fast: a snapshot of the networks, run over blocks that stay in cache."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from ls3_torchrl._checks import require_choice
from ls3_torchrl.layers import run_layers
from ls3_torchrl.options.planner import ConstraintReduction, Precision, SafeSetReduction
from ls3_torchrl.planners.fusable import require_fusable, why_not_fused
from ls3_torchrl.planners.imagination import ImaginationNoise, Limits
from ls3_torchrl.planners.latent_env import LatentEnv
from ls3_torchrl.planners.scoring import PlanStatistics, feasible
from ls3_torchrl.planners.snapshot import Snapshot

#: Particles that are carried together: their widest layer stays in a core's cache, or fills a GPU.
_CPU_BLOCK, _GPU_BLOCK = 4096, 262_144
#: Particles of plans under which a part is not worth a core of its own.
_SMALLEST_PART = 1024
#: Members that move particles at one step, each with the particles it moves.
Groups = list[tuple[int, Tensor]]
Job = TypeVar("Job")
Result = TypeVar("Result")


def _by_member(members: Tensor) -> Groups:
    return [(m, (members == m).nonzero().flatten()) for m in members.unique().tolist()]


def _take_one_thread() -> None:
    torch.set_num_threads(1)


@lru_cache(maxsize=2)
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="imagination", initializer=_take_one_thread)


def _side_by_side(job: Callable[[Job], Result], items: Sequence[Job], workers: int) -> list[Result]:
    """Results of ``job`` on each item: whole items on each core, since layers this small gain nothing from sharing."""
    if workers < 2:
        return [job(item) for item in items]
    torch.set_num_threads(1)
    try:
        # One item alone is not handed over: it would only wait for a thread to wake.
        return [job(items[0])] if len(items) == 1 else list(_pool(workers).map(job, items))
    finally:
        torch.set_num_threads(workers)


class FusedImagination:
    """The same statistics as :class:`~ls3_torchrl.planners.RolloutImagination`, many times faster.

    It works on a snapshot of the weights, taken anew whenever a parameter has changed since. Plans of all rows lie one
    after another and are imagined in blocks, spread over the cores: memory grows with the block, not with B x N x P.
    Latents stay float32; the layers run in ``precision``.

    Args:
        env: the learned model; its modules must be those of :mod:`ls3_torchrl.modules`, or subclasses that override
            none of the methods whose work is done here.
        value: V, likewise.
        safe_set: f_S, likewise.
        constraint_reduction: over particles, ``"max"`` or ``"mean"``.
        safe_set_reduction: over particles, ``"mean"`` or ``"min"``.
        precision: ``"fp32"``, ``"bf16"``, or ``"auto"`` for what a short measurement finds faster here.
        block: particles that are carried together; by default what stays in a CPU's cache, or what fills a
            GPU.
        compiled: fuse the work on a block with ``torch.compile`` and replay it as a CUDA graph; by default on CUDA
            alone. Only blocks of the size that comes first are compiled, so that the rare plans for a few rows that
            start again cost no compilation.

    Raises:
        ValueError: for an unknown precision.
        TypeError: when a module would be bypassed; it says which, and why.
    """

    def __init__(
        self,
        env: LatentEnv,
        value: TensorDictModuleBase,
        safe_set: TensorDictModuleBase,
        *,
        constraint_reduction: ConstraintReduction = "max",
        safe_set_reduction: SafeSetReduction = "mean",
        precision: Precision = "auto",
        block: int | None = None,
        compiled: bool | None = None,
    ) -> None:
        require_choice(precision, ("auto", "fp32", "bf16"), "precision")
        require_fusable(env, value, safe_set)
        self.env, self.value, self.safe_set = env, value, safe_set
        self.constraint_reduction = constraint_reduction
        self.safe_set_reduction = safe_set_reduction
        self.precision = precision
        self.block = block
        self.compiled = compiled
        self._compiled_plans: int | None = None  # plans in a block that is worth compiling
        self._snapshot = Snapshot(env, value, safe_set, precision)
        self._parameters_fixed = False

    @staticmethod
    def supports(env: nn.Module, value: nn.Module, safe_set: nn.Module) -> bool:
        """Whether these modules can be run from a snapshot of their layers without bypassing any of their code."""
        return why_not_fused(env, value, safe_set) is None

    def __getstate__(self) -> dict[str, Any]:
        """All but what was compiled, which is compiled anew where it is needed."""
        kept = {name: value for name, value in vars(self).items() if name != "_replay"}
        return {**kept, "_compiled_plans": None, "_parameters_fixed": False}

    def refresh(self) -> bool:
        """Take the snapshot anew if a parameter changed; return whether it had."""
        return self._snapshot.refresh()

    @contextmanager
    def parameters_fixed(self) -> Iterator[None]:
        """Look for changed parameters now, and not again before the end: for several calls in a row, as in one plan."""
        self.refresh()
        self._parameters_fixed = True
        try:
            yield
        finally:
            self._parameters_fixed = False

    @torch.no_grad()
    def __call__(
        self, latent: Tensor, actions: Tensor, noise: ImaginationNoise, limits: Limits | None = None
    ) -> PlanStatistics:
        """Statistics of ``actions`` ``[b, N, H, A]`` carried out from ``latent`` ``[b, D]``.

        With ``limits``, plans that are not feasible under them get neither values nor goal probabilities (NaN): the
        planner masks their scores anyway, and most plans of a first round are not.
        """
        if not self._parameters_fixed:
            self.refresh()
        b, n, horizon, _ = actions.shape
        plans, on_cpu = b * n, latent.device.type == "cpu"
        compiled = not on_cpu if self.compiled is None else self.compiled
        if compiled or not on_cpu:
            limits = None  # which plans are feasible is known there alone: asking costs more than valuing them all
        workers = torch.get_num_threads() if on_cpu else 1
        parts = self._parts(plans, noise.members.shape[1], workers, on_cpu=on_cpu)
        if compiled and self._compiled_plans is None:
            self._compiled_plans = parts[0].stop
        # Rows of the batch lie one after another: a part may hold plans of several.
        row_of = torch.arange(b, device=latent.device).repeat_interleave(n)
        steps = actions.reshape(plans, horizon, -1).transpose(0, 1)
        groups = [_by_member(members) for members in noise.members] if on_cpu and not compiled else None

        def imagine(part: slice) -> PlanStatistics:
            rows, first = row_of[part], part.start // n
            alone = first == (part.stop - 1) // n
            if noise.noise.shape[3] == 1:
                drawn = noise.noise[first] if alone else noise.noise[rows, :, :, 0].permute(1, 2, 0, 3)
            else:
                drawn = noise.noise.permute(1, 2, 0, 3, 4).flatten(2, 3)[:, :, part]
            own = None if limits is None else limits._replace(safe_set_threshold=limits.safe_set_threshold[rows])
            start = latent[first : first + 1] if alone else latent[rows]
            plan = steps[:, part].contiguous()
            if compiled and plan.shape[1] == self._compiled_plans:
                torch.compiler.cudagraph_mark_step_begin()
                # Copies, since the next replay writes over what this one returns.
                return PlanStatistics(*(x.clone() for x in self._replay(start, plan, noise.members, None, drawn, None)))
            return self._imagine(start, plan, noise.members, groups, drawn, own)

        found = _side_by_side(imagine, parts, 1 if compiled else workers)
        return PlanStatistics(*(torch.cat(pieces).unflatten(0, (b, n)) for pieces in zip(*found, strict=True)))

    def _parts(self, plans: int, particles: int, workers: int, *, on_cpu: bool) -> list[slice]:
        """Plans that are imagined together: as many as a block holds, and no fewer than are worth a core."""
        block = self.block or (_CPU_BLOCK if on_cpu else _GPU_BLOCK)
        fraction = max(-(-plans // workers), -(-_SMALLEST_PART // particles))
        size = max(1, min(block // particles, fraction))
        return [slice(start, min(start + size, plans)) for start in range(0, plans, size)]

    @cached_property
    def _replay(self) -> Callable[..., PlanStatistics]:
        return torch.compile(self._imagine, dynamic=False, mode="reduce-overhead")

    @torch.no_grad()
    def _imagine(
        self,
        latent: Tensor,
        plan: Tensor,
        members: Tensor,
        groups: list[Groups] | None,
        noise: Tensor,
        limits: Limits | None,
    ) -> PlanStatistics:
        """Statistics of the plans ``[H, R, A]`` from latents ``[R or 1, D]`` under noise ``[H, P, R or 1, D]``."""
        horizon, r, _ = plan.shape
        particles, snapshot = noise.shape[1], self._snapshot
        path = self._unroll(latent, plan, members, groups, noise)
        violating = torch.stack([self._probability("constraint", states) for states in path], -1)  # [P, R, H]
        constraint = violating.amax(0) if self.constraint_reduction == "max" else violating.mean(0)
        in_safe_set = self._probability("safe_set", path[-1])
        safe = in_safe_set.amin(0) if self.safe_set_reduction == "min" else in_safe_set.mean(0)

        value, goal = latent.new_full((r, len(snapshot.value)), torch.nan), latent.new_full((r, horizon), torch.nan)
        found = PlanStatistics(value, goal, constraint, safe)
        wanted = torch.arange(r, device=latent.device)
        if limits is not None:
            allowed = feasible(
                found,
                safe_set_threshold=limits.safe_set_threshold.squeeze(-1),
                constraint_threshold=limits.constraint_threshold,
            )
            wanted = allowed.nonzero().flatten()
        if not len(wanted):
            return found
        kept = path if len(wanted) == r else [states[:, wanted] for states in path]
        goal[wanted] = torch.stack([self._probability("goal", states).mean(0) for states in kept], -1)
        ends = kept[-1].reshape(-1, kept[-1].shape[-1])
        values = [run_layers(ends, layers).float().reshape(particles, -1).mean(0) for layers in snapshot.value]
        value[wanted] = torch.stack(values, -1)
        return found

    def _probability(self, head: str, states: Tensor) -> Tensor:
        """Probabilities ``[...]`` by a head of latents ``[..., D]``."""
        logit = run_layers(states.reshape(-1, states.shape[-1]), self._snapshot.heads[head])
        return logit.float().sigmoid().reshape(states.shape[:-1])

    def _unroll(
        self, latent: Tensor, plan: Tensor, members: Tensor, groups: list[Groups] | None, noise: Tensor
    ) -> list[Tensor]:
        """P particles of every plan ``[H, R, A]``: the latents ``[P, R, D]`` they visit, in layer precision."""
        dynamics = self.env.dynamics
        particles, rows = members.shape[1], plan.shape[1]
        state = latent.expand(particles, rows, -1)
        path = []
        for t, action in enumerate(plan):
            x = dynamics.network_input(state, action.expand(particles, -1, -1)).to(self._snapshot.dtype)
            output = self._move_together(x, members[t]) if groups is None else self._move_by_member(x, groups[t])
            delta, log_scale = dynamics.read_output(output.float(), action)
            delta, log_scale = delta.float(), log_scale.float()  # they are wider where the action's unit is
            state = torch.addcmul(state + delta, log_scale.exp(), noise[t].expand_as(delta))
            path.append(state.to(self._snapshot.dtype))
        return path

    def _move_by_member(self, x: Tensor, groups: Groups) -> Tensor:
        """The dynamics' output for particles ``[P, R, in]``, one member and all of its particles at a time."""
        output = None
        for member, which in groups:
            mine = x[which] if len(groups) > 1 else x
            moved = run_layers(mine.reshape(-1, x.shape[-1]), self._snapshot.members[member]).reshape(
                *mine.shape[:-1], -1
            )
            if len(groups) == 1:
                return moved
            output = moved.new_empty(*x.shape[:-1], moved.shape[-1]) if output is None else output
            output[which] = moved
        assert output is not None
        return output

    def _move_together(self, x: Tensor, member: Tensor) -> Tensor:
        """The same in batched products with gathered weights: nothing here waits for the device."""
        last = len(self._snapshot.stacked) - 1
        for i, (weight, bias) in enumerate(self._snapshot.stacked):
            x = torch.baddbmm(bias[member], x, weight[member])
            if i < last:
                x = x.relu_()
        return x
