"""Craftax and Craftax-Classic, as symbols or pixels.

gymnax's style, with one ``done``: what ends an episode but ``params.max_timesteps`` is terminal (see `gymnax`).
The pictures of Craftax-Classic (63 x 63) and Craftax (130 x 110) become ``image_size`` squares.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.adapters import common
from ne_dreamer_jax.envs.adapters.gymnax import from_gymnax, replaced, without_drawing
from ne_dreamer_jax.system.numerics import in_32_bits

NAMES = ("Craftax-Classic-Pixels-v1", "Craftax-Classic-Symbolic-v1", "Craftax-Pixels-v1", "Craftax-Symbolic-v1")


def names() -> tuple[str, ...]:
    """The library's environments."""
    return NAMES


@in_32_bits
def make(task: str, image_size: int | None = 64, params: Mapping[str, Any] | None = None) -> base.Env:
    """Makes one of the environments. The first time in an installation, the library prepares textures for a minute.

    Args:
      params: fields of the parameters to set, such as ``{"max_timesteps": 1000}``.
    """
    with common.library_rules():
        from craftax.craftax_env import make_craftax_env_from_name

        env = make_craftax_env_from_name(task, auto_reset=False)
        draw = env.get_obs
        without_drawing(env)
        return from_gymnax(env, replaced(env.default_params, params), image_size=image_size, draw=draw)
