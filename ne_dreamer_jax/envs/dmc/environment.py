"""From a task's definition to a simulation for ``base.from_core``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.dmc.common import Episode, Task
from ne_dreamer_jax.envs.dmc.simulation import Integrated, integrated, mjx, substitute
from ne_dreamer_jax.types import Array, ArraySpec, ContinuousAction, EnvSpec

_MAX_VALUE = 1e10  # MuJoCo's own bound (mjMAXVAL) beyond which a position or velocity counts as broken


class State(NamedTuple):
    """State of a task, between control steps."""

    physics: mjx.Data  # settled
    episode: Episode
    steps_left: Array  # int32 [], control steps until the time limit


def make_core(task: Task, obs: str, action_repeat: int, image_size: int) -> base.Core:
    """The task as a ``Core``; arguments and errors as in ``dmc.from_task``."""
    simulation = task.simulation
    if not simulation.mj_model.nu:
        raise ValueError("expected a model with an actuator, which actions drive; got one without")
    unlimited = simulation.mj_model.actuator_ctrlrange[:, 0] >= simulation.mj_model.actuator_ctrlrange[:, 1]
    if unlimited.any():
        names = [simulation.mj_model.actuator(i).name or f"number {i}" for i in unlimited.nonzero()[0]]
        raise ValueError(f"expected a ctrlrange for each actuator, which actions are scaled to; got none for {names}")
    initial = simulation.initial()
    reward: Any = jax.eval_shape(task.reward, initial, task.episode)
    if getattr(reward, "shape", None) != ():
        raise ValueError(f"task.reward: expected a single number, float32 [], got {reward}")
    time_limit = math.ceil(round(task.time_limit / simulation.control_timestep, 6))  # in control steps
    low, high = simulation.mj_model.actuator_ctrlrange.astype("float32").T
    true, false = jnp.ones((), bool), jnp.zeros((), bool)

    def reset(key: Array) -> State:
        if task.coast:
            blank = State(initial, task.episode, jnp.zeros((), jnp.int32))
            return step(blank, jnp.zeros(simulation.mj_model.nu), true, key)[0]
        start, episode = task.reset(key)
        return State(simulation.begin(start), episode, jnp.full((), time_limit, jnp.int32))

    def step(state: State, action: Array, restart: Array, key: Array) -> tuple[State, base.Progress]:
        def draw() -> tuple[Integrated, Episode]:
            start, episode = task.reset(key)
            return integrated(start), episode

        start, episode = base.if_needed(restart, draw, (integrated(state.physics), state.episode))
        control = jnp.where(restart, 0.0, (high + low) / 2 + (high - low) / 2 * action)

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
        turns: Any = action_repeat
        if time_limit % action_repeat:
            turns = jnp.where(restart, action_repeat, jnp.minimum(action_repeat, state.steps_left))
        if task.coast:
            turns = jnp.where(restart, 1 + task.coast, turns)
        data, reward = jax.lax.fori_loop(0, turns, control_step, (state.physics, jnp.zeros((), jnp.float32)))
        data = data.replace(time=jnp.where(restart, 0.0, data.time))
        steps_left = jnp.where(restart, time_limit, state.steps_left - turns)
        sound = (jnp.abs(data.qpos) <= _MAX_VALUE).all() & (jnp.abs(data.qvel) <= _MAX_VALUE).all()
        progress = base.Progress(reward, is_last=steps_left <= 0, is_terminal=false, is_sound=sound)
        return State(data, episode, steps_left), progress

    spec, observe, pictures = _make_observe(task, obs, image_size)
    return base.Core(EnvSpec(spec, ContinuousAction(simulation.mj_model.nu)), reset, step, observe, pictures)


def _make_observe(
    task: Task, obs: str, image_size: int
) -> tuple[dict[str, ArraySpec], Callable[[State], dict[str, Array]], base.Pictures | None]:
    """What is observed, the function that observes it, and how its image can be drawn again."""
    spec: dict[str, ArraySpec] = {}
    pictures = None
    if obs != "vector":
        from ne_dreamer_jax import render

        scene = render.build(task.simulation.mj_model, task.camera, height=image_size, width=image_size)
        spec["image"] = ArraySpec((image_size, image_size, 3), jnp.uint8)
        pictures = base.Pictures(
            record=lambda state: render.record(scene, task.pose(state.physics, state.episode)),
            redraw=lambda vector: render.draw(scene, render.recorded(scene, vector)),
        )
    if obs != "pixels":
        vectors: Any = jax.eval_shape(task.observe, task.simulation.initial(), task.episode)
        _check_vectors(vectors, taken=spec)
        spec |= {name: ArraySpec(value.shape, jnp.float32) for name, value in vectors.items()}

    def observe(state: State) -> dict[str, Array]:
        observation = {}
        if obs != "vector":
            observation["image"] = render.draw(scene, task.pose(state.physics, state.episode))
        if obs != "pixels":
            vectors = task.observe(state.physics, state.episode)
            observation |= {name: value.astype(jnp.float32) for name, value in vectors.items()}
        return observation

    return spec, observe, pictures


def _check_vectors(vectors: Any, taken: Mapping[str, Any]) -> None:
    """Raises ValueError where these are no observations of a task beside those whose names are taken."""
    if not isinstance(vectors, Mapping):
        raise ValueError(f"task.observe: expected a dict of names and arrays, got {type(vectors).__name__}")
    for name, value in vectors.items():
        if name in taken:
            raise ValueError(f"task.observe: expected another name than {name!r}, which the pixels have")
        if len(value.shape) > 1:
            raise ValueError(
                f"task.observe: expected {name!r} to have at most one axis, got {list(value.shape)}; flatten it"
            )
