"""How a player walks: DMLab's (Quake III's) movement on flat ground, a frame of 16 ms at a time.

The formulas and their order are the engine's: friction, acceleration towards the wished direction, a move that slides
along walls, and velocities rounded to whole units a second. Units are the engine's (a player is 30 wide).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.types import Array

FRAME = 0.016  # seconds
FRAMES_PER_STEP = 4  # the action repeat
SPEED, STOP_SPEED = 320.0, 100.0  # units a second
FRICTION, ACCELERATION, AIR_ACCELERATION = 6.0, 10.0, 1.0  # a second
TURN = np.deg2rad(2.112)  # radians a frame, of a look of 20
HALF_WIDTH = 15.0  # of the player's box, which does not turn
EYE = 50.0  # above the ground
BODY_HEIGHT = 56.0

# forward, right, look; by action.
CONTROLS = np.array(
    [[1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [1, 0, 1], [1, 0, -1], [0, 0, 0]], np.float32
)
"""Forward, back, strafe left and right, look left and right, both with forward, and fire, which here does nothing."""


class Body(NamedTuple):
    """A player on flat ground."""

    position: Array  # float32 [2], units
    velocity: Array  # float32 [2], units a second
    yaw: Array  # float32 [], radians, counter-clockwise from +x
    loose: Array  # int32 [], frames without friction and with little control: in the air, or knocked back


class Solids(NamedTuple):
    """What stops a player."""

    boxes: Array  # float32 [K, 4]: x from, x to, y from, y to
    active: Array  # bool [K]
    planes: Array  # float32 [P, 3]: the centre of a point-sized player stays where normal . position <= offset


def standing(position: Array, yaw: Array) -> Body:
    """A player at rest."""
    return Body(position, jnp.zeros((2,), jnp.float32), yaw, jnp.zeros((), jnp.int32))


def heading(yaw: Array) -> tuple[Array, Array]:
    """Unit vectors [2] forward and to the right."""
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([cos, sin]), jnp.stack([sin, -cos])


def walk(body: Body, controls: Array, solids: Solids) -> Body:
    """One frame.

    Args:
      controls: float32 [3], a row of `CONTROLS`.
    """
    yaw = jnp.mod(body.yaw + TURN * controls[2] + jnp.pi, 2 * jnp.pi) - jnp.pi
    forward, right = heading(yaw)
    loose = body.loose > 0

    speed = jnp.linalg.norm(body.velocity)
    drop = jnp.where(loose, 0.0, jnp.maximum(speed, STOP_SPEED) * FRICTION * FRAME)
    velocity = jnp.where(speed < 1.0, 0.0, body.velocity * jnp.maximum(speed - drop, 0.0) / jnp.maximum(speed, 1.0))

    wish = controls[0] * forward + controls[1] * right
    length = jnp.linalg.norm(wish)
    wish = wish / jnp.maximum(length, 1e-6)
    rate = jnp.where(loose, AIR_ACCELERATION, ACCELERATION)
    lacking = SPEED - jnp.dot(velocity, wish)
    gain = jnp.where(length > 0, jnp.clip(lacking, 0.0, rate * FRAME * SPEED), 0.0)
    velocity = velocity + gain * wish

    position, velocity = slide(body.position, velocity, solids)
    return Body(position, jnp.round(velocity), yaw, jnp.maximum(body.loose - 1, 0))


def slide(position: Array, velocity: Array, solids: Solids) -> tuple[Array, Array]:
    """Moves for a frame and slides along what is hit: the part of the velocity into a surface is lost."""
    for axis in (0, 1):  # walls are axis-aligned, so that sliding along them is moving along each axis by itself
        target = position[axis] + velocity[axis] * FRAME
        low = solids.boxes[:, 2 * axis] - HALF_WIDTH
        high = solids.boxes[:, 2 * axis + 1] + HALF_WIDTH
        across = (position[1 - axis] > solids.boxes[:, 2 - 2 * axis] - HALF_WIDTH) & (
            position[1 - axis] < solids.boxes[:, 3 - 2 * axis] + HALF_WIDTH
        )
        hit = solids.active & across & (target > low) & (target < high)
        from_below = position[axis] <= low
        stops = jnp.where(hit & from_below, low, jnp.inf)
        target = jnp.minimum(target, jnp.min(stops, initial=jnp.inf))
        stops = jnp.where(hit & ~from_below & (position[axis] >= high), high, -jnp.inf)
        target = jnp.maximum(target, jnp.max(stops, initial=-jnp.inf))
        stopped = target != position[axis] + velocity[axis] * FRAME
        position = position.at[axis].set(target)
        velocity = velocity.at[axis].set(jnp.where(stopped, 0.0, velocity[axis]))

    def push(carry: tuple[Array, Array], plane: Array) -> tuple[tuple[Array, Array], None]:
        position, velocity = carry
        normal = plane[:2]
        # The nearest corner of the player's box stays inside.
        depth = jnp.dot(normal, position) + HALF_WIDTH * jnp.sum(jnp.abs(normal)) - plane[2]
        inward = jnp.maximum(jnp.dot(velocity, normal), 0.0)
        velocity = jnp.where(depth > 0, velocity - inward * normal, velocity)
        return (position - jnp.maximum(depth, 0.0) * normal, velocity), None

    if solids.planes.shape[0]:
        for _ in range(2):
            (position, velocity), _ = jax.lax.scan(push, (position, velocity), solids.planes)
    return position, velocity


def within_reach(position: Array, items: Array) -> Array:
    """Whether a player at ``position`` [2] picks up items at [N, 2], bool [N]; the engine's volume is askew in x."""
    d = position[None] - items
    return (d[:, 0] >= -50.0) & (d[:, 0] <= 44.0) & (jnp.abs(d[:, 1]) <= 36.0)
