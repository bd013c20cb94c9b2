"""Collect good objects: ten are worth 1 and ten -1, and which are which was told by their looks in other episodes."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs.rooms import draw, layout, pickups
from ne_dreamer_jax.envs.rooms.game import Frame, Game, any_yaw, shuffled
from ne_dreamer_jax.envs.rooms.movement import Body, Solids, standing, walk
from ne_dreamer_jax.types import Array

ROOM = (-568.0, 1016.0, -760.0, 568.0)
HEIGHT = 176.0
POINTS = np.array([(-450 + 150 * i, -700 + 150 * j) for i in range(10) for j in range(9)], np.float32)

HAT, CAN, CAKE, BALLOON = range(4)
SHAPES = (draw.hat, draw.cylinder, draw.square, draw.balloon)
SIZES = np.array([(56, 37), (40, 51), (53, 30), (45, 60)], np.float32)
COLOURS = np.array([(58, 31, 255), (241, 255, 30), (36, 255, 174), (255, 12, 154)], np.float32)
TRIMS = np.array([(235, 235, 245), (250, 250, 250), (250, 240, 250), (255, 190, 225)], np.float32)

# bad, good, whether walls and floor are replaced
TRAIN = np.array([(HAT, CAN, 0), (CAKE, BALLOON, 0), (CAKE, BALLOON, 1)], np.int32)
TEST = np.array([(HAT, CAN, 1)], np.int32)
WALLS = np.array([(140, 190, 150), (200, 60, 60)], np.float32)
FLOORS = np.array([(211, 146, 27), (151, 190, 228)], np.float32)
SKY = (150.0, 224.0, 255.0)


class Collect(NamedTuple):
    """What an episode has drawn, and what is left of it."""

    config: Array  # int32 [3]: bad, good, replaced
    items: Array  # float32 [20, 2], the bad ones first
    taken: pickups.Taken


def solids() -> Solids:
    """The walls."""
    return Solids(jnp.asarray(layout.around(ROOM), jnp.float32), jnp.ones((4,), bool), jnp.zeros((0, 3), jnp.float32))


def make(configs: np.ndarray) -> Game:
    """The task with one of these configurations in each episode."""
    values = jnp.asarray([-1.0] * 10 + [1.0] * 10, jnp.float32)

    def begin(key: Array) -> tuple[Body, Collect]:
        config_key, points_key, yaw_key = jax.random.split(key, 3)
        config = jnp.asarray(configs)[jax.random.randint(config_key, (), 0, len(configs), jnp.int32)]
        points = shuffled(points_key, jnp.asarray(POINTS), 21)
        task = Collect(config, points[:20], pickups.untouched(jnp.ones((20,), bool)))
        return standing(points[20], any_yaw(yaw_key)), task

    def frame(body: Body, task: Collect, controls: Array, clock: Array, key: Array) -> Frame:
        body = walk(body, controls, solids())
        taken, now = pickups.take(task.taken, body.position, task.items, clock)
        reward = jnp.sum(jnp.where(now, values, 0.0))
        return Frame(body, task._replace(taken=taken), reward, pickups.over(taken, clock))

    def scene(body: Body, task: Collect, clock: Array) -> draw.Scene:
        kind = jnp.repeat(task.config[:2], 10)
        replaced = task.config[2]
        size = jnp.asarray(SIZES)[kind]
        items = draw.Items(
            task.items, jnp.full((20,), 4.0, jnp.float32), size, kind, jnp.asarray(COLOURS)[kind],
            jnp.asarray(TRIMS)[kind], task.taken.there,
        )  # fmt: skip
        colour = jnp.broadcast_to(jnp.asarray(WALLS)[replaced], (4, 3))
        walls = draw.Walls(jnp.asarray(layout.inside(ROOM)), colour, jnp.zeros((4,), jnp.float32), jnp.ones((4,), bool))
        floor = jnp.asarray(FLOORS)[replaced]
        return draw.Scene(
            walls, items, None, floor, jnp.asarray(SKY, jnp.float32), jnp.float32(HEIGHT), jnp.float32(50.0),
            jnp.zeros((4,), jnp.float32),
        )  # fmt: skip

    return Game(begin, frame, scene, SHAPES)
