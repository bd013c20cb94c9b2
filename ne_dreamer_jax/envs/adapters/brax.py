"""Brax, and environments of its style: ``reset(key)`` and ``step(state, action)``, both giving a ``State``.

The state has ``obs``, ``reward``, ``done`` and ``info``. ``done`` is terminal; time limits are outside of these
environments and given as ``episode_length``. ``info["truncation"]``, which Brax's own time limit sets, is believed;
``info["time_out"]`` is not: Brax sets it, for its own bootstrapping, where a pole falls.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.adapters import common
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import Array


def names() -> tuple[str, ...]:
    """The names of Brax's registry."""
    from brax import envs

    return tuple(envs._envs)


@in_32_bits
def make(
    task: str,
    image_size: int | None = 64,
    episode_length: int = 1000,
    action_repeat: int = 1,
    settings: Mapping[str, Any] | None = None,
) -> base.Env:
    """Makes an environment of Brax's registry.

    Args:
      settings: arguments for its constructor, such as ``{"backend": "spring"}``.

    Raises:
      ValueError: an option has a bad value.
    """
    with common.library_rules():
        from brax import envs

        env = envs.get_environment(task, **(settings or {}))
        return from_brax(env, episode_length=episode_length, action_repeat=action_repeat, image_size=image_size)


@in_32_bits
def from_brax(env: Any, *, episode_length: int | None, action_repeat: int = 1, image_size: int | None = 64) -> base.Env:
    """Makes an environment of a Brax-style one, whose actions are in [-1, 1]. Its state is ``env_state.core.env[0]``.

    Args:
      episode_length: steps of the environment after which an episode is cut, also within one of the repeated steps;
        None: never.
      action_repeat: steps of the environment in one; their rewards are added up, until it is done or out of time.

    Raises:
      ValueError: an option has a bad value, or as of `common.adapt`.
    """
    for name, value in (("episode_length", episode_length), ("action_repeat", action_repeat)):
        if not (type(value) is int and value > 0) and not (name == "episode_length" and value is None):
            raise ValueError(f"expected {name} to be a positive int, got {value!r}")
    one = jnp.float32

    def reset(key: Array) -> tuple[Any, Any]:
        state = env.reset(key)
        return (state, jnp.zeros((), jnp.int32)), state.obs

    def out_of_time(steps: Array) -> Array:
        return jnp.zeros((), bool) if episode_length is None else steps >= episode_length

    def step(carried: tuple[Any, Array], action: Array, key: Array) -> common.Outcome:
        state, steps = carried

        def again(number: Array, carry: tuple[Any, Array]) -> tuple[Any, Array]:
            old, total = carry
            new = env.step(old, action)
            over = (common.scalar("done", old.done, jnp.bool_) | out_of_time(steps + number)) & (number > 0)
            kept = jax.tree.map(lambda x, y: jnp.where(over, x, y.astype(x.dtype)), old, common.cast(new, shapes(old)))
            return kept, total + jnp.where(over, 0.0, common.scalar("the reward", new.reward, one))

        if action_repeat == 1:
            state = env.step(state, action)
            total = common.scalar("the reward", state.reward, one)
        else:
            state, total = jax.lax.fori_loop(0, action_repeat, again, (state, jnp.zeros((), one)))
        steps = steps + action_repeat
        done = common.scalar("done", state.done, jnp.bool_)
        cut = common.scalar("truncation", state.info.get("truncation", False), jnp.bool_)
        return common.Outcome((state, steps), state.obs, total, done | out_of_time(steps), done & ~cut)

    size = int(env.action_size)
    return common.adapt(reset, step, None, common.Box(-1.0, 1.0, (size,), jnp.float32), image_size)


def shapes(tree: Any) -> Any:
    """Shapes and dtypes of a pytree of arrays."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)
