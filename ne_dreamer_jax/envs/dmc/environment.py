"""From a task's definition to a simulation for ``base.from_core``."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.dmc.common import Episode, Task
from ne_dreamer_jax.envs.dmc.simulation import FORCES, STATE, Start, mjx, start_of, substitute
from ne_dreamer_jax.types import Array, ArraySpec, ContinuousAction, EnvSpec

_MAX_VALUE = 1e10  # MuJoCo's own bound (mjMAXVAL) beyond which a position or velocity counts as broken


_CONSEQUENCES = sorted({field.name for field in dataclasses.fields(mjx.Data)} - {*STATE, *FORCES, "sensordata"})
"""What settling a state computes."""


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
    _check_numbers(task)
    initial = simulation.initial()
    _check_parts(task, initial)
    spec, observe, pictures = _make_observe(task, obs, image_size)
    fresh_forces = _reads_forces(task, initial)
    time_limit = math.ceil(round(task.time_limit / simulation.control_timestep, 6))  # in control steps
    low, high = simulation.mj_model.actuator_ctrlrange.astype("float32").T

    def blank() -> State:
        episode = jax.tree.map(jnp.asarray, task.episode)
        return State(initial, episode, jnp.zeros((), jnp.int32))

    def reset(key: Array) -> State:
        return step(blank(), jnp.zeros(simulation.mj_model.nu, jnp.float32), jnp.ones((), bool), key)[0]

    @jax.jit  # traced once for `reset` and for itself
    def step(state: State, action: Array, restart: Array, key: Array) -> tuple[State, base.Progress]:
        def draw() -> tuple[Start, Episode]:
            start, episode = task.reset(key)
            return start_of(start), episode

        start, episode = base.if_needed(restart, draw, (start_of(state.physics), state.episode))
        control = (high + low) / 2 + (high - low) / 2 * action
        if task.coast:
            control = jnp.where(restart, 0.0, control)

        def control_step(number: Array, carry: tuple[mjx.Data, Array, Array]) -> tuple[mjx.Data, Array, Array]:
            before, reward, ended = carry
            if task.coast:
                # From the drawn state but, as in dm_control, with the default state's forces in the first step.
                data = substitute(before, restart & (number == 1), start)
                data = simulation.advance(data, control, restart & (number == 0), start_of(initial), fresh_forces)
            else:
                data = simulation.advance(before, control, restart, start, fresh_forces)
            earned = task.reward(data, episode)
            if task.terminal is None:
                return data, reward + earned, ended
            # An episode that has ended stands still for the rest of the step.
            data = jax.tree.map(lambda old, new: jnp.where(ended, old, new), before, data)
            earned = jnp.where(ended, 0.0, earned)
            return data, reward + earned, ended | (task.terminal(data, episode) & ~restart)

        # Where the time limit is no multiple of the repeat, the last step of an episode is shorter.
        turns: Any = action_repeat
        if time_limit % action_repeat:
            turns = jnp.where(restart, action_repeat, jnp.minimum(action_repeat, state.steps_left))
        if task.coast:
            turns = jnp.where(restart, 1 + task.coast, turns)
        carry = (state.physics, jnp.zeros((), jnp.float32), jnp.zeros((), bool))
        data, reward, ended = jax.lax.fori_loop(0, turns, control_step, carry)
        data = data.replace(time=jnp.where(restart, start["time"], data.time))
        steps_left = jnp.where(restart, time_limit, state.steps_left - turns)
        sound = (jnp.abs(data.qpos) <= _MAX_VALUE).all() & (jnp.abs(data.qvel) <= _MAX_VALUE).all()
        progress = base.Progress(reward, is_last=(steps_left <= 0) | ended, is_terminal=ended, is_sound=sound)
        return State(data, episode, steps_left), progress

    env_spec = EnvSpec(spec, ContinuousAction(simulation.mj_model.nu))
    seconds = action_repeat * simulation.control_timestep
    return base.Core(env_spec, reset, step, observe, pictures, seconds, blank)


def _check_numbers(task: Task) -> None:
    """Raises ValueError where a task's time limit or coast is out of its range."""
    limit = task.time_limit
    longest = 2**30 * task.simulation.control_timestep
    if isinstance(limit, bool) or not isinstance(limit, int | float) or not 0 < limit <= longest:
        raise ValueError(f"task.time_limit: expected seconds, more than 0 and at most {longest:g}, got {limit!r}")
    if isinstance(task.coast, bool) or not isinstance(task.coast, int) or not 0 <= task.coast <= 1_000_000:
        raise ValueError(f"task.coast: expected a number of control steps, from 0 to 1,000,000, got {task.coast!r}")


def _check_parts(task: Task, initial: mjx.Data) -> None:
    """Raises ValueError where a task's functions don't return what `Task` says."""
    key = jax.random.key(0)
    drawn: list[str] = []

    def begin(key: Array) -> Any:
        result = task.reset(key)
        if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[0], mjx.Data)):
            got = _kind(result)
            if isinstance(result, tuple):
                got = f"a tuple of {', '.join(map(_kind, result)) or 'nothing'}"
            raise ValueError(
                f"task.reset: expected a pair of an mjx.Data and what the episode draws, got {got}; where it "
                "draws nothing else, return data, ()"
            )
        drawn.extend(name for name in _CONSEQUENCES if _differs(getattr(initial, name), getattr(result[0], name)))
        return result

    data, episode = jax.eval_shape(begin, key)
    base.expect_same("task.reset: its mjx.Data", initial, data)
    if drawn:
        _check_consequences(task, initial, key)
    wanted: Any = jax.tree.structure(task.episode)
    got: Any = jax.tree.structure(episode)
    if wanted != got:
        raise ValueError(
            f"task.reset: expected it to draw what task.episode is an example of, {wanted}, got {got}; give the task "
            "an example of what its reset draws, as episode="
        )
    base.expect_same("task.reset: what the episode draws", jax.eval_shape(lambda: _arrays(task.episode)), episode)
    number: Any = jax.eval_shape(task.reward, initial, _arrays(task.episode))
    if getattr(number, "shape", None) != ():
        raise ValueError(f"task.reward: expected a single number, float32 [], got {_kind(number)}")
    if task.terminal is not None:
        base.expect_same(
            "task.terminal",
            jax.ShapeDtypeStruct((), jnp.bool_),
            jax.eval_shape(task.terminal, initial, _arrays(task.episode)),
        )
    posed = jax.eval_shape(task.pose, initial, _arrays(task.episode))
    if not isinstance(posed, mjx.Data):
        raise ValueError(f"task.pose: expected an mjx.Data, got {_kind(posed)}")


def _differs(old: Array, new: Any) -> bool:
    """Whether a field may be another than the default state's, which is a constant also while a reset is traced."""
    return isinstance(new, jax.core.Tracer) or not np.array_equal(old, new, equal_nan=True)


def _check_consequences(task: Task, initial: mjx.Data, key: Array) -> None:
    """Raises ValueError where a reset sets by hand what follows from the state, and is computed anew."""
    first, settled = jax.jit(lambda key: (data := task.reset(key)[0], task.simulation.settle(data)))(key)
    for name in _CONSEQUENCES:
        got = getattr(first, name)
        if not any(np.allclose(got, getattr(data, name), atol=1e-4) for data in (initial, settled)):
            raise ValueError(
                f"task.reset: expected it to set fields among {', '.join(STATE)}, from which all others follow; got "
                f"{name} set too. What belongs to an episode alone can be drawn beside the state (Task.episode)"
            )


def _arrays(tree: Any) -> Any:
    return jax.tree.map(jnp.asarray, tree)


def _kind(x: Any) -> str:
    return str(x) if isinstance(x, jax.ShapeDtypeStruct) else type(x).__name__


def _reads_forces(task: Task, initial: mjx.Data) -> bool:
    """Whether a task's functions read fields that settling a state does not compute, `FORCES`."""
    episode = _arrays(task.episode)
    leaves, structure = jax.tree_util.tree_flatten_with_path(initial)
    forces = {i for i, (path, _) in enumerate(leaves) if getattr(path[0], "name", None) in FORCES}

    def read(leaves: list[Any], episode: Episode) -> Any:
        data = jax.tree.unflatten(structure, leaves)
        ends = () if task.terminal is None else task.terminal(data, episode)
        return task.reward(data, episode), task.observe(data, episode), ends

    jaxpr = jax.make_jaxpr(read)([leaf for _, leaf in leaves], episode).jaxpr
    used = {id(var) for equation in jaxpr.eqns for var in equation.invars} | {id(var) for var in jaxpr.outvars}
    return any(id(jaxpr.invars[i]) in used for i in forces)


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
        vectors: Any = jax.eval_shape(
            lambda data, episode: _as_arrays(task.observe(data, episode)), task.simulation.initial(), task.episode
        )
        _check_vectors(vectors, taken=spec)
        spec |= {name: ArraySpec(value.shape, jnp.float32) for name, value in vectors.items()}

    def observe(state: State) -> dict[str, Array]:
        observation = {}
        if obs != "vector":
            observation["image"] = render.draw(scene, task.pose(state.physics, state.episode))
        if obs != "pixels":
            vectors = task.observe(state.physics, state.episode)
            observation |= {name: jnp.asarray(value, jnp.float32) for name, value in vectors.items()}
        return observation

    return spec, observe, pictures


def _as_arrays(vectors: Any) -> Any:
    """A task's observations as arrays. Raises ValueError where one can't be made an array."""
    if not isinstance(vectors, Mapping):
        raise ValueError(f"task.observe: expected a dict of names and arrays, got {type(vectors).__name__}")
    arrays = {}
    for name, value in vectors.items():
        try:
            arrays[name] = jnp.asarray(value, jnp.float32)
        except (TypeError, ValueError) as error:
            raise ValueError(f"task.observe: expected {name!r} to be an array of numbers, got {value!r}") from error
    return arrays


def _check_vectors(vectors: Any, taken: Mapping[str, Any]) -> None:
    """Raises ValueError where these are no observations of a task beside those whose names are taken."""
    for name, value in vectors.items():
        if name in taken:
            raise ValueError(f"task.observe: expected another name than {name!r}, which the pixels have")
        if len(value.shape) > 1:
            raise ValueError(
                f"task.observe: expected {name!r} to have at most one axis, got {list(value.shape)}; flatten it"
            )
