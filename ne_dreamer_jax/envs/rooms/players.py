"""Scripted players, which know where everything is: what there is to reach, and what memory is worth.

Each is a pure function of the environment's state (and, where it remembers, of its own), for one environment.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.envs.rooms import collect, deferred, nonmatching, watermaze
from ne_dreamer_jax.envs.rooms.game import State
from ne_dreamer_jax.types import Array

FORWARD, LEFT, RIGHT, FORWARD_LEFT, FORWARD_RIGHT = 0, 4, 5, 6, 7
CLEAR = 105.0  # units that a path keeps from what is to be avoided


def steer(position: Array, yaw: Array, goal: Array, avoid: Array, shun: Array) -> Array:
    """The action, int32 [], that leads to ``goal`` [2] around the points ``avoid`` [M, 2] where ``shun`` [M]."""
    towards = goal - position
    distance = jnp.linalg.norm(towards)
    direction = towards / jnp.maximum(distance, 1e-3)
    # Of the directions within a right angle of the goal's, the nearest whose way is clear.
    turns = jnp.linspace(-1.9, 1.9, 39)
    turns = turns[jnp.argsort(jnp.abs(turns))]
    cos, sin = jnp.cos(turns), jnp.sin(turns)
    ways = jnp.stack([direction[0] * cos - direction[1] * sin, direction[0] * sin + direction[1] * cos], axis=1)
    offset = avoid - position[None]
    along = offset @ ways.T  # [M, directions]
    aside = jnp.sqrt(jnp.maximum(jnp.sum(offset**2, axis=1)[:, None] - along**2, 0.0))
    reach = jnp.minimum(distance, 220.0)
    near = jnp.linalg.norm(offset, axis=1)[:, None]
    margin = jnp.minimum(CLEAR * 0.6, jnp.maximum(near - 2.0, 0.0))
    blocked = shun[:, None] & (along > 0) & (along < reach) & (aside < margin)
    free = ~blocked.any(0)
    way = ways[jnp.argmax(free)]
    bearing = jnp.arctan2(way[1], way[0]) - yaw
    bearing = jnp.mod(bearing + jnp.pi, 2 * jnp.pi) - jnp.pi
    turn = jnp.where(bearing > 0, LEFT, RIGHT)
    both = jnp.where(bearing > 0, FORWARD_LEFT, FORWARD_RIGHT)
    size = jnp.abs(bearing)
    return jnp.where(size > 0.9, turn, jnp.where(size > 0.06, both, FORWARD)).astype(jnp.int32)


def _nearest(position: Array, items: Array, wanted: Array) -> Array:
    distance = jnp.where(wanted, jnp.linalg.norm(items - position[None], axis=1), jnp.inf)
    return items[jnp.argmin(distance)]


def collects(state: State) -> Array:
    """Takes the good objects and goes around the bad ones."""
    task: collect.Collect = state.task
    good = jnp.arange(20) >= 10
    goal = _nearest(state.position, task.items, good & task.taken.there)
    return steer(state.position, state.yaw, goal, task.items, ~good & task.taken.there)


def defers(state: State) -> Array:
    """Takes the box where it opens the door, and apples only where there are no cakes to be had."""
    task: deferred.Deferred = state.task
    there, kinds = task.taken.there, jnp.asarray(deferred.KINDS)
    two, box = task.config[0] > 0, there[deferred.BOX]
    opens = two & (task.config[1] > 0)
    cakes = (two & (task.config[3] > 0)) | (task.since_box >= 0)
    wanted = jnp.where(opens & box, kinds == 1, jnp.where(cakes & two, kinds == 2, kinds == 0)) & there
    goal = _nearest(state.position, task.items, wanted)
    # Through the middle of the door and the corridor.
    x = state.position[0]
    doorway = jnp.where(x < 250.0, 290.0, 500.0)
    far = (goal[0] > 400.0) & (x < 470.0)
    via = jnp.where(far, jnp.stack([doorway, jnp.zeros(())]), goal)
    return steer(state.position, state.yaw, via, task.items, there & ~wanted)


def selects(state: State, remembers: bool, coin: Array) -> Array:
    """Walks to the pad and then to the other object; without memory, to either by the ``coin`` (bool [])."""
    task: nonmatching.Nonmatching = state.task
    place = task.place if remembers else coin.astype(jnp.int32)
    in_first = state.position[0] < 200.0
    # Where it is first within reach.
    near = (
        jnp.asarray(nonmatching.CHOICES)[place]
        + jnp.array([-44.0, 0.0])
        + jnp.where(place == 0, jnp.array([0.0, -33.0]), jnp.array([0.0, 33.0]))
    )
    goal = jnp.where(in_first, jnp.array([64.0, -64.0]), near)
    return steer(state.position, state.yaw, goal, jnp.zeros((1, 2)), jnp.zeros((1,), bool))


class Memory(NamedTuple):
    """What a player of the watermaze keeps."""

    platform: Array  # float32 [2]
    known: Array  # bool []
    goal: Array  # float32 [2], where it is going while it knows nothing


NO_MEMORY = Memory(jnp.zeros((2,)), jnp.zeros((), bool), jnp.zeros((2,)))
"""At the start."""


def swims(state: State, memory: Memory, remembers: bool, radius: float, key: Array) -> tuple[Array, Memory]:
    """Goes from one place to another in a disc of ``radius`` until it has found the platform.

    If it remembers, it goes straight there in all later trials.
    """
    task: watermaze.Watermaze = state.task
    found = task.found > 0
    radius_key, angle_key = jax.random.split(key)
    angle = jax.random.uniform(angle_key, (), jnp.float32, -jnp.pi, jnp.pi)
    place = (
        radius * jnp.sqrt(jax.random.uniform(radius_key, (), jnp.float32)) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    )
    there = jnp.linalg.norm(memory.goal - state.position) < 60.0
    goal = jnp.where(there | found, place, memory.goal)
    memory = Memory(jnp.where(found, task.platform, memory.platform), memory.known | found, goal)
    target = jnp.where(memory.known & remembers, memory.platform, goal)
    return steer(state.position, state.yaw, target, jnp.zeros((1, 2)), jnp.zeros((1,), bool)), memory
