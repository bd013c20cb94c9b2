"""XLand-MiniGrid: grid worlds with a ``dm_env``-like time step.

Its observations are symbols, a tile and a colour for each field in view, and agents can't take them as numbers: with
``obs="vector"`` (the default: exact, and a small network's work) each is a one-hot vector, all in a row, ``vector`` of
V * V * (13 + 12); with ``obs="pixels"`` the library's own pictures of the tiles, ``image``.

An episode ends terminally where the time step's discount is 0, by its time limit (``max_steps``) where it isn't.
Steps are deterministic; what is drawn by chance within an episode comes from the state.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.adapters import common
from ne_dreamer_jax.envs.adapters.gymnax import replaced
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import Array

LAYERS = (13, 12)  # kinds of tiles, and of colours
_LAST = 2  # step_type, as in dm_env


def names() -> tuple[str, ...]:
    """The names of the library's registry."""
    import xminigrid

    return tuple(xminigrid.registered_environments())


@in_32_bits
def make(
    task: str, image_size: int | None = 64, obs: str = "vector", params: Mapping[str, Any] | None = None
) -> base.Env:
    """Makes an environment of the library's registry.

    Args:
      obs: ``"vector"`` or ``"pixels"``. For pixels the library keeps pictures of its tiles in ``~/.xland_minigrid``
        (or ``XLAND_MINIGRID_CACHE``).
      params: fields of the parameters to set, such as ``{"max_steps": 100}``.

    Raises:
      ValueError: an option has a bad value.
    """
    if obs not in ("vector", "pixels"):
        raise ValueError(f"expected obs to be vector or pixels, got {obs!r}")
    with common.library_rules():
        import xminigrid
        from xminigrid.core import constants

        env, defaults = xminigrid.make(task)
        if obs == "pixels":
            from xminigrid.experimental.img_obs import RGBImgObservationWrapper

            env = RGBImgObservationWrapper(env)
        layers = (constants.NUM_TILES, constants.NUM_COLORS) if obs == "vector" else None
        return from_xminigrid(env, replaced(defaults, params), image_size=image_size, layers=layers)


@in_32_bits
def from_xminigrid(
    env: Any, params: Any, *, image_size: int | None = 64, layers: tuple[int, ...] | None = LAYERS
) -> base.Env:
    """Makes an environment of one with ``reset(params, key)`` and ``step(params, timestep, action)``.

    Args:
      layers: number of kinds in each layer of symbols, an array [V, V, len(layers)] that is the observation or is
        called ``img`` in it; None where there are pictures.

    Raises:
      ValueError: as of `common.adapt`, or symbols of another number of layers.
    """

    def seen(obs: Any) -> Any:
        if layers is None:
            return obs
        if isinstance(obs, Mapping):
            return {name: one_hots(value, layers) if name == "img" else value for name, value in obs.items()}
        return one_hots(obs, layers)

    def reset(key: Array) -> tuple[Any, Any]:
        timestep = env.reset(params, key)
        return timestep, seen(timestep.observation)

    def step(timestep: Any, action: Array, key: Array) -> common.Outcome:
        timestep = env.step(params, timestep, action)
        is_last = timestep.step_type == _LAST
        return common.Outcome(
            timestep, seen(timestep.observation), timestep.reward, is_last, is_last & (timestep.discount == 0)
        )

    return common.adapt(reset, step, None, common.Discrete(int(env.num_actions(params))), image_size)


def one_hots(symbols: Array, layers: tuple[int, ...]) -> Array:
    """Symbols [V, V, L], ints, as one-hot float32 [V * V * sum(layers)]."""
    if symbols.shape[-1] != len(layers):
        raise ValueError(f"expected {len(layers)} layers of symbols, got an observation of shape {list(symbols.shape)}")
    hot = [jax.nn.one_hot(symbols[..., i], kinds, dtype=jnp.float32) for i, kinds in enumerate(layers)]
    return jnp.concatenate(hot, axis=-1).reshape(-1)
