"""What a Rooms task is, and how one becomes an environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.rooms import draw, movement
from ne_dreamer_jax.envs.rooms.movement import Body
from ne_dreamer_jax.types import Array, ArraySpec, DiscreteAction, EnvSpec


class State(NamedTuple):
    """An episode at a frame."""

    body: Body
    clock: Array  # int32 [], frames since the episode began
    task: Any  # what the task keeps

    @property
    def position(self) -> Array:
        """float32 [2], in the engine's units."""
        return self.body.position

    @property
    def yaw(self) -> Array:
        """float32 [], radians, counter-clockwise from +x."""
        return self.body.yaw


class Frame(NamedTuple):
    """What one frame brings."""

    body: Body
    task: Any
    reward: Array  # float32 []
    ended: Array  # bool [], the task's own end, not the clock's


class Game(NamedTuple):
    """A task as pure functions."""

    begin: Callable[[Array], tuple[Body, Any]]
    """key -> the player and the task's own state at the start."""
    frame: Callable[[Body, Any, Array, Array, Array], Frame]
    """(body, task state, controls [3], clock int32 [], key) -> one frame of 16 ms later."""
    scene: Callable[[Body, Any, Array], draw.Scene]
    """(body, task state, clock) -> what is to be seen."""
    shapes: tuple[draw.Silhouette, ...]
    """The objects' outlines, by the number that a scene gives them."""


def make_core(game: Game, steps: int, image_size: int) -> base.Core:
    """The task as a ``Core`` whose episodes last at most ``steps`` agent steps of four frames."""
    limit = steps * movement.FRAMES_PER_STEP

    def reset(key: Array) -> State:
        body, task = game.begin(key)
        return State(body, jnp.zeros((), jnp.int32), task)

    def step(state: State, action: Array, key: Array) -> tuple[State, base.Progress]:
        controls = jnp.asarray(movement.CONTROLS)[action]

        def frame(number: Array, carry: tuple[State, Array, Array]) -> tuple[State, Array, Array]:
            state, reward, ended = carry
            new = game.frame(state.body, state.task, controls, state.clock, jax.random.fold_in(key, number))
            after = State(new.body, state.clock + 1, new.task)
            stay = ended | (state.clock >= limit)
            state = jax.tree.map(lambda old, new: jnp.where(stay, old, new), state, after)
            return state, reward + jnp.where(stay, 0.0, new.reward), ended | (new.ended & ~stay)

        carry = (state, jnp.zeros((), jnp.float32), jnp.zeros((), bool))
        state, reward, ended = jax.lax.fori_loop(0, movement.FRAMES_PER_STEP, frame, carry)
        is_last = ended | (state.clock >= limit)
        return state, base.Progress(reward, is_last, ended, jnp.ones((), bool))

    def observe(state: State) -> dict[str, Array]:
        # Colours [3] are laid over pictures [H, W, 3] throughout.
        with jax.numpy_rank_promotion("allow"):
            scene = game.scene(state.body, state.task, state.clock)
            return {"image": draw.draw(scene, game.shapes, state.body.position, state.body.yaw, image_size)}

    spec = EnvSpec({"image": ArraySpec((image_size, image_size, 3), jnp.uint8)}, DiscreteAction(9))
    seconds = movement.FRAMES_PER_STEP / 60
    return base.Core(spec, reset, base.restart_or_step(reset, step, stochastic=True), observe, step_seconds=seconds)


def shuffled(key: Array, points: Array, count: int) -> Array:
    """``count`` different ones of the points [N, 2], in random order."""
    return points[jax.random.permutation(key, points.shape[0])[:count]]


def any_yaw(key: Array) -> Array:
    """Uniform over all directions."""
    return jax.random.uniform(key, (), jnp.float32, -jnp.pi, jnp.pi)
