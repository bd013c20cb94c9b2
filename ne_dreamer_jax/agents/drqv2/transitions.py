"""From sequences out of replay to n-step transitions with stacked, shifted frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.types import Array, Batch


class Transitions(NamedTuple):
    """B transitions: ``obs`` and ``action``, and what n steps later is there to bootstrap from."""

    obs: Mapping[str, Array]  # [B, S, ...], the last S observations, oldest first
    action: Array  # float32 [B, A], taken from the last of obs
    reward: Array  # float32 [B], discounted sum of the rewards up to next_obs
    discount: Array  # float32 [B], of the value of next_obs; 0 where that is terminal
    next_obs: Mapping[str, Array]  # [B, S, ...]
    valid: Array  # bool [B], False where obs is an episode's last: no action was taken there


def n_step(batch: Batch, stack: int, discount: float) -> Transitions:
    r"""The transitions at step ``t = stack - 1`` of sequences of ``T = stack + n`` steps.

    With m the number of steps, at most n, until the episode of t ends,

    .. math:: R = \sum_{k=1}^{m} \gamma^{k-1} r_{t+k}, \quad \gamma^m (1 - \text{terminal}_{t+m})

    are the reward and the discount, and ``next_obs`` is the stack at t + m. (The authors' replay leaves out the
    starts whose n steps would cross the end; with fewer rewards they are the same estimate.) Frames of a stack from
    before the episode's first are replaced by that.
    """
    t, length = stack - 1, batch.reward.shape[1]
    ends = batch.is_last[:, :-1] | batch.is_first[:, 1:]  # [B, T - 1]: the step after is another episode's
    going = jnp.cumprod((~ends[:, t:]).astype(jnp.int32), axis=1)  # [B, n], whether step t + k is the same episode's
    powers = discount ** jnp.arange(length - stack + 1, dtype=jnp.float32)
    reward = jnp.sum(going.astype(jnp.float32) * powers[None, :-1] * batch.reward[:, stack:], axis=1)
    steps = jnp.sum(going, axis=1)  # m
    at = t + steps
    terminal = jnp.take_along_axis(batch.is_terminal, at[:, None], axis=1)[:, 0]
    return Transitions(
        obs=_stack(batch, jnp.full_like(at, t), stack),
        action=batch.action[:, t],
        reward=reward,
        discount=jnp.where(terminal, 0.0, powers[steps]),
        next_obs=_stack(batch, at, stack),
        valid=steps > 0,
    )


def _stack(batch: Batch, at: Array, stack: int) -> dict[str, Array]:
    """The observations ``[B, S, ...]`` up to step ``at [B]`` of each sequence."""
    steps = jnp.arange(batch.reward.shape[1], dtype=jnp.int32)[None]
    first = jnp.max(jnp.where(batch.is_first & (steps <= at[:, None]), steps, 0), axis=1)  # 0: earlier, out of reach
    index = jnp.maximum(at[:, None] + jnp.arange(1 - stack, 1, dtype=jnp.int32)[None], first[:, None])
    rows = jnp.arange(at.shape[0], dtype=jnp.int32)[:, None]
    return {name: x.at[rows, index].get(mode="promise_in_bounds") for name, x in batch.obs.items()}


def random_shift(key: Array, stacked: Mapping[str, Array], pixels: int) -> dict[str, Array]:
    """Moves the images of each stack together by up to ``pixels``, the border repeated; vectors stay as they are.

    A random crop of the padded image. It is what the authors' bilinear sampling computes, whose shifts are whole
    pixels: between pixels there is nothing to interpolate.
    """
    images = {name: x for name, x in stacked.items() if x.dtype == jnp.uint8}
    if not images:
        return dict(stacked)
    count = next(iter(images.values())).shape[0]
    offset = jax.random.randint(key, (count, 2), 0, 2 * pixels + 1)
    return {**stacked, **{name: crop(x, offset, pixels) for name, x in images.items()}}


def crop(images: Array, offset: Array, pixels: int) -> Array:
    """``[B, S, H, W, C]`` padded by ``pixels`` of its border, cut to its size at ``offset`` (int32 ``[B, 2]``)."""
    around = (pixels, pixels)
    padded = jnp.pad(images, ((0, 0), (0, 0), around, around, (0, 0)), mode="edge")
    zero = jnp.zeros((), offset.dtype)
    cut = lambda x, at: jax.lax.dynamic_slice(x, (zero, at[0], at[1], zero), images.shape[1:])
    return jax.vmap(cut)(padded, offset)
