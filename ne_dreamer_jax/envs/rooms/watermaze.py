"""Watermaze: find a hidden platform in a round arena, again and again, by the pictures on its wall."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs.rooms import draw, layout
from ne_dreamer_jax.envs.rooms.game import Frame, Game, any_yaw
from ne_dreamer_jax.envs.rooms.movement import EYE, Body, Solids, standing, walk
from ne_dreamer_jax.types import Array

APOTHEM, DISC = 760.0, 580.0  # of the arena's flat sides, and the disc in which the platform lies
SPAWNS = np.array(
    [(-488, 488), (-728, 0), (-496, -496), (0, -712), (504, -504), (712, 0), (504, 504), (0, 720)], np.float32
)
HEIGHT = 176.0
REACH, DIAGONAL = 79.0, 120.0  # of a player's centre from the platform's, along the axes and in their sum
FIRST_REWARD, BETWEEN, REWARDS = 18, 3, 5  # frames from the touch to the first 1, between two, how many
TRIAL_ENDS = FIRST_REWARD + BETWEEN * REWARDS
RISES, RISEN, TOP = 9, 18, 94.0  # frames and height: the platform lifts the player
POSTER_COLOURS = np.array(
    [
        (240, 170, 30),
        (130, 20, 25),
        (75, 40, 150),
        (30, 190, 150),
        (150, 210, 40),
        (40, 90, 220),
        (225, 50, 40),
        (150, 50, 170),
    ],
    np.float32,
)


class Watermaze(NamedTuple):
    """An episode: the platform stays where it is."""

    platform: Array  # float32 [2]
    found: Array  # int32 [], frames since the touch; 0 while it is sought


def eye(task: Watermaze) -> Array:
    """Height of the eye, float32 []: the platform lifts the player."""
    risen = jnp.clip((task.found - RISES).astype(jnp.float32) / (RISEN - RISES), 0.0, 1.0)
    return EYE + (TOP - 16.0) * risen


def make(scale: float = 1.0) -> Game:
    """The task, in an arena of its own size or of ``scale`` times that; the platform and the player keep theirs."""
    faces, planes = layout.polygon(16, scale * APOTHEM)
    solids = Solids(jnp.zeros((0, 4), jnp.float32), jnp.zeros((0,), bool), jnp.asarray(planes))
    # Inside of the wall by a player's width, also where the arena is small.
    spawns = jnp.asarray(SPAWNS * (scale * APOTHEM - 48) / (APOTHEM - 48))
    angles = np.pi / 4 * np.arange(8)
    towards = np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)
    posters = draw.Posters(
        jnp.asarray(scale * APOTHEM * towards),
        jnp.asarray(np.stack([np.sin(angles), -np.cos(angles)], axis=1).astype(np.float32)),
        jnp.asarray(POSTER_COLOURS),
    )

    def spawn(key: Array) -> Body:
        place_key, yaw_key = jax.random.split(key)
        return standing(spawns[jax.random.randint(place_key, (), 0, 8, jnp.int32)], any_yaw(yaw_key))

    def begin(key: Array) -> tuple[Body, Watermaze]:
        radius_key, angle_key, spawn_key = jax.random.split(key, 3)
        radius = scale * DISC * jnp.sqrt(jax.random.uniform(radius_key, (), jnp.float32))
        angle = any_yaw(angle_key)
        platform = radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return spawn(spawn_key), Watermaze(platform, jnp.zeros((), jnp.int32))

    def frame(body: Body, task: Watermaze, controls: Array, clock: Array, key: Array) -> Frame:
        locked = task.found > 0
        body = walk(body, jnp.where(locked, controls * jnp.array([0.0, 0.0, 1.0]), controls), solids)
        held = body._replace(position=task.platform, velocity=jnp.zeros((2,), jnp.float32))
        d = jnp.abs(body.position - task.platform)
        touches = (d[0] <= REACH) & (d[1] <= REACH) & (d[0] + d[1] <= DIAGONAL)
        body = jax.tree.map(lambda a, b: jnp.where(locked, a, b), held, body)
        found = jnp.where(locked, task.found + 1, touches.astype(jnp.int32))
        number = found - 1 - FIRST_REWARD  # frames after the touch, from the first reward on
        pays = (number >= 0) & (number % BETWEEN == 0) & (number < BETWEEN * REWARDS)
        over = found - 1 >= TRIAL_ENDS
        body = jax.tree.map(lambda a, b: jnp.where(over, a, b), spawn(key), body)
        task = task._replace(found=jnp.where(over, 0, found))
        return Frame(body, task, jnp.where(pays, 1.0, 0.0), jnp.zeros((), bool))

    def scene(body: Body, task: Watermaze, clock: Array) -> draw.Scene:
        walls = draw.Walls(
            jnp.asarray(faces), jnp.full((16, 3), 1.0, jnp.float32) * jnp.array([[60.0, 95.0, 165.0]]),
            jnp.zeros((16,), jnp.float32), jnp.ones((16,), bool),
        )  # fmt: skip
        nothing = draw.Items(
            jnp.zeros((1, 2)), jnp.zeros((1,)), jnp.ones((1, 2)), jnp.zeros((1,), jnp.int32), jnp.zeros((1, 3)),
            jnp.zeros((1, 3)), jnp.zeros((1,), bool),
        )  # fmt: skip
        mark = jnp.concatenate([task.platform, jnp.array([64.0]), (task.found > 0).astype(jnp.float32)[None]])
        return draw.Scene(
            walls, nothing, posters, jnp.array([0.0, 117.0, 166.0]), jnp.array([150.0, 224.0, 255.0]),
            jnp.float32(HEIGHT), eye(task), mark,
        )  # fmt: skip

    return Game(begin, frame, scene, (draw.disc,))
