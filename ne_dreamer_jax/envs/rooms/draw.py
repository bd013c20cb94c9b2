"""What a player sees, 90 degrees wide: walls, floor and ceiling by intersection, objects as upright outlines.

Walls stand upright and the view is level, so that a column of pixels meets the same walls: their distances are found
once a column, and a pixel's height follows. Patterns are integrated over the width of a pixel, and outlines are covered
in part where a pixel is: neither flickers at a distance. Objects turn to the player, as cardboard does; they hide what
is behind them and are hidden by walls and doors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.envs.rooms.movement import heading
from ne_dreamer_jax.types import Array

Silhouette = Callable[[Array, Array], Array]
"""(across, up), each [...] with -1 and 1 at the outline's sides, bottom and top -> signed distance, negative inside."""

NEAR = 4.0  # units in front of the eye, where drawing begins
PANEL = 64.0  # units between the lines on walls and floors
LINE = 5.0  # units, their width


class Walls(NamedTuple):
    """Upright faces, S of them."""

    ends: Array  # float32 [S, 4]: x, y of one end and of the other
    colour: Array  # float32 [S, 3], 0 to 255
    bottom: Array  # float32 [S], height above which they are there: a door that has gone up leaves a gap below
    active: Array  # bool [S]


class Items(NamedTuple):
    """Objects, N of them."""

    position: Array  # float32 [N, 2]
    bottom: Array  # float32 [N], height of the lower end above the ground
    size: Array  # float32 [N, 2], width and height in units
    shape: Array  # int32 [N], an index of the task's outlines
    colour: Array  # float32 [N, 3]
    trim: Array  # float32 [N, 3], colour of a band around the middle
    active: Array  # bool [N]


class Posters(NamedTuple):
    """Pictures on walls, one for each of `SYMBOLS`, on a coloured square."""

    position: Array  # float32 [8, 2], centres
    across: Array  # float32 [8, 2], unit vectors along the wall, to the right of who looks at them
    colour: Array  # float32 [8, 3]


class Scene(NamedTuple):
    """All that may be seen."""

    walls: Walls
    items: Items
    posters: Posters | None
    floor: Array  # float32 [3]
    ceiling: Array  # float32 [3]
    height: Array  # float32 [], of the ceiling above the ground
    eye: Array  # float32 [], above the ground
    mark: Array  # float32 [4]: x, y, radius of a dark disc on the floor, and whether it is there


POSTER_SIZE = (175.0, 156.0)
POSTER_HEIGHT = 80.0  # of the centre above the ground


def disc(a: Array, b: Array) -> Array:
    """A circle."""
    return jnp.sqrt(a * a + b * b + 1e-12) - 1.0


def square(a: Array, b: Array) -> Array:
    """A square."""
    return jnp.maximum(jnp.abs(a), jnp.abs(b)) - 0.9


def diamond(a: Array, b: Array) -> Array:
    """A square on its corner."""
    return (jnp.abs(a) + jnp.abs(b) - 1.0) * 0.7


def triangle(a: Array, b: Array) -> Array:
    """A triangle, its point up."""
    return jnp.maximum(0.89 * jnp.abs(a) + 0.45 * b - 0.45, -b - 0.9)


def ring(a: Array, b: Array) -> Array:
    """A circle with a hole."""
    return jnp.abs(disc(a, b) + 0.35) - 0.3


def plus(a: Array, b: Array) -> Array:
    """A cross, upright."""
    arm = lambda x, y: jnp.maximum(jnp.abs(x) - 0.3, jnp.abs(y) - 0.95)
    return jnp.minimum(arm(a, b), arm(b, a))


def saltire(a: Array, b: Array) -> Array:
    """A cross, leaning."""
    return plus(0.72 * (a + b), 0.72 * (a - b))


def hexagon(a: Array, b: Array) -> Array:
    """Six sides."""
    return jnp.maximum(jnp.abs(b) - 0.85, 0.87 * jnp.abs(a) + 0.5 * jnp.abs(b) - 0.85)


def arch(a: Array, b: Array) -> Array:
    """A gate."""
    whole = jnp.minimum(jnp.maximum(jnp.abs(a) - 0.9, jnp.abs(b + 0.4) - 0.5), jnp.sqrt(a * a + b * b + 1e-12) - 0.9)
    hole = jnp.minimum(jnp.maximum(jnp.abs(a) - 0.45, jnp.abs(b + 0.5) - 0.55), jnp.sqrt(a * a + b * b + 1e-12) - 0.45)
    return jnp.maximum(whole, -hole)


def barbell(a: Array, b: Array) -> Array:
    """Two balls on a bar, upright."""
    ball = jnp.sqrt(a * a + jnp.square(jnp.abs(b) * 2.0 - 1.2) + 1e-12) - 0.8
    return jnp.minimum(ball, jnp.maximum(jnp.abs(a) - 0.25, jnp.abs(b) - 0.6))


def coil(a: Array, b: Array) -> Array:
    """A zigzag stack."""
    lean = jnp.abs(jnp.mod(b * 2.5 + 0.5, 2.0) - 1.0) - 0.5
    return jnp.maximum(jnp.abs(a - 0.7 * lean) - 0.45, jnp.abs(b) - 0.95)


def cylinder(a: Array, b: Array) -> Array:
    """A drum, seen from the side."""
    return jnp.maximum(jnp.abs(a) - 0.95, jnp.abs(b) - 0.95)


def prism(a: Array, b: Array) -> Array:
    """Two triangles, point to point."""
    return jnp.maximum(jnp.abs(b) - 0.95, jnp.abs(a) - 0.15 - 0.8 * jnp.abs(b))


def cup(a: Array, b: Array) -> Array:
    """Wider at the top than at the bottom, with a foot."""
    return jnp.minimum(
        jnp.maximum(jnp.abs(a) - 0.65 - 0.3 * b, jnp.abs(b - 0.2) - 0.75),
        jnp.maximum(jnp.abs(a) - 0.6, jnp.abs(b + 0.85) - 0.12),
    )


def jack(a: Array, b: Array) -> Array:
    """A star of eight thin arms."""
    arm = lambda x, y: jnp.maximum(jnp.abs(x) - 0.14, jnp.abs(y) - 0.95)
    return jnp.minimum(
        jnp.minimum(arm(a, b), arm(b, a)),
        jnp.minimum(arm(0.72 * (a + b), 0.72 * (a - b)), arm(0.72 * (a - b), 0.72 * (a + b))),
    )


def hat(a: Array, b: Array) -> Array:
    """A crown on a wide brim."""
    return jnp.minimum(
        jnp.maximum(jnp.abs(a) - 0.55, jnp.abs(b - 0.1) - 0.85), jnp.maximum(jnp.abs(a) - 0.98, jnp.abs(b + 0.75) - 0.2)
    )


def balloon(a: Array, b: Array) -> Array:
    """A ball on a string."""
    ball = jnp.sqrt(jnp.square(a) + jnp.square((b - 0.25) * 1.33) + 1e-12) - 0.95
    return jnp.minimum(ball, jnp.maximum(jnp.abs(a) - 0.06, jnp.abs(b + 0.75) - 0.25))


SYMBOLS: tuple[Silhouette, ...] = (disc, triangle, square, diamond, plus, hexagon, arch, saltire)


@jax.named_scope("rendering")
def draw(scene: Scene, shapes: tuple[Silhouette, ...], position: Array, yaw: Array, size: int) -> Array:
    """The picture, uint8 [size, size, 3]."""
    forward, right = heading(yaw)
    centres = (jnp.arange(size, dtype=jnp.float32) + 0.5) * (2 / size) - 1  # tangents of the angles
    across, up = centres, -centres
    rays = forward[None] + across[:, None] * right[None]  # [W, 2]; depth is measured along ``forward``
    surface, depth = _rooms(scene, position, rays, up, 2 / size)
    picture = _posters(scene, surface, position, rays, up, depth, 2 / size)
    picture = _items(scene, shapes, picture, depth, position, forward, right, across, up, 2 / size)
    return jnp.clip(jnp.round(picture), 0, 255).astype(jnp.uint8)


def _rooms(scene: Scene, position: Array, rays: Array, up: Array, pixel: float) -> tuple[Array, Array]:
    """Walls, floor and ceiling: colours [H, W, 3], and how deep they lie [H, W]."""
    walls = scene.walls
    start, along = walls.ends[:, :2], walls.ends[:, 2:] - walls.ends[:, :2]  # [S, 2]
    length = jnp.linalg.norm(along, axis=1)
    # position + t * ray = start + s * along
    cross = rays[:, None, 0] * along[None, :, 1] - rays[:, None, 1] * along[None, :, 0]  # [W, S]
    offset = start - position[None]
    t = (offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0])[None] / jnp.where(jnp.abs(cross) < 1e-6, 1e-6, cross)
    s = (offset[None, :, 0] * rays[:, None, 1] - offset[None, :, 1] * rays[:, None, 0]) / jnp.where(
        jnp.abs(cross) < 1e-6, 1e-6, cross
    )
    meets = walls.active[None] & (t > 0.1) & (s >= -1e-4) & (s <= 1 + 1e-4) & (jnp.abs(cross) >= 1e-6)
    t = jnp.where(meets, t, 1e6)

    height = scene.eye + up[:, None, None] * t[None]  # [H, W, S]
    there = meets[None] & (height >= walls.bottom[None, None])
    nearest = jnp.where(there, t[None], 1e6)
    which = jnp.argmin(nearest, axis=2)  # [H, W]
    pick = lambda x: jnp.take_along_axis(x, which[..., None], axis=2)[..., 0]
    wall_depth = pick(nearest)

    place = pick(jnp.broadcast_to((s * length[None])[None], nearest.shape))
    z = scene.eye + up[:, None] * wall_depth
    facing = along / length[:, None]
    slant = jnp.abs(cross) / (jnp.linalg.norm(rays, axis=1)[:, None] * length[None])
    width = pixel * wall_depth
    lines = jnp.maximum(
        _stripes(place, width / pick(jnp.broadcast_to(jnp.maximum(slant, 0.05)[None], nearest.shape))),
        _stripes(z, width),
    )
    light = 0.8 + 0.2 * jnp.abs(facing[:, 0])  # walls along x are lighter, so that corners are seen
    colour = walls.colour[which] * light[which][..., None] * (1 - 0.45 * lines)[..., None]

    flat = jnp.where(up < 0, -scene.eye / jnp.minimum(up, -1e-4), (scene.height - scene.eye) / jnp.maximum(up, 1e-4))
    flat = jnp.broadcast_to(flat[:, None], wall_depth.shape)  # [H, W]
    point = position[None, None] + flat[..., None] * rays[None]
    blur = pixel * flat * jnp.maximum(1.0, flat / scene.eye)
    grid = jnp.maximum(_stripes(point[..., 0], blur), _stripes(point[..., 1], blur))
    far = jnp.linalg.norm(point - scene.mark[:2], axis=-1)
    marked = scene.mark[3] * jnp.clip(0.5 - (far - scene.mark[2]) / jnp.maximum(blur, 1e-3), 0, 1)
    ground = scene.floor * (1 - 0.35 * grid)[..., None] * (1 - 0.7 * marked)[..., None]
    below = jnp.broadcast_to((up < 0)[:, None], wall_depth.shape)
    flat_colour = jnp.where(below[..., None], ground, scene.ceiling)

    is_wall = wall_depth <= flat
    depth = jnp.minimum(wall_depth, flat)
    shade = 1 / (1 + depth / 1500.0)
    picture = jnp.where(is_wall[..., None], colour, flat_colour)
    return picture * jnp.where(is_wall | below, shade, 1.0)[..., None], depth


def _stripes(x: Array, width: Array) -> Array:
    """How much of ``width`` around ``x`` lies on lines of width `LINE`, one every `PANEL`; in [0, 1]."""
    width = jnp.maximum(width, 1e-3)
    covered = lambda x: jnp.floor(x / PANEL) * LINE + jnp.minimum(jnp.mod(x, PANEL), LINE)  # up to x
    return jnp.clip((covered(x + width / 2) - covered(x - width / 2)) / width, 0, 1)


def _posters(
    scene: Scene, picture: Array, position: Array, rays: Array, up: Array, depth: Array, pixel: float
) -> Array:
    posters = scene.posters
    if posters is None:
        return picture
    point = position[None, None] + depth[..., None] * rays[None]
    z = scene.eye + up[:, None] * depth

    sharp = POSTER_SIZE[0] / 2 / jnp.maximum(pixel * depth, 1e-3)
    for number, shape in enumerate(SYMBOLS):  # each poster has a symbol of its own
        across, offset = posters.across[number], point - posters.position[number]
        a = (offset @ across) / (POSTER_SIZE[0] / 2)
        b = (z - POSTER_HEIGHT) / (POSTER_SIZE[1] / 2)
        off_wall = jnp.abs(offset[..., 0] * across[1] - offset[..., 1] * across[0])
        inside = jnp.clip(0.5 - (jnp.maximum(jnp.abs(a), jnp.abs(b)) - 1) * sharp, 0, 1)
        inside = jnp.where(off_wall < 8.0, inside, 0.0)
        on = jnp.clip(0.5 - shape(a / 0.6, b / 0.6) * 0.6 * sharp, 0, 1)
        face = posters.colour[number] * (1 - on)[..., None] + jnp.array([215.0, 245.0, 240.0]) * on[..., None]
        picture = picture + inside[..., None] * (face - picture)
    return picture


def _items(
    scene: Scene,
    shapes: tuple[Silhouette, ...],
    picture: Array,
    depth: Array,
    position: Array,
    forward: Array,
    right: Array,
    across: Array,
    up: Array,
    pixel: float,
) -> Array:
    """Objects over the picture, the farthest first."""
    items = scene.items
    offset = items.position - position[None]
    away = offset @ forward

    def put(picture: Array, item: tuple[Items, Array, Array]) -> tuple[Array, None]:
        this, distance, side = item
        safe = jnp.maximum(distance, NEAR)
        a = (across[None, :] * safe - side) / (this.size[0] / 2)
        b = (scene.eye + up[:, None] * safe - this.bottom - this.size[1] / 2) / (this.size[1] / 2)
        a, b = jnp.broadcast_arrays(a, b)
        distances = jnp.stack([shape(a, b) for shape in shapes])[this.shape]
        scale = jnp.minimum(this.size[0], this.size[1]) / 2 / (pixel * safe)
        cover = jnp.clip(0.5 - distances * scale, 0, 1)
        seen = this.active & (distance > NEAR) & (safe < depth)
        band = jnp.clip(0.5 - (jnp.abs(b) - 0.3) * this.size[1] / 2 / (pixel * safe), 0, 1)
        colour = this.colour + band[..., None] * (this.trim - this.colour)
        colour = colour * (0.85 + 0.2 * b - 0.12 * a)[..., None] / (1 + safe / 1500.0)
        return picture + jnp.where(seen, cover, 0.0)[..., None] * (colour - picture), None

    order = jnp.argsort(-away)
    sorted_items = jax.tree.map(lambda x: x[order], items)
    return jax.lax.scan(put, picture, (sorted_items, away[order], (offset @ right)[order]))[0]
