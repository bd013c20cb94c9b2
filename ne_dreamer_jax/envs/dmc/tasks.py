"""Makes the environments of the Control Suite's tasks, and of tasks of one's own."""

from __future__ import annotations

import importlib
from typing import Any

import jax.numpy as jnp

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.dmc import environment, names
from ne_dreamer_jax.envs.dmc.common import Task
from ne_dreamer_jax.system.numerics import in_32_bits

_OBSERVATIONS = ("pixels", "vector", "both")


def load(domain: str, task: str) -> Task:
    """The definition of a task, from the module named after its domain."""
    return importlib.import_module(f"ne_dreamer_jax.envs.dmc.{domain}").load(task)


@in_32_bits
def make(name: str, **options: Any) -> base.Env:
    """Makes a Control Suite environment such as ``"dmc/walker_walk"``; options and errors as of ``from_task``."""
    _check(**options)
    return from_task(load(*names.split(name)), **options)


@in_32_bits
def from_task(
    task: Task, *, obs: str = "pixels", action_repeat: int = 2, image_size: int = 64, fast: bool = False
) -> base.Env:
    """Makes an environment of a task, one's own included. Its ``env_state.physics`` is the ``mjx.Data``.

    ``env_state.core`` is a `State`: ``core.physics`` again, and ``core.episode``, what the episode has drawn.

    Args:
      task: its ``simulation`` is ``Simulation.load("fish.xml")`` for a model of the Control Suite, or
        ``Simulation.of(mj_model)`` for any other.
      obs: ``"pixels"``: ``image``, uint8 [image_size, image_size, 3]; ``"vector"``: the task's own observations
        (dm_control's, under its names), float32; ``"both"``.
      action_repeat: control steps per step; their rewards are added up.
      image_size: height and width of the image in pixels.
      fast: solve constraints with a shorter line search than MuJoCo's, `Simulation.fast`.

    Raises:
      ValueError: an option has a bad value, the simulation was made in JAX's 64-bit mode, an actuator has no range or
        there is none, the task's reward or observations have other shapes than `Task` says, or the picture needs what
        the renderer does not draw (the message names it).
    """
    _check(obs=obs, action_repeat=action_repeat, image_size=image_size, fast=fast)
    if task.simulation.model.qpos0.dtype == jnp.float64:
        raise ValueError(
            "expected a task of 32 bits, got one whose simulation was made in JAX's 64-bit mode; make it within "
            "jax.enable_x64(False)"
        )
    if fast:
        task = task._replace(simulation=task.simulation.fast())
    return base.from_core(environment.make_core(task, obs, action_repeat, image_size))


def _check(obs: str = "pixels", action_repeat: int = 2, image_size: int = 64, fast: bool = False) -> None:
    """Raises ValueError for bad options, before a model is loaded."""
    if obs not in _OBSERVATIONS:
        raise ValueError(f"expected obs to be one of {', '.join(_OBSERVATIONS)}, got {obs!r}")
    for name, value in (("action_repeat", action_repeat), ("image_size", image_size)):
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"expected {name} to be a positive int, got {value!r}")
    if not isinstance(fast, bool):
        raise ValueError(f"expected fast to be True or False, got {fast!r}")
