"""Imagining candidate plans fast: a snapshot of the networks, run over blocks that stay in cache."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from ls3_torchrl._checks import require_choice
from ls3_torchrl.layers import run_layers, run_stacked
from ls3_torchrl.options.planner import Precision, SafeSetReduction
from ls3_torchrl.planners.forked import HelperError, Helpers, may_fork
from ls3_torchrl.planners.fusable import require_fusable, why_not_fused
from ls3_torchrl.planners.imagination import ImaginationNoise, Limits
from ls3_torchrl.planners.latent_env import LatentEnv
from ls3_torchrl.planners.scoring import PlanStatistics, feasible
from ls3_torchrl.planners.snapshot import Snapshot
from ls3_torchrl.planners.unrolling import Grouping, group_by_member, unroll

#: Particles that are carried together: their widest layer stays in a core's cache, or fills a GPU.
_CPU_BLOCK, _GPU_BLOCK = 5120, 262_144
#: Particles of plans under which a part is not worth a core.
_SMALLEST_PART = 384
#: Calls with one snapshot, about two plans, before processes are forked for those that will follow.
_CALLS_BEFORE_FORK = 8
Item = TypeVar("Item")
Result = TypeVar("Result")


def _take_one_thread() -> None:
    torch.set_num_threads(1)


@lru_cache(maxsize=2)
def _pool(workers: int, process: int) -> ThreadPoolExecutor:  # a fork does not have the threads of its parent
    return ThreadPoolExecutor(workers, thread_name_prefix="imagination", initializer=_take_one_thread)


@contextmanager
def _one_core_each(workers: int) -> Iterator[None]:
    """Each part is computed on one core: layers this small gain nothing from sharing."""
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(workers)


def _in_threads(function: Callable[[Item], Result], items: Sequence[Item], workers: int) -> list[Result]:
    """Results of a function of each item, in as many threads as there are cores."""
    left, found = iter(enumerate(items)), {}

    def work() -> None:
        for i, item in left:
            found[i] = function(item)

    # This thread works too: a helper that has to wake first costs a good part of a small plan.
    helpers = [_pool(workers, os.getpid()).submit(work) for _ in range(min(workers, len(items)) - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            helper.result()
    return [found[i] for i in range(len(items))]


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
        safe_set_reduction: SafeSetReduction = "mean",
        precision: Precision = "auto",
        block: int | None = None,
        compiled: bool | None = None,
    ) -> None:
        require_choice(precision, ("auto", "fp32", "bf16"), "precision")
        require_fusable(env, value, safe_set)
        self.env, self.value, self.safe_set = env, value, safe_set
        self.safe_set_reduction = safe_set_reduction
        self.precision = precision
        self.block = block
        self.compiled = compiled
        self._compiled_plans: int | None = None  # plans in a block that is worth compiling
        self._snapshot = Snapshot(env, value, safe_set, precision)
        self._parameters_fixed = False
        self._helpers: Helpers | None = None
        self._reduced_by: tuple[Any, ...] = ()  # the helpers
        self._calls = 0  # with this snapshot, that processes would have shared

    @staticmethod
    def supports(env: nn.Module, value: nn.Module, safe_set: nn.Module) -> bool:
        """Whether these modules can be run from a snapshot of their layers without bypassing any of their code."""
        return why_not_fused(env, value, safe_set) is None

    def __getstate__(self) -> dict[str, Any]:
        """All but what was compiled, which is compiled anew where it is needed."""
        kept = {name: value for name, value in vars(self).items() if name != "_replay"}
        return {**kept, "_compiled_plans": None, "_parameters_fixed": False, "_helpers": None, "_calls": 0}

    def refresh(self) -> bool:
        """Take the snapshot anew if a parameter changed; return whether it had."""
        changed = self._snapshot.refresh()
        if changed:
            self._end_helpers()
        return changed

    def _end_helpers(self) -> None:
        if self._helpers is not None:
            self._helpers.end()
        self._helpers, self._calls = None, 0

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
        steps = actions.reshape(plans, horizon, -1).transpose(0, 1)
        groups = group_by_member(noise.members) if on_cpu and not compiled else None
        still = groups is not None and not noise.noise.any()  # then no particle needs its standard deviation

        def job_of(part: slice) -> tuple[Any, ...]:
            # Rows of the batch lie one after another: a part may hold plans of several.
            rows, row_of = _rows_of(part, n, latent.device)
            start, plan = latent[rows], steps[:, part].contiguous()
            drawn = None if still else _noise_of(noise.noise[rows], row_of)
            own = None if limits is None else limits._replace(safe_set_threshold=limits.safe_set_threshold[rows])
            if own is not None and row_of is not None:
                own = own._replace(safe_set_threshold=own.safe_set_threshold[row_of])
            if compiled and row_of is not None:
                start, row_of = start[row_of], None  # one shape for all blocks
            return start, row_of, plan, noise.members, groups, drawn, own

        if compiled:
            found = [self._compiled(*job_of(part)) for part in parts]
        else:
            found = self._side_by_side(job_of, parts, workers)
        return PlanStatistics(*(torch.cat(pieces).unflatten(0, (b, n)) for pieces in zip(*found, strict=True)))

    def _parts(self, plans: int, particles: int, workers: int, *, on_cpu: bool) -> list[slice]:
        """Plans that are imagined together: as many as a block holds, and no fewer than are worth a core."""
        block = self.block or (_CPU_BLOCK if on_cpu else _GPU_BLOCK)
        least = -(-plans // max(1, block // particles))
        useful = max(1, plans * particles // _SMALLEST_PART)
        # A multiple of the cores, so that none waits for the others' last block.
        number = max(least, -(-least // workers) * workers if useful >= workers else 1)
        size = -(-plans // max(1, min(number, plans)))
        return [slice(start, min(start + size, plans)) for start in range(0, plans, size)]

    def _side_by_side(
        self, job_of: Callable[[slice], tuple[Any, ...]], parts: Sequence[slice], workers: int
    ) -> list[PlanStatistics]:
        """What :meth:`_imagine` returns for each part, on as many cores as there are."""

        def imagine(part: slice) -> PlanStatistics:
            return self._imagine(*job_of(part))

        if workers < 2:
            return [imagine(part) for part in parts]
        with _one_core_each(workers):
            if len(parts) == 1:
                return [imagine(parts[0])]
            helpers = self._helpers_for(workers)
            if helpers is None or not helpers.in_use.acquire(blocking=False):
                return _in_threads(imagine, parts, workers)
            try:
                return helpers(self._imagine, parts, job_of)
            except HelperError:
                warnings.warn(
                    "A process that imagines plans has ended or fallen silent; threads take its place until the "
                    "weights change. The plans stay the same. Was memory short?",
                    RuntimeWarning,
                    stacklevel=2,
                )
                self._calls = -sys.maxsize
                return _in_threads(imagine, parts, workers)
            finally:
                helpers.in_use.release()
                if not helpers.end.alive:
                    self._helpers = None

    def _helpers_for(self, workers: int) -> Helpers | None:
        """Processes that have this snapshot, where they pay."""
        reduced_by = self.safe_set_reduction, self.block
        if self._helpers is not None and not self._helpers.are_mine:
            self._helpers, self._calls = None, 0
        if self._helpers is not None and (len(self._helpers) != workers - 1 or reduced_by != self._reduced_by):
            self._end_helpers()
        self._calls += 1
        if self._helpers is None and self._calls > _CALLS_BEFORE_FORK and may_fork():
            self._helpers, self._reduced_by = Helpers(self._imagine, workers - 1), reduced_by
        return self._helpers

    def _compiled(self, start: Tensor, row_of: Tensor | None, plan: Tensor, *others: Any) -> PlanStatistics:
        """What :meth:`_imagine` returns, by replay where the block has the size that is compiled."""
        if plan.shape[1] != self._compiled_plans:
            return self._imagine(start, row_of, plan, *others)
        torch.compiler.cudagraph_mark_step_begin()
        # Copies, since the next replay writes over what this one returns.
        return PlanStatistics(*(x.clone() for x in self._replay(start, row_of, plan, *others)))

    @cached_property
    def _replay(self) -> Callable[..., PlanStatistics]:
        return torch.compile(self._imagine, dynamic=False, mode="reduce-overhead")

    @torch.no_grad()
    def _imagine(
        self,
        latent: Tensor,
        row_of: Tensor | None,
        plan: Tensor,
        members: Tensor,
        groups: list[Grouping] | None,
        noise: Tensor | None,
        limits: Limits | None,
    ) -> PlanStatistics:
        """Statistics of the plans ``[H, R, A]``; the arguments are those of ``unroll``, and limits."""
        horizon, r, _ = plan.shape
        path = unroll(self.env.dynamics, self._snapshot, latent, row_of, plan, members, groups, noise)
        violating = self._probability("constraint", path)
        constraint = violating.amax(1)
        in_safe_set = self._probability("safe_set", path[-1])
        safe = in_safe_set.amin(0) if self.safe_set_reduction == "min" else in_safe_set.mean(0)

        value = latent.new_full((r, len(self._snapshot.value)), torch.nan)
        goal = latent.new_full((horizon, r), torch.nan)
        found = PlanStatistics(value, goal.T, constraint.T, safe)
        wanted = None  # all of them
        if limits is not None:
            allowed = feasible(
                found,
                safe_set_threshold=limits.safe_set_threshold.squeeze(-1),
                constraint_threshold=limits.constraint_threshold,
            )
            wanted = allowed.nonzero().flatten()
        if wanted is None or len(wanted) == r:
            return found._replace(value=self._value(path[-1]), goal_prob=self._probability("goal", path).mean(1).T)
        if len(wanted):
            kept = path.index_select(2, wanted)
            goal[:, wanted] = self._probability("goal", kept).mean(1)
            value[wanted] = self._value(kept[-1])
        return found

    def _rows_together(self, latent: Tensor) -> int:
        return self.block or (_CPU_BLOCK if latent.device.type == "cpu" else _GPU_BLOCK)

    def _probability(self, head: str, states: Tensor) -> Tensor:
        """Probabilities ``[...]`` by a head of latents ``[..., D]``."""
        rows, layers = states.reshape(-1, states.shape[-1]), self._snapshot.heads[head]
        pieces = rows.tensor_split(-(-len(rows) // self._rows_together(rows)))
        logits = [run_layers(piece, layers) for piece in pieces]
        logit = logits[0] if len(logits) == 1 else torch.cat(logits)
        return logit.float().sigmoid().reshape(states.shape[:-1])

    def _value(self, states: Tensor) -> Tensor:
        """Every member's value ``[R, M]``, in the mean over the particles, of latents ``[P, R, D]``."""
        snapshot, rows = self._snapshot, states.reshape(-1, states.shape[-1])
        members = len(snapshot.value)
        if len(rows) * members <= self._rows_together(rows):
            values = run_stacked(rows.expand(members, -1, -1), snapshot.stacked_value)
        else:
            values = torch.stack([run_layers(rows, layers) for layers in snapshot.value])
        return values.float().reshape(members, *states.shape[:-1]).mean(1).T


def _rows_of(part: slice, candidates: int, device: torch.device) -> tuple[slice, Tensor | None]:
    """Rows of the batch that plans of a part belong to, and for each plan which of these; ``None`` where it is one."""
    first, last = part.start // candidates, (part.stop - 1) // candidates
    if first == last:
        return slice(first, last + 1), None
    return slice(first, last + 1), torch.arange(part.start, part.stop, device=device) // candidates - first


def _noise_of(noise: Tensor, row_of: Tensor | None) -> Tensor:
    """Noise ``[H, P, R or 1, D]`` of a part's plans, which lie in rows with the noise ``[k, H, P, D]``."""
    return (noise if row_of is None else noise[row_of]).permute(1, 2, 0, 3)
