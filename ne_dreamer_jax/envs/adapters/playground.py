"""MuJoCo Playground, on MJX's JAX implementation: its vectors, not its pictures, which need MuJoCo Warp.

Time limit and action repeat are those of the environment's configuration; `brax` says how ends are told apart. The
Control Suite's environments come with the package; those of locomotion and manipulation download robot models first.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.adapters import common
from ne_dreamer_jax.envs.adapters.brax import from_brax
from ne_dreamer_jax.system.numerics import in_32_bits


def names() -> tuple[str, ...]:
    """The names of Playground's registry."""
    from mujoco_playground import registry

    return tuple(registry.ALL_ENVS)


@in_32_bits
def make(task: str, image_size: int | None = 64, config: Mapping[str, Any] | None = None) -> base.Env:
    """Makes an environment of Playground's registry.

    Args:
      config: fields of its configuration to set, such as ``{"episode_length": 500, "action_repeat": 2}``.
    """
    with common.library_rules():
        from mujoco_playground import registry

        settings = registry.get_default_config(task)
        settings.update_from_flattened_dict({"impl": "jax", **(config or {})})
        env = registry.load(task, config=settings)
        return from_brax(
            env,
            episode_length=int(settings.episode_length),
            action_repeat=int(settings.action_repeat),
            image_size=image_size,
        )
