"""Exploit deferred effects: a box that costs 3 may open the door to ten cakes, each worth ten apples."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs.rooms import draw, layout, pickups
from ne_dreamer_jax.envs.rooms.game import Frame, Game, any_yaw, shuffled
from ne_dreamer_jax.envs.rooms.movement import BODY_HEIGHT, Body, Solids, standing, walk
from ne_dreamer_jax.types import Array

ROOM_1, ROOM_2 = (-272.0, 336.0, -272.0, 272.0), (456.0, 1064.0, -272.0, 272.0)
CORRIDOR = (336.0, 456.0, -64.0, 64.0)
DOOR = (336.0, 344.0, -64.0, 64.0)
HEIGHT = 80.0
POINTS_1 = np.array([(-208 + 120 * i, -240 + 120 * j) for i in range(5) for j in range(5)], np.float32)
POINTS_2 = np.array([(520 + 120 * i, -240 + 120 * j) for i in range(5) for j in range(5)], np.float32)
DOOR_DELAY = 3  # frames from taking the box until the door moves: 50 ms
DOOR_SPEED = 400.0 * 0.016  # units a frame
SUNK = 8.0  # units that the closed door reaches below the floor

APPLES, BOX, CAKES = slice(0, 10), 10, slice(11, 21)
REWARDS = np.array([1.0] * 10 + [-3.0] + [10.0] * 10, np.float32)
SHAPES = (draw.disc, draw.square, draw.cylinder)
KINDS = np.array([0] * 10 + [1] + [2] * 10, np.int32)
SIZES = np.array([(25, 30), (32, 32), (53, 23)], np.float32)[KINDS]
COLOURS = np.array([(190, 45, 40), (50, 50, 50), (200, 0, 0)], np.float32)[KINDS]
TRIMS = np.array([(210, 70, 50), (255, 45, 134), (250, 230, 225)], np.float32)[KINDS]

# two rooms, box, bright floor at the start, door open at the start
TRAIN = np.array([(0, 1, 0, 0), (1, 0, 0, 0), (1, 0, 1, 1)], np.int32)
TEST = np.array([(1, 1, 0, 0)], np.int32)
WALL, DOOR_COLOUR, CEILING = (193.0, 156.0, 41.0), (78.0, 78.0, 78.0), (196.0, 189.0, 170.0)
DARK, BRIGHT = 12.0, 110.0  # the floor; DMLab's 0 and 70 before its lights


class Deferred(NamedTuple):
    """What an episode has drawn, and what is left of it."""

    config: Array  # int32 [4]: two rooms, box, bright, open
    items: Array  # float32 [21, 2]: apples, box, cakes
    taken: pickups.Taken
    since_box: Array  # int32 [], frames since the box was taken; -1 before that


def lift(task: Deferred) -> Array:
    """How far the door has gone up, in units; the whole height where it is open from the start."""
    moving = jnp.maximum(task.since_box - DOOR_DELAY, 0).astype(jnp.float32) * DOOR_SPEED
    return jnp.where(task.config[3] > 0, HEIGHT, jnp.minimum(moving, HEIGHT))


def solids(task: Deferred) -> Solids:
    """Walls, and the door while it is too low to pass under."""
    two = task.config[0] > 0
    x0, x1 = CORRIDOR[:2]
    boxes = [
        *layout.around((ROOM_1[0], ROOM_2[1], *ROOM_1[2:])),
        (x0, x1, CORRIDOR[3], ROOM_1[3] + 40), (x0, x1, ROOM_1[2] - 40, CORRIDOR[2]),
        DOOR,
    ]  # fmt: skip
    closed = ~two | (lift(task) - SUNK < BODY_HEIGHT)
    active = jnp.concatenate([jnp.ones((6,), bool), closed[None]])
    return Solids(jnp.asarray(boxes, jnp.float32), active, jnp.zeros((0, 3), jnp.float32))


def _faces() -> tuple[np.ndarray, np.ndarray]:
    """All faces [S, 4], and which are drawn: 0 always, 1 with one room alone, 2 with two, 3 the door."""
    (a0, a1, b0, b1), (c0, c1, _, _), (_, _, low, high) = ROOM_1, ROOM_2, CORRIDOR
    rows = [
        (a0, b0, a1, b0, 0), (a1, b1, a0, b1, 0), (a0, b1, a0, b0, 0),
        (a1, b0, a1, low, 0), (a1, high, a1, b1, 0), (a1, low, a1, high, 1),
        (a1, low, c0, low, 2), (c0, high, a1, high, 2), (c0, low, c0, b0, 2), (c0, b1, c0, high, 2),
        (c0, b0, c1, b0, 2), (c1, b0, c1, b1, 2), (c1, b1, c0, b1, 2),
        (DOOR[0], low, DOOR[0], high, 3), (DOOR[1], low, DOOR[1], high, 3),
    ]  # fmt: skip
    table = np.array(rows, np.float32)
    return table[:, :4], table[:, 4].astype(np.int32)


def make(configs: np.ndarray) -> Game:
    """The task with one of these configurations in each episode."""
    ends, kinds = _faces()

    def begin(key: Array) -> tuple[Body, Deferred]:
        config_key, first_key, second_key, yaw_key = jax.random.split(key, 4)
        config = jnp.asarray(configs)[jax.random.randint(config_key, (), 0, len(configs), jnp.int32)]
        first = shuffled(first_key, jnp.asarray(POINTS_1), 12)
        second = shuffled(second_key, jnp.asarray(POINTS_2), 10)
        there = jnp.concatenate([jnp.ones((10,), bool), config[1:2] > 0, jnp.broadcast_to(config[0] > 0, (10,))])
        items = jnp.concatenate([first[:11], second])
        task = Deferred(config, items, pickups.untouched(there), jnp.full((), -1, jnp.int32))
        return standing(first[11], any_yaw(yaw_key)), task

    def frame(body: Body, task: Deferred, controls: Array, clock: Array, key: Array) -> Frame:
        body = walk(body, controls, solids(task))
        taken, now = pickups.take(task.taken, body.position, task.items, clock)
        since = jnp.where(now[BOX], 0, jnp.where(task.since_box >= 0, task.since_box + 1, -1))
        task = task._replace(taken=taken, since_box=since)
        return Frame(body, task, jnp.sum(jnp.where(now, jnp.asarray(REWARDS), 0.0)), pickups.over(taken, clock))

    def scene(body: Body, task: Deferred, clock: Array) -> draw.Scene:
        two = task.config[0] > 0
        shown = jnp.asarray(kinds)
        active = jnp.where(shown == 1, ~two, jnp.where(shown == 0, True, two)) & (
            (shown != 3) | (lift(task) < HEIGHT - 8)
        )
        is_door = (shown == 3)[:, None]
        colour = jnp.where(is_door, jnp.asarray(DOOR_COLOUR, jnp.float32), jnp.asarray(WALL, jnp.float32))
        bottom = jnp.where(shown == 3, lift(task) - SUNK, 0.0)
        items = draw.Items(
            task.items, jnp.full((21,), 6.0, jnp.float32), jnp.asarray(SIZES), jnp.asarray(KINDS), jnp.asarray(COLOURS),
            jnp.asarray(TRIMS), task.taken.there,
        )  # fmt: skip
        bright = (task.config[2] > 0) | (task.since_box >= 0)
        floor = jnp.full((3,), 1.0, jnp.float32) * jnp.where(bright, BRIGHT, DARK)
        return draw.Scene(
            draw.Walls(jnp.asarray(ends), colour, bottom, active), items, None, floor,
            jnp.asarray(CEILING, jnp.float32), jnp.float32(HEIGHT), jnp.float32(50.0), jnp.zeros((4,), jnp.float32),
        )  # fmt: skip

    return Game(begin, frame, scene, SHAPES)
