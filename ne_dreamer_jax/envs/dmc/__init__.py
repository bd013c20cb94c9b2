"""The DeepMind Control Suite on MJX, stepped, rewarded and observed as dm_control does it."""

from __future__ import annotations

import importlib
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.dmc.common import Episode, Task
from ne_dreamer_jax.envs.dmc.simulation import Integrated, integrated, mjx, substitute
from ne_dreamer_jax.types import Array, ArraySpec, ContinuousAction, EnvSpec

_MAX_VALUE = 1e10  # MuJoCo's own bound (mjMAXVAL) beyond which a position or velocity counts as broken
_OBSERVATIONS = ("pixels", "vector", "both")


class State(NamedTuple):
    """State of a task, between control steps."""

    physics: mjx.Data
    episode: Episode
    steps_left: Array  # int32 [], control steps until the time limit


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
    return base.from_core(core(load(domain, task), obs, action_repeat, image_size))


def core(task: Task, obs: str, action_repeat: int, image_size: int) -> base.Core:
    """The task as a simulation for ``base.from_core``; arguments as in ``make``."""
    simulation = task.simulation
    time_limit = math.ceil(round(task.time_limit / simulation.control_timestep, 6))  # in control steps
    low, high = simulation.mj_model.actuator_ctrlrange.astype("float32").T
    middle, half = (high + low) / 2, (high - low) / 2

    if obs != "vector":
        from ne_dreamer_jax import render

        scene = render.build(simulation.mj_model, task.camera, height=image_size, width=image_size)

    initial, no_action = simulation.initial(), jnp.zeros(simulation.mj_model.nu)
    yes, no = jnp.ones((), bool), jnp.zeros((), bool)

    def reset(key: Array) -> State:
        if task.coast:
            blank = State(initial, task.episode, jnp.zeros((), jnp.int32))
            return step(blank, no_action, yes, key)[0]
        start, episode = task.reset(key)
        return State(simulation.begin(start), episode, jnp.full((), time_limit, jnp.int32))

    def step(state: State, action: Array, restart: Array, key: Array) -> tuple[State, base.Progress]:
        def draw() -> tuple[Integrated, Episode]:
            start, episode = task.reset(key)
            return integrated(start), episode

        start, episode = base.if_needed(restart, draw, (integrated(state.physics), state.episode))
        control = jnp.where(restart, 0.0, middle + half * action)

        def control_step(number: Array, carry: tuple[mjx.Data, Array]) -> tuple[mjx.Data, Array]:
            data, reward = carry
            if task.coast:
                # From the drawn state but, as in dm_control, with the default state's forces in the first step.
                data = substitute(data, restart & (number == 1), start)
                data = simulation.advance(data, control, restart & (number == 0), integrated(initial))
            else:
                data = simulation.advance(data, control, restart, start)
            return data, reward + task.reward(data, episode)

        # Where the time limit is no multiple of the repeat, the last step of an episode is shorter.
        repeat: Any = action_repeat
        if time_limit % action_repeat:
            repeat = jnp.where(restart, action_repeat, jnp.minimum(action_repeat, state.steps_left))
        turns = jnp.where(restart, 1 + task.coast, repeat) if task.coast else repeat
        data, reward = jax.lax.fori_loop(0, turns, control_step, (state.physics, jnp.zeros((), jnp.float32)))
        if task.coast:
            data = data.replace(time=jnp.where(restart, 0.0, data.time))
        steps_left = jnp.where(restart, time_limit, state.steps_left - repeat)
        sound = (jnp.abs(data.qpos) <= _MAX_VALUE).all() & (jnp.abs(data.qvel) <= _MAX_VALUE).all()
        return State(data, episode, steps_left), base.Progress(reward, steps_left <= 0, is_terminal=no, is_sound=sound)

    def observe(state: State) -> dict[str, Array]:
        observation = {}
        if obs != "vector":
            observation["image"] = render.draw(scene, task.pose(state.physics, state.episode))
        if obs != "pixels":
            vectors = task.observe(state.physics, state.episode)
            observation |= {name: value.astype(jnp.float32) for name, value in vectors.items()}
        return observation

    shapes = {}
    if obs != "vector":
        shapes["image"] = ArraySpec((image_size, image_size, 3), jnp.uint8)
    if obs != "pixels":
        vectors: Any = jax.eval_shape(task.observe, simulation.initial(), task.episode)
        shapes |= {name: ArraySpec(value.shape, jnp.float32) for name, value in vectors.items()}
    spec = EnvSpec(shapes, ContinuousAction(simulation.mj_model.nu))
    return base.Core(spec, reset, step, observe)
