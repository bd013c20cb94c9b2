"""Select the non-matching object: see one behind a fence, step on the pad, and take in the next room the other one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs.rooms import draw, layout
from ne_dreamer_jax.envs.rooms.game import Frame, Game
from ne_dreamer_jax.envs.rooms.movement import Body, Solids, standing, walk, within_reach
from ne_dreamer_jax.types import Array

HEIGHT = 128.0
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
FEW = (0, 13, 26)
"""Three objects of three shapes and three colours: a small agent has little time to tell many apart."""
BODY = (41.0, 41.0, 41.0)


class Places(NamedTuple):
    """Where things are; rectangles are x from, x to, y from, y to."""

    room_1: layout.Rectangle
    start: np.ndarray  # float32 [2]
    pad: np.ndarray  # float32 [2], its centre; a player's touches it less than `PAD_REACH` away along both axes
    examples: np.ndarray  # float32 [2, 2]
    fences: tuple[layout.Rectangle, ...]  # not seen; they keep the player off the examples
    vestibule: layout.Rectangle
    exit: np.ndarray  # float32 [2], of the teleport
    room_2: layout.Rectangle
    choices: np.ndarray  # float32 [2, 2]


PAD_REACH = 39.0


def places(scale: float = 1.0) -> Places:
    """DMLab's two rooms, or ``scale`` times their size.

    The first one shrinks towards the pad, the second towards the teleport's exit; the player, what it reaches, its
    distance from the walls behind it, the pad and the objects keep their sizes.
    """
    pad, exit_ = (64.0, -64.0), (288.0, -64.0)
    shrink = lambda about, *point: tuple(a + scale * (x - a) for a, x in zip(about, point, strict=True))
    box = lambda about, *room: shrink((about[0], about[0], about[1], about[1]), *room)
    points = lambda about, *rows: np.array([shrink(about, *row) for row in rows], np.float32)
    room_1 = box(pad, -256.0, 128.0, -256.0, 128.0)
    examples, side = points(pad, (40.0, 64.0), (40.0, -192.0)), 40.0 * scale
    return Places(
        room_1,
        np.array((room_1[0] + 24.0, pad[1]), np.float32),
        np.array(pad, np.float32),
        examples,
        tuple((float(x) - side, float(x) + side, float(y) - side, float(y) + side) for x, y in examples),
        (exit_[0] - 32.0, *box(exit_, 256.0, 376.0, -128.0, 0.0)[1:]),
        np.array(exit_, np.float32),
        box(exit_, 384.0, 640.0, -248.0, 128.0),
        points(exit_, (600.0, 64.0), (600.0, -192.0)),
    )


def touches_pad(at: Places, position: Array) -> Array:
    """Whether a player at ``position`` [2] is teleported, bool []."""
    return (jnp.abs(position - jnp.asarray(at.pad)) < PAD_REACH).all()


class Nonmatching(NamedTuple):
    """One map: drawn anew each time that the player comes back to the first room."""

    match: Array  # int32 [], the object to avoid, among the task's; the same all episode
    other: Array  # int32 [], the one to take
    example: Array  # int32 [], which of the two spots shows ``match``
    place: Array  # int32 [], the choice spot where ``other`` is


def _new_map(match: Array, key: Array, objects: int) -> Nonmatching:
    other_key, example_key, place_key = jax.random.split(key, 3)
    other = jax.random.randint(other_key, (), 0, objects - 1, jnp.int32)
    coin = lambda key: jax.random.randint(key, (), 0, 2, jnp.int32)
    return Nonmatching(match, other + (other >= match).astype(jnp.int32), coin(example_key), coin(place_key))


def solids(at: Places) -> Solids:
    """What stops a player."""
    (x0, x1, y0, y1), (c0, c1, b0, b1) = at.vestibule, at.room_2
    t = 40.0
    boxes = [
        *layout.around(at.room_1), *at.fences,
        (x0 - t, x0, y0 - t, y1 + t), (x0 - t, x1, y0 - t, y0), (x0 - t, x1, y1, y1 + t),
        (x1, c0, b0 - t, y0), (x1, c0, y1, b1 + t),
        (c1, c1 + t, b0 - t, b1 + t), (x1, c1 + t, b0 - t, b0), (x1, c1 + t, b1, b1 + t),
    ]  # fmt: skip
    return Solids(jnp.asarray(boxes, jnp.float32), jnp.ones((len(boxes),), bool), jnp.zeros((0, 3), jnp.float32))


def _faces(at: Places) -> np.ndarray:
    """What is seen of the walls, float32 [S, 4]."""
    (x0, _, y0, y1), (c0, c1, b0, b1) = at.vestibule, at.room_2
    rows = [
        (x0, y0, c0, y0), (c0, y1, x0, y1), (x0, y1, x0, y0), (c0, y0, c0, b0), (c0, b1, c0, y1),
        (c0, b0, c1, b0), (c1, b0, c1, b1), (c1, b1, c0, b1),
    ]  # fmt: skip
    return np.concatenate([layout.inside(at.room_1), np.array(rows, np.float32)])


def make(scale: float = 1.0, objects: Sequence[int] = range(OBJECTS)) -> Game:
    """The task, in rooms of DMLab's size or of ``scale`` times that, with all of its objects or some."""
    kinds = jnp.asarray(np.array(objects, np.int32))
    at = places(scale)
    walls, ends = solids(at), _faces(at)
    start, exit_ = jnp.asarray(at.start), jnp.asarray(at.exit)
    pad, examples, choices = jnp.asarray(at.pad), jnp.asarray(at.examples), jnp.asarray(at.choices)

    def begin(key: Array) -> tuple[Body, Nonmatching]:
        match_key, map_key = jax.random.split(key)
        match = jax.random.randint(match_key, (), 0, len(kinds), jnp.int32)
        return standing(start, jnp.zeros((), jnp.float32)), _new_map(match, map_key, len(kinds))

    def frame(body: Body, task: Nonmatching, controls: Array, clock: Array, key: Array) -> Frame:
        body = walk(body, controls, walls)
        on_pad = touches_pad(at, body.position)
        launched = Body(
            exit_, jnp.array([LAUNCH, 0.0], jnp.float32), jnp.zeros((), jnp.float32), jnp.full((), AIRBORNE, jnp.int32)
        )
        body = jax.tree.map(lambda a, b: jnp.where(on_pad, a, b), launched, body)
        reached = within_reach(body.position, choices)
        right, wrong = reached[task.place], reached[1 - task.place]
        chosen = right | wrong
        fresh = standing(start, jnp.zeros((), jnp.float32)), _new_map(task.match, key, len(kinds))
        body, task = jax.tree.map(lambda a, b: jnp.where(chosen, a, b), fresh, (body, task))
        reward = jnp.where(on_pad, 1.0, 0.0) + jnp.where(right, 10.0, jnp.where(wrong, -10.0, 0.0))
        return Frame(body, task, reward, jnp.zeros((), bool))

    def scene(body: Body, task: Nonmatching, clock: Array) -> draw.Scene:
        ids = kinds[jnp.stack([task.match, task.match, task.other])]
        shown = jnp.stack([examples[task.example], choices[1 - task.place], choices[task.place], pad])
        shape, glow = ids // len(GLOWS), ids % len(GLOWS)
        pulse = 1.0 + 0.15 * jnp.sin(2 * jnp.pi * 0.2 * clock.astype(jnp.float32) / 60)
        body_colour = 0.45 * jnp.asarray(GLOWS)[glow] + 0.3 * jnp.asarray(BODY)
        items = draw.Items(
            shown, jnp.array([12.0, 12.0, 12.0, 0.0]),
            jnp.concatenate([1.5 * jnp.asarray(SIZES)[shape], jnp.array([[48.0, 10.0]])]),
            jnp.concatenate([shape, jnp.full((1,), 4, jnp.int32)]),
            jnp.concatenate([body_colour, jnp.array([[200.0, 220.0, 90.0]])]),
            jnp.concatenate([jnp.asarray(GLOWS)[glow] * pulse, jnp.array([[250.0, 250.0, 160.0]])]),
            jnp.ones((4,), bool),
        )  # fmt: skip
        count = len(ends)
        faces = draw.Walls(
            jnp.asarray(ends), jnp.full((count, 3), 1.0, jnp.float32) * jnp.array([[70.0, 105.0, 170.0]]),
            jnp.zeros((count,), jnp.float32), jnp.ones((count,), bool),
        )  # fmt: skip
        return draw.Scene(
            faces, items, None, jnp.array([211.0, 146.0, 27.0]), jnp.array([150.0, 200.0, 235.0]), jnp.float32(HEIGHT),
            jnp.float32(50.0), jnp.zeros((4,), jnp.float32),
        )  # fmt: skip

    return Game(begin, frame, scene, SHAPES)
