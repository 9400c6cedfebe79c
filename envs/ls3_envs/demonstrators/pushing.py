"""Sequential pushing's demonstrations: one block after another, and bursts that push too far (section 1.3.3)."""

from __future__ import annotations

import torch
from torch import Tensor

from ls3_envs.demonstrators.scripted import Scripted
from ls3_envs.pushing import GOAL_Y, MAX_STEP, block_positions, hand_position

#: Here the hand can move sideways without touching a block.
_CLEAR_Y = -0.1
_ALIGNED = 0.012
#: So far past the line is a block pushed: what stops on the line teaches that nearly there is as good as there.
_MARGIN = 0.015


def _steer(state: Tensor, block: Tensor, speed: float) -> Tensor:
    """Back off, align with a block, push it straight: actions ``[N, 2]`` towards the blocks ``[N]``."""
    hand, blocks = hand_position(state), block_positions(state)[..., :2]
    place = blocks[torch.arange(len(state), device=state.device), block]
    sideways = place[:, 0] - hand[:, 0]
    clear = hand[:, 1] <= _CLEAR_Y + 0.01
    aligned = sideways.abs() < _ALIGNED
    # Fast to the block, slow with it.
    ahead = (place[:, 1] - 0.06 - hand[:, 1]).clamp(min=speed, max=max(speed, 0.03))
    back = (_CLEAR_Y - hand[:, 1]).clamp(min=-MAX_STEP)
    along = torch.where(aligned, ahead, torch.where(clear, 0.0, back))
    across = torch.where(aligned | clear, sideways, 0.0).clamp(-MAX_STEP, MAX_STEP)
    return torch.stack([across, along], -1)


def _straight_at(state: Tensor, block: Tensor, speed: float) -> Tensor:
    """Straight to a block's centre from wherever the hand is: actions ``[N, 2]`` towards the blocks ``[N]``."""
    place = block_positions(state)[torch.arange(len(state), device=state.device), block, :2]
    return speed * torch.nn.functional.normalize(place - hand_position(state), dim=-1)


class PushingDemonstrator(Scripted):
    """Guides the hand to one block after another and pushes it to its goal, straight and slowly.

    The blocks' order is sampled for each episode: with always the same one, the hand's place alone would tell how much
    is done, and values learnt from such demonstrations look at the hand and not at the blocks.

    Args:
        noise_std: standard deviation of the noise on the displacements, in metres.
        seed: seed of that noise.

    Example:
        >>> from torchrl.envs import InitTracker, TransformedEnv
        >>> from ls3_envs import SequentialPushingEnv
        >>> env = TransformedEnv(SequentialPushingEnv(num_envs=2, seed=0), InitTracker())
        >>> episodes = env.rollout(100, PushingDemonstrator(seed=0))
        >>> bool(episodes["next", "success"].any(dim=1).all())
        True
    """

    def __init__(self, *, noise_std: float = 0.005, seed: int = 0) -> None:
        super().__init__(limit=MAX_STEP, noise_std=noise_std, seed=seed)

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        waiting = block_positions(state)[..., 1] <= GOAL_Y + _MARGIN
        order = self._for_the_episode("order", self._uniform(state, 3), is_init)
        action = _steer(state, order.masked_fill(~waiting, 2.0).argmin(-1), speed=0.012)
        retreat = torch.zeros_like(action)
        retreat[:, 1] = (_CLEAR_Y - hand_position(state)[:, 1]).clamp(min=-MAX_STEP)
        return torch.where(waiting.any(-1, keepdim=True), action, retreat)


class PushingViolator(Scripted):
    """Moves towards the blocks, with bursts of uniform actions in between: random and violating data.

    Each stretch between two bursts has a block of its own, sampled at random. Every other one, on average, goes
    straight at it from wherever the hand is, and hits it from the side, too; the others come from the front and push on
    and on.

    Use it with ``SequentialPushingEnv(start="random")``.

    Args:
        burst: probability per step that a burst begins.
        calm: probability per step that it ends.
        noise_std: standard deviation of the noise on the pushes, in metres.
        seed: seed of everything that is sampled.

    Example:
        >>> from torchrl.envs import InitTracker, TransformedEnv
        >>> from ls3_envs import SequentialPushingEnv
        >>> env = TransformedEnv(SequentialPushingEnv(num_envs=2, start="random", seed=0), InitTracker())
        >>> env.rollout(3, PushingViolator(seed=0)).batch_size
        torch.Size([2, 3])
    """

    def __init__(self, *, burst: float = 0.4, calm: float = 0.4, noise_std: float = 0.004, seed: int = 0) -> None:
        super().__init__(limit=MAX_STEP, noise_std=noise_std, seed=seed)
        self.burst, self.calm = burst, calm

    def _act(self, state: Tensor, step: Tensor, is_init: Tensor) -> Tensor:
        # Another block, and one of two manners, after each burst.
        any_block, any_manner = self._uniform(state, 1, 0.0, 3.0), self._uniform(state, 1)
        block = self._for_the_episode("block", any_block, is_init)
        manner = self._for_the_episode("manner", any_manner, is_init)
        bursting = self._for_the_episode("bursting", torch.zeros_like(state[:, :1]), is_init) > 0.5
        chance = self._uniform(state, 1)
        ends = bursting & (chance < self.calm)
        bursting = torch.where(bursting, ~ends, chance < self.burst)
        block, manner = torch.where(ends, any_block, block), torch.where(ends, any_manner, manner)
        self._kept |= {"block": block, "manner": manner, "bursting": bursting.to(state)}
        uniform = self._uniform(state, 2, -MAX_STEP, MAX_STEP)
        towards = block.long().squeeze(-1)
        steady = torch.where(manner < 0.5, _straight_at(state, towards, 0.04), _steer(state, towards, 0.04))
        return torch.where(bursting, uniform, steady)
