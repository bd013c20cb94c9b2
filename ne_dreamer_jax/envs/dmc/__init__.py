"""The DeepMind Control Suite on MJX, stepped, rewarded and observed as dm_control does it.

Each domain is a module whose ``load(task)`` gives a ``common.Task``; ``environment`` makes an environment of it.
"""

from __future__ import annotations

import importlib

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.dmc import environment
from ne_dreamer_jax.envs.dmc.common import Task

__all__ = ["Task", "load", "make"]

_OBSERVATIONS = ("pixels", "vector", "both")


def load(domain: str, task: str) -> Task:
    """The definition of a task, from the module named after its domain."""
    return importlib.import_module(f"ne_dreamer_jax.envs.dmc.{domain}").load(task)


def make(domain: str, task: str, *, obs: str = "pixels", action_repeat: int = 2, image_size: int = 64) -> base.Env:
    """Makes a Control Suite environment. Its ``env_state.physics`` is the ``mjx.Data``.

    Args:
      domain, task: as the registry lists them.
      obs: ``"pixels"``: ``image``, uint8 [image_size, image_size, 3]; ``"vector"``: dm_control's own observations
        under their own names, float32; ``"both"``.
      action_repeat: control steps per step; their rewards are added up.
      image_size: height and width of the image in pixels.

    Raises:
      ValueError: an option has a bad value.
    """
    if obs not in _OBSERVATIONS:
        raise ValueError(f"expected obs to be one of {', '.join(_OBSERVATIONS)}, got {obs!r}")
    for name, value in (("action_repeat", action_repeat), ("image_size", image_size)):
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"expected {name} to be a positive int, got {value!r}")
    return base.from_core(environment.make_core(load(domain, task), obs, action_repeat, image_size))
