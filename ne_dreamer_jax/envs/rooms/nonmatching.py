"""Select the non-matching object: see one behind a fence, step on the pad, and take in the next room the other one."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs.rooms import draw, layout
from ne_dreamer_jax.envs.rooms.game import Frame, Game
from ne_dreamer_jax.envs.rooms.movement import Body, Solids, standing, walk, within_reach
from ne_dreamer_jax.types import Array

ROOM_1 = (-256.0, 128.0, -256.0, 128.0)
VESTIBULE, ROOM_2 = (256.0, 376.0, -128.0, 0.0), (384.0, 640.0, -248.0, 128.0)
FENCES = ((0.0, 80.0, 24.0, 104.0), (0.0, 80.0, -232.0, -152.0))  # not seen; they keep the player off the examples
HEIGHT = 128.0
START, EXIT = (-232.0, -64.0), (288.0, -64.0)
PAD = (25.0, 103.0, -103.0, -25.0)  # where a player's centre touches it
EXAMPLES = np.array([(40, 64), (40, -192)], np.float32)
CHOICES = np.array([(600, 64), (600, -192)], np.float32)
LAUNCH = 400.0  # units a second, out of the teleport
AIRBORNE = 16  # frames until the feet are on the ground again

SHAPES = (
    draw.barbell, draw.coil, draw.triangle, draw.plus, draw.square, draw.cylinder,
    draw.prism, draw.disc, draw.cup, draw.jack, draw.hexagon, draw.ring,
)  # fmt: skip
SIZES = np.array(
    [
        (14, 32),
        (18, 33),
        (23, 32),
        (31, 32),
        (32, 32),
        (18, 49),
        (32, 30),
        (30, 32),
        (32, 30),
        (32, 32),
        (29, 32),
        (32, 34),
    ],
    np.float32,
)
GLOWS = np.array([(255, 50, 138), (130, 214, 241), (95, 236, 155)], np.float32)  # pink, light blue, green
OBJECTS = len(SHAPES) * len(GLOWS)
BODY = (41.0, 41.0, 41.0)


class Nonmatching(NamedTuple):
    """One map: drawn anew each time that the player comes back to the first room."""

    match: Array  # int32 [], the object to avoid, in 0 .. 35; the same all episode
    other: Array  # int32 [], the one to take
    example: Array  # int32 [], which of the two spots shows ``match``
    place: Array  # int32 [], the choice spot where ``other`` is


def _new_map(match: Array, key: Array) -> Nonmatching:
    other_key, example_key, place_key = jax.random.split(key, 3)
    other = jax.random.randint(other_key, (), 0, OBJECTS - 1, jnp.int32)
    coin = lambda key: jax.random.randint(key, (), 0, 2, jnp.int32)
    return Nonmatching(match, other + (other >= match).astype(jnp.int32), coin(example_key), coin(place_key))


def make() -> Game:
    """The task."""
    x0, x1, y0, y1 = VESTIBULE
    boxes = [
        *layout.around(ROOM_1), *FENCES,
        (x0 - 40, x0, y0 - 40, y1 + 40), (x0 - 40, x1, y0 - 40, y0), (x0 - 40, x1, y1, y1 + 40),
        (376.0, 384.0, ROOM_2[2] - 40, y0), (376.0, 384.0, y1, ROOM_2[3] + 40),
        (ROOM_2[1], ROOM_2[1] + 40, ROOM_2[2] - 40, ROOM_2[3] + 40),
        (376.0, ROOM_2[1] + 40, ROOM_2[2] - 40, ROOM_2[2]), (376.0, ROOM_2[1] + 40, ROOM_2[3], ROOM_2[3] + 40),
    ]  # fmt: skip
    solids = Solids(jnp.asarray(boxes, jnp.float32), jnp.ones((len(boxes),), bool), jnp.zeros((0, 3), jnp.float32))
    gap = ROOM_2[0]
    ends = np.concatenate(
        [
            layout.inside(ROOM_1),
            np.array(
                [
                    (x0, y0, gap, y0), (gap, y1, x0, y1), (x0, y1, x0, y0),
                    (gap, y0, gap, ROOM_2[2]), (gap, ROOM_2[3], gap, y1),
                    (gap, ROOM_2[2], ROOM_2[1], ROOM_2[2]), (ROOM_2[1], ROOM_2[2], ROOM_2[1], ROOM_2[3]),
                    (ROOM_2[1], ROOM_2[3], gap, ROOM_2[3]),
                ],
                np.float32,
            ),
        ]
    )  # fmt: skip
    start, exit_ = jnp.asarray(START, jnp.float32), jnp.asarray(EXIT, jnp.float32)

    def begin(key: Array) -> tuple[Body, Nonmatching]:
        match_key, map_key = jax.random.split(key)
        match = jax.random.randint(match_key, (), 0, OBJECTS, jnp.int32)
        return standing(start, jnp.zeros((), jnp.float32)), _new_map(match, map_key)

    def frame(body: Body, task: Nonmatching, controls: Array, clock: Array, key: Array) -> Frame:
        body = walk(body, controls, solids)
        x, y = body.position
        on_pad = (x > PAD[0]) & (x < PAD[1]) & (y > PAD[2]) & (y < PAD[3])
        launched = Body(
            exit_, jnp.array([LAUNCH, 0.0], jnp.float32), jnp.zeros((), jnp.float32), jnp.full((), AIRBORNE, jnp.int32)
        )
        body = jax.tree.map(lambda a, b: jnp.where(on_pad, a, b), launched, body)
        reached = within_reach(body.position, jnp.asarray(CHOICES))
        right, wrong = reached[task.place], reached[1 - task.place]
        chosen = right | wrong
        fresh = standing(start, jnp.zeros((), jnp.float32)), _new_map(task.match, key)
        body, task = jax.tree.map(lambda a, b: jnp.where(chosen, a, b), fresh, (body, task))
        reward = jnp.where(on_pad, 1.0, 0.0) + jnp.where(right, 10.0, jnp.where(wrong, -10.0, 0.0))
        return Frame(body, task, reward, jnp.zeros((), bool))

    def scene(body: Body, task: Nonmatching, clock: Array) -> draw.Scene:
        ids = jnp.stack([task.match, task.match, task.other])
        match_place = jnp.asarray(CHOICES)[1 - task.place]
        places = jnp.stack([jnp.asarray(EXAMPLES)[task.example], match_place, jnp.asarray(CHOICES)[task.place]])
        shape, glow = ids // len(GLOWS), ids % len(GLOWS)
        pulse = 1.0 + 0.15 * jnp.sin(2 * jnp.pi * 0.2 * clock.astype(jnp.float32) / 60)
        pad = jnp.array([[64.0, -64.0]])
        body_colour = 0.45 * jnp.asarray(GLOWS)[glow] + 0.3 * jnp.asarray(BODY)
        items = draw.Items(
            jnp.concatenate([places, pad]), jnp.array([12.0, 12.0, 12.0, 0.0]),
            jnp.concatenate([1.5 * jnp.asarray(SIZES)[shape], jnp.array([[48.0, 10.0]])]),
            jnp.concatenate([shape, jnp.full((1,), 4, jnp.int32)]),
            jnp.concatenate([body_colour, jnp.array([[200.0, 220.0, 90.0]])]),
            jnp.concatenate([jnp.asarray(GLOWS)[glow] * pulse, jnp.array([[250.0, 250.0, 160.0]])]),
            jnp.ones((4,), bool),
        )  # fmt: skip
        count = len(ends)
        walls = draw.Walls(
            jnp.asarray(ends), jnp.full((count, 3), 1.0, jnp.float32) * jnp.array([[70.0, 105.0, 170.0]]),
            jnp.zeros((count,), jnp.float32), jnp.ones((count,), bool),
        )  # fmt: skip
        return draw.Scene(
            walls, items, None, jnp.array([211.0, 146.0, 27.0]), jnp.array([150.0, 200.0, 235.0]), jnp.float32(HEIGHT),
            jnp.float32(50.0), jnp.zeros((4,), jnp.float32),
        )  # fmt: skip

    return Game(begin, frame, scene, SHAPES)
