"""gymnax, and environments of its style: ``reset_env(key, params)``, ``step_env(key, state, action, params)``.

Time limits, by what the environment has, in this order:

1. ``is_truncated`` (gymnax 1.x): the two are told apart by the library.
2. ``info["truncated"]``: an episode that is done with it set was cut. Where it would also have ended by itself in
   that very step it counts as cut, since some libraries' ``info["terminated"]`` is set by a time limit, too.
3. ``params.max_steps_in_episode`` (or ``max_timesteps``): older environments return one ``done`` for both. What ends
   an episode by itself is what ``is_terminal`` says with that limit taken away.
4. none of these: every end is terminal.

Observations are those that ``step_env`` returns, also where, as in MemoryChain, it returns the one before the step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.adapters import common
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import Array

LIMITS = ("max_steps_in_episode", "max_timesteps")
_NEVER = 2**31 - 1


def names() -> tuple[str, ...]:
    """The names of gymnax's registry."""
    import gymnax

    return tuple(gymnax.registered_envs)


@in_32_bits
def make(
    task: str,
    image_size: int | None = 64,
    params: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> base.Env:
    """Makes an environment of gymnax's registry.

    Args:
      params: fields of its parameters to set, such as ``{"memory_length": 20}``.
      settings: arguments for its constructor, such as ``{"num_bits": 3}``.

    Raises:
      ValueError: as of ``from_gymnax``, or a parameter that it has not.
    """
    import gymnax

    with common.library_rules():
        env, defaults = gymnax.make(task, **(settings or {}))
        return from_gymnax(env, replaced(defaults, params), image_size=image_size)


@in_32_bits
def from_gymnax(
    env: Any, params: Any = None, *, image_size: int | None = 64, draw: Callable[[Any], Any] | None = None
) -> base.Env:
    """Makes an environment of a gymnax-style one. The library's state is ``env_state.core.env``.

    Args:
      params: the environment's parameters; none: its ``default_params``.
      image_size: height and width of images in pixels; None leaves them as they are.
      draw: state -> observation, for environments whose observation depends on the state alone: drawing once a step
        what ``step_env`` may draw in each branch, and ``reset_env`` again. ``env`` need then not draw at all.

    Raises:
      ValueError: as of `common.adapt`.
    """
    if params is None:
        params = env.default_params

    def reset(key: Array) -> tuple[Any, Any]:
        obs, state = env.reset_env(key, params)
        return state, obs

    def step(state: Any, action: Array, key: Array) -> common.Outcome:
        obs, state, reward, done, info = env.step_env(key, state, action, params)
        is_last, is_terminal = ends(env, params, state, done, info)
        return common.Outcome(state, obs, reward, is_last, is_terminal)

    return common.adapt(
        reset,
        step,
        env.observation_space(params),
        env.action_space(params),
        image_size,
        draw,
    )


def ends(env: Any, params: Any, state: Any, done: Any, info: Mapping[str, Any]) -> tuple[Array, Array]:
    """Whether a step was the last of its episode, and whether it ended in a terminal state; see the module.

    Args:
      state: after the step.
      done, info: what ``step_env`` returned.
    """
    done = common.scalar("done", done, jnp.bool_)
    if hasattr(env, "is_truncated"):
        return done | common.scalar("is_truncated", env.is_truncated(state, params), jnp.bool_), done
    if "truncated" in info:
        return done, done & ~common.scalar('info["truncated"]', info["truncated"], jnp.bool_)
    limit = next((name for name in LIMITS if hasattr(params, name)), None)
    if limit is None:
        return done, done
    unlimited = dataclasses.replace(params, **{limit: type(getattr(params, limit))(_NEVER)})
    return done, done & common.scalar("is_terminal", env.is_terminal(state, unlimited), jnp.bool_)


def replaced(params: Any, changes: Mapping[str, Any] | None) -> Any:
    """Parameters with some fields set. Raises ValueError for names of none."""
    changes = changes or {}
    known = [field.name for field in dataclasses.fields(params)] if dataclasses.is_dataclass(params) else []
    if unknown := sorted(set(changes) - set(known)):
        raise ValueError(f"expected params among {', '.join(known) or 'none'}, got {', '.join(unknown)}")
    return dataclasses.replace(params, **changes) if changes else params


def without_drawing(env: Any) -> None:
    """Has an environment return nothing to see from ``step_env`` and ``reset_env``."""
    env.get_obs = lambda *args, **options: jnp.zeros((), jnp.uint8)
