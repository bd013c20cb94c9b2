"""The objects of one state, and what rays see of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.render import rays
from ne_dreamer_jax.render import string as strings
from ne_dreamer_jax.render.rays import MISS, Array, Shape, Vec
from ne_dreamer_jax.render.scene import Group, Kind, Scene

FAR = MISS / 2  # the distance of what is behind everything: a hit is nearer, a miss farther
_INTERSECT: dict[Kind, Callable[[Shape, Vec, Vec], Array]] = {
    Kind.ROUND: rays.capsule,
    Kind.CYLINDER: rays.cylinder,
    Kind.ELLIPSOID: rays.ellipsoid,
    Kind.BOX: rays.box,
    Kind.PLANE: rays.plane,
}
_FLAT_ENDS = (Kind.CYLINDER, Kind.PLANE)
_SPECIAL = (Kind.BOX, Kind.ELLIPSOID)


class Overrides(NamedTuple):
    """What an episode changes of the model: arrays over ALL geoms or sites in the model's order, None for no change.

    An alpha of 0 hides. The floor can't be changed. Places need no override: write them into ``data.geom_xpos`` or
    ``data.site_xpos``.
    """

    geom_size: Array | None = None  # float32 [ngeom, 3], as MuJoCo's
    geom_rgba: Array | None = None  # float32 [ngeom, 4]
    site_size: Array | None = None  # float32 [nsite, 3]
    site_rgba: Array | None = None  # float32 [nsite, 4]


class Solids(NamedTuple):
    """The drawn objects of one kind in one state; arrays over its n objects."""

    kind: Kind
    shape: Shape  # [n]
    rgb: Vec  # [n]
    numbers: range  # n of them: the objects' numbers among all


class Surface(NamedTuple):
    """What each pixel shows of an object; [N]."""

    center: Vec
    axis: Vec
    radius: Array
    half: Array  # length
    has_flat_ends: Array
    rgb: Vec


def place(scene: Scene, data: Any, overrides: Overrides) -> list[Solids]:
    """All drawn objects of a state but the floor, numbered from 0."""
    solids, first = [], 0
    for group in scene.groups:
        numbers = range(first, first + len(group.rgba))
        solids.append(_place_group(group, data, overrides, numbers))
        first = numbers.stop
    for string in scene.strings:
        shape = strings.segments(string, data.site_xpos)
        rgb = strings.color(string, data.site_xpos)
        numbers = range(first, first + string.segments)
        solids.append(Solids(Kind.ROUND, shape, Vec(*(jnp.full_like(shape.center.x, c) for c in rgb)), numbers))
        first = numbers.stop
    return solids


def count(solids: list[Solids]) -> int:
    """How many objects there are."""
    return sum(len(group.numbers) for group in solids)


def _place_group(group: Group, data: Any, overrides: Overrides, numbers: range) -> Solids:
    split = len(group.geoms)

    def select(geom: Any, site: Any, geom_default: Any = None, site_default: Any = None) -> Array:
        """Rows of the group's geoms and sites out of arrays over all; defaults are over the group's only."""
        rows = []
        if split:
            rows.append(geom_default if geom is None else jnp.asarray(geom, jnp.float32)[group.geoms])
        if len(group.sites):
            rows.append(site_default if site is None else jnp.asarray(site, jnp.float32)[group.sites])
        return jnp.concatenate(rows)

    position = Vec.of(select(data.geom_xpos, data.site_xpos))
    frame = select(data.geom_xmat, data.site_xmat).reshape(-1, 3, 3)
    rgba = select(overrides.geom_rgba, overrides.site_rgba, group.rgba[:split], group.rgba[split:])
    size = select(overrides.geom_size, overrides.site_size, group.size[:split], group.size[split:]) * group.size_mask
    if group.kind is not Kind.PLANE:  # whose size 0 is infinite; all others vanish
        size = jnp.where(rgba[:, 3:] > 0, size, 0.0)
    return Solids(
        kind=group.kind,
        shape=Shape(position, Vec.of(frame[:, :, 0]), Vec.of(frame[:, :, 1]), Vec.of(frame[:, :, 2]), Vec.of(size)),
        rgb=Vec.of(rgba),
        numbers=numbers,
    )


def encode(solids: list[Solids], distance: Any, number: Any) -> Array:
    """A distance and an object's number in one int32, whose order is the distance's.

    Positive floats sort as their bits do; the number replaces the lowest of these. Numbers go up to ``count + 1``.
    """
    mask = (1 << (count(solids) + 1).bit_length()) - 1
    return (jax.lax.bitcast_convert_type(jnp.asarray(distance), jnp.int32) & ~mask) | number


def decode(solids: list[Solids], key: Array) -> tuple[Array, Array]:
    """Object's number and distance, from ``encode``."""
    mask = (1 << (count(solids) + 1).bit_length()) - 1
    return key & mask, jax.lax.bitcast_convert_type(key & ~mask, jnp.float32)


def nearest(solids: list[Solids], origin: Vec, direction: Vec, after: Array, key: Array) -> Array:
    """The smallest of ``key`` and the keys of all objects that the rays enter beyond distance ``after``.

    One object after the other, with nothing carried along but the key.
    """
    for group in solids:
        intersect = _INTERSECT[group.kind]

        def nearer(
            key: Array, item: tuple[Shape, Array], intersect: Callable[..., Array] = intersect
        ) -> tuple[Array, None]:
            shape, number = item
            t = intersect(shape, origin, direction)
            return jnp.minimum(key, encode(solids, jnp.where(t > after, t, MISS), number)), None

        key, _ = jax.lax.scan(nearer, key, (group.shape, jnp.asarray(group.numbers, jnp.int32)))
    return key


def blocked(solids: list[Solids], origin: Vec, direction: Vec, end: float, number: Array) -> Array:
    """Whether an object other than ``number`` [N] lies on a ray before distance ``end``."""
    result = jnp.zeros(number.shape, bool)
    for group in solids:
        intersect = _INTERSECT[group.kind]

        def block(
            result: Array, item: tuple[Shape, Array], intersect: Callable[..., Array] = intersect
        ) -> tuple[Array, None]:
            shape, other = item
            return result | ((intersect(shape, origin, direction) < end) & (other != number)), None

        result, _ = jax.lax.scan(block, result, (group.shape, jnp.asarray(group.numbers, jnp.int32)))
    return result


def surface(solids: list[Solids], number: Array) -> Surface:
    """What is known of object ``number`` [N]. A product with one-hot columns: XLA:CPU gathers slowly."""
    columns = []
    for group in solids:
        ones = jnp.ones_like(group.rgb.x)
        radius, half = group.shape.size.x, group.shape.size.y
        if group.kind is Kind.PLANE:  # one flat end of an infinitely wide cylinder
            radius, half = ones * 1e6, ones * 0.0
        flat = ones if group.kind in _FLAT_ENDS else ones * 0.0
        vectors = (group.shape.center, group.shape.z, Vec(radius, half, flat), group.rgb)
        columns.append(jnp.stack([component for v in vectors for component in (v.x, v.y, v.z)]))
    table = jnp.concatenate(columns, 1)  # [12, P]
    chosen = (number[None] == jnp.arange(table.shape[1], dtype=jnp.int32)[:, None]).astype(jnp.float32)  # [P, N]
    row = jax.lax.dot(table, chosen, precision=jax.lax.Precision.HIGHEST)
    return Surface(Vec(*row[:3]), Vec(*row[3:6]), row[6], row[7], row[8] > 0.5, Vec(*row[9:12]))


def normal(solids: list[Solids], number: Array, seen: Surface, point: Vec, direction: Vec) -> tuple[Vec, Array]:
    """Unit normal [N] of object ``number`` at ``point`` near its surface, and 1 / radius where it is round, else 0."""
    offset = point - seen.center
    along = offset.dot(seen.axis)
    across = offset - seen.axis * jnp.clip(along, -seen.half, seen.half)
    result = across.unit()
    curvature = 1.0 / jnp.maximum(seen.radius, 1e-6)
    if any(group.kind in _FLAT_ENDS for group in solids):
        depth = seen.radius - jnp.sqrt(across.dot(across))
        on_end = seen.has_flat_ends & (seen.half - jnp.abs(along) < depth)
        result = Vec.where(on_end, seen.axis * -jnp.sign(direction.dot(seen.axis)), result)
        curvature = jnp.where(on_end, 0.0, curvature)
    for group in solids:
        if group.kind not in _SPECIAL:
            continue
        for i, own in enumerate(group.numbers):
            shape = jax.tree.map(lambda a, i=i: a[i], group.shape)
            mine = number == own
            result = Vec.where(mine, _special_normal(group.kind, shape, point), result)
            curvature = jnp.where(mine, 0.0, curvature)
    return result, curvature


def _special_normal(kind: Kind, shape: Shape, point: Vec) -> Vec:
    """Of a box or an ellipsoid at a point near its surface."""
    offset, size = point - shape.center, shape.size
    x, y, z = offset.dot(shape.x), offset.dot(shape.y), offset.dot(shape.z)
    if kind is Kind.ELLIPSOID:
        squares = (jnp.maximum(s * s, 1e-12) for s in (size.x, size.y, size.z))
        x, y, z = (component / square for component, square in zip((x, y, z), squares, strict=True))
        return (shape.x * x + shape.y * y + shape.z * z).unit()
    depth_x, depth_y, depth_z = size.x - jnp.abs(x), size.y - jnp.abs(y), size.z - jnp.abs(z)
    on_x, on_y = (depth_x <= depth_y) & (depth_x <= depth_z), depth_y <= depth_z
    return Vec.where(on_x, shape.x * jnp.sign(x), Vec.where(on_y, shape.y * jnp.sign(y), shape.z * jnp.sign(z)))
