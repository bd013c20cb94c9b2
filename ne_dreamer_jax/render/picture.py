"""Draws one state of a scene as MuJoCo's own renderer would, in pure JAX.

The passes: the nearest surface at four samples of each pixel; then, for the floor and the sky and the (at most two)
objects that a pixel shows, colour and shadow once; then the reflection in the floor, once a pixel. A pixel is the mean
of these weighted by samples covered.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.render import floor as floors
from ne_dreamer_jax.render import rays, shading
from ne_dreamer_jax.render.camera import PlacedLight, camera_position, place_lights
from ne_dreamer_jax.render.rays import MISS, Array, Shape, Vec
from ne_dreamer_jax.render.scene import Group, Kind, Scene

_INTERSECT: dict[Kind, Callable[[Shape, Vec, Vec], Array]] = {
    Kind.ROUND: rays.capsule,
    Kind.CYLINDER: rays.cylinder,
    Kind.ELLIPSOID: rays.ellipsoid,
    Kind.BOX: rays.box,
    Kind.PLANE: rays.plane,
}


_FAR = MISS / 2  # the distance of what is behind everything: a hit is nearer, a miss farther


class Overrides(NamedTuple):
    """What an episode changes of the model: arrays over ALL geoms or sites in the model's order, None for no change.

    A size is MuJoCo's; an alpha of 0 hides. The floor can't be overridden.
    """

    geom_xpos: Array | None = None  # float32 [ngeom, 3], world frame; instead of data.geom_xpos
    geom_size: Array | None = None  # float32 [ngeom, 3]
    geom_rgba: Array | None = None  # float32 [ngeom, 4]
    site_xpos: Array | None = None  # float32 [nsite, 3], world frame; instead of data.site_xpos
    site_size: Array | None = None  # float32 [nsite, 3]
    site_rgba: Array | None = None  # float32 [nsite, 4]


class _Solids(NamedTuple):
    """The drawn objects of one kind in one state; arrays over its n objects."""

    kind: Kind
    shape: Shape  # [n]
    rgb: Vec  # [n]
    casts: np.ndarray  # bool [n], sites cast no shadow
    first: int  # number of the group's first object among all


def draw(scene: Scene, data: Any, overrides: Overrides | None = None) -> Array:
    """One state's picture: uint8 [height, width, 3]. Pure; vmap it over states.

    Args:
      scene: from ``build``; closed over, not traced.
      data: an ``mjx.Data``, or anything with its ``geom_xpos``, ``geom_xmat``, ``site_xpos``, ``site_xmat``,
        ``cam_xpos``, and for lights that move ``subtree_com`` and ``xpos``.
      overrides: sizes, places and colours that this episode changes.
    """
    camera, lights = camera_position(scene, data), place_lights(scene, data)
    solids = _place(scene, data, overrides or Overrides())
    count = sum(group.rgb.x.shape[0] for group in solids)
    coder = _KeyCoder(count + 2)
    floor_id, sky_id = count, count + 1
    num_pixels = scene.height * scene.width

    samples = Vec(*scene.sample_rays)  # [4, N]
    key = jnp.full((4, num_pixels), coder.encode(jnp.float32(_FAR), sky_id))
    if scene.floor is not None:
        t = rays.plane(floors.shape(scene.floor), camera, samples)
        key = jnp.where(t < MISS, coder.encode(t, floor_id), key)
    key = _nearest(solids, camera, samples, key, coder)
    ids, t = coder.decode(key)

    total = jnp.zeros((3, num_pixels))
    is_sky = ids == sky_id
    total += scene.sky * _coverage(is_sky)[None]
    if scene.floor is not None:
        is_floor = ids == floor_id
        color = _floor_color(scene, camera, lights, solids, is_floor, coder)
        total += jnp.where(is_floor.any(0)[None], color * _coverage(is_floor)[None], 0.0)
    first = ids.min(0)
    last = jnp.where(ids < count, ids, -1).max(0)
    for number, again in ((first, False), (last, True)):
        mine = ids == number[None]
        weight = (
            _coverage(mine)
            if again
            else _coverage((ids < count) & (ids != last[None])) + jnp.where(first == last, _coverage(mine), 0.0)
        )
        if again:
            weight = jnp.where(first == last, 0.0, weight)
        color = _solid_color(scene, camera, lights, solids, number, mine, samples, t, count)
        total += jnp.where((weight > 0)[None], color * weight[None], 0.0)
    image = jnp.clip(total, 0.0, 1.0).T.reshape(scene.height, scene.width, 3)
    return (image * 255.0 + 0.5).astype(jnp.uint8)


class _KeyCoder:
    """Packs a distance and an object's number into one int32 whose order is the distance's.

    Positive floats sort as their bits do; the number replaces the lowest of these.
    """

    def __init__(self, count: int):
        self.mask = (1 << max(1, (count - 1).bit_length())) - 1

    def encode(self, t: Any, number: Any) -> Array:
        bits = jax.lax.bitcast_convert_type(t, jnp.int32)
        return (bits & ~self.mask) | number

    def decode(self, key: Array) -> tuple[Array, Array]:
        """Object's number and distance."""
        return key & self.mask, jax.lax.bitcast_convert_type(key & ~self.mask, jnp.float32)


def _coverage(samples: Array) -> Array:
    """Fraction [N] of the samples [4, N] that are set."""
    return samples.astype(jnp.float32).mean(0)


def _place(scene: Scene, data: Any, overrides: Overrides) -> list[_Solids]:
    solids, first = [], 0
    for group in scene.groups:
        solids.append(_place_group(group, data, overrides, first))
        first += group.size.shape[0]
    return solids


def _place_group(group: Group, data: Any, overrides: Overrides, first: int) -> _Solids:
    split = len(group.geoms)

    def select(geom: Any, site: Any) -> Array:
        parts = [(geom, group.geoms), (site, group.sites)]
        return jnp.concatenate([jnp.asarray(array, jnp.float32)[ids] for array, ids in parts if len(ids)])

    def override(geom: Any, site: Any, original: np.ndarray) -> Array:
        parts = [(geom, group.geoms, original[:split]), (site, group.sites, original[split:])]
        return jnp.concatenate(
            [
                jnp.asarray(own if new is None else new, jnp.float32)[slice(None) if new is None else ids]
                for new, ids, own in parts
                if len(ids)
            ]
        )

    position = select(
        data.geom_xpos if overrides.geom_xpos is None else overrides.geom_xpos,
        data.site_xpos if overrides.site_xpos is None else overrides.site_xpos,
    )
    frame = select(data.geom_xmat, data.site_xmat).reshape(-1, 3, 3)
    rgba = override(overrides.geom_rgba, overrides.site_rgba, group.rgba)
    size = override(overrides.geom_size, overrides.site_size, group.size) * group.size_mask
    if group.kind is not Kind.PLANE:  # of size zero is out of sight
        size = jnp.where(rgba[:, 3:] > 0, size, 0.0)
    return _Solids(
        kind=group.kind,
        shape=Shape(
            Vec.of(position), Vec.of(frame[:, :, 0]), Vec.of(frame[:, :, 1]), Vec.of(frame[:, :, 2]), Vec.of(size)
        ),
        rgb=Vec.of(rgba),
        casts=np.arange(len(group.rgba)) < split,
        first=first,
    )


def _nearest(
    solids: list[_Solids], origin: Vec, direction: Vec, key: Array, coder: _KeyCoder, after: Any = None
) -> Array:
    """The smallest of ``key`` and the keys of all objects that the rays enter (beyond distance ``after``)."""
    for group in solids:
        intersect = _INTERSECT[group.kind]

        def nearer(
            key: Array, item: tuple[Shape, Array], intersect: Callable[..., Array] = intersect
        ) -> tuple[Array, None]:
            shape, number = item
            t = intersect(shape, origin, direction)
            if after is not None:
                t = jnp.where(t > after, t, MISS)
            return jnp.minimum(key, coder.encode(t, number)), None

        numbers = jnp.arange(len(group.casts), dtype=jnp.int32) + group.first
        key, _ = jax.lax.scan(nearer, key, (group.shape, numbers))
    return key


def _lit(scene: Scene, placed: PlacedLight, solids: list[_Solids], point: Vec, number: Array) -> Array:
    """1 where the light reaches the point [N] on object ``number``, 0 in shadow."""
    light = placed.light
    if not light.casts_shadow:
        return jnp.ones_like(point.x)
    offset = point - placed.position
    if light.directional:
        origin, direction, end = point, -placed.direction, MISS
    else:
        origin, direction, end = placed.position, offset, 1.0 - 1e-3
    dark = jnp.zeros(point.x.shape, bool)
    for group in solids:
        intersect = _INTERSECT[group.kind]
        casters = np.flatnonzero(group.casts)
        if not casters.size:
            continue

        def shade(
            dark: Array, item: tuple[Shape, Array], intersect: Callable[..., Array] = intersect
        ) -> tuple[Array, None]:
            shape, caster = item
            return dark | ((intersect(shape, origin, direction) < end) & (caster != number)), None

        casting = jax.tree.map(lambda a, casters=casters: a[casters], group.shape)
        dark, _ = jax.lax.scan(shade, dark, (casting, jnp.asarray(casters + group.first, jnp.int32)))
    # Outside the shadow map everything is lit. Its sides are parallel to these two directions.
    side = Vec(0.0, placed.direction.z, -placed.direction.y).unit()
    up = placed.direction.cross(side)
    if light.directional:
        reach: Any = scene.shadow_clip
    else:
        angle = min(2 * light.cutoff * scene.shadow_scale, 160.0) / 2
        reach = offset.dot(placed.direction) * float(np.tan(np.deg2rad(angle)))
    inside = (jnp.abs(offset.dot(side)) < reach) & (jnp.abs(offset.dot(up)) < reach)
    return 1.0 - (dark & inside).astype(jnp.float32)


def _floor_color(
    scene: Scene, camera: Vec, lights: list[PlacedLight], solids: list[_Solids], covered: Array, coder: _KeyCoder
) -> Array:
    """The floor's colour [3, N] at the pixels' centres, with shadows and reflections."""
    floor = scene.floor
    assert floor is not None
    frame = floors.shape(floor)
    # Where the floor ends within a pixel, the middle of what is seen of it.
    count = covered.astype(jnp.float32).sum(0)
    weight = covered.astype(jnp.float32) / jnp.maximum(count, 1.0)[None]
    partly = (count > 0) & (count < 4)
    samples = Vec(*scene.sample_rays)
    middle = Vec(*((component * weight).sum(0) for component in (samples.x, samples.y, samples.z)))
    direction = Vec.where(partly, middle, Vec(*scene.center_rays))
    t = -(camera - frame.center).dot(frame.z) / rays._signed_floor(direction.dot(frame.z))
    t = jnp.where((count > 0) & (t > 0), t, 1.0)
    point = camera + direction * t
    x, y = (point - frame.center).dot(frame.x), (point - frame.center).dot(frame.y)
    levels = floors.light(scene, x, y, camera, lights)
    number = jnp.full(t.shape, -1, jnp.int32)
    level = levels[0]
    for placed, own in zip(lights, levels[1:], strict=True):
        level = level + own * _lit(scene, placed, solids, point, number)
    color = floors.texture(scene, x, y, t, direction)
    result = jnp.stack([level.x * color.x, level.y * color.y, level.z * color.z])
    if floor.reflectance > 0 and solids:
        result += _reflection(scene, camera, lights, solids, direction, t, coder)
    return result


def _reflection(
    scene: Scene,
    camera: Vec,
    lights: list[PlacedLight],
    solids: list[_Solids],
    direction: Vec,
    floor_t: Array,
    coder: _KeyCoder,
) -> Array:
    """What the floor mirrors [3, N], to be added to it: unshadowed, colours (but not highlights) dimmed."""
    floor = scene.floor
    assert floor is not None
    origin, direction = floors.mirror(floor, camera, direction)
    count = sum(len(group.casts) for group in solids)
    key = jnp.full(floor_t.shape, coder.encode(jnp.float32(_FAR), count))
    ids, t = coder.decode(_nearest(solids, origin, direction, key, coder, after=floor_t))
    hit = ids < count
    point = origin + direction * jnp.where(hit, t, 1.0)
    point, normal, rgb = _surface(solids, ids, point, direction)
    to_camera = (-direction).unit()
    look = (normal, to_camera, 0.5, 64.0)
    parts = [shading.headlight(scene.headlight, Vec.of(scene.camera_axes[:, 2]), *look)]
    parts += [shading.scene_light(placed, point, *look) for placed in lights]
    diffuse = sum(part.diffuse for part in parts) * floor.reflectance
    color = shading.Reflected(diffuse, sum(part.specular for part in parts)).color(rgb)
    return jnp.where(hit[None], jnp.stack([color.x, color.y, color.z]), 0.0)


def _solid_color(
    scene: Scene,
    camera: Vec,
    lights: list[PlacedLight],
    solids: list[_Solids],
    number: Array,
    covered: Array,
    samples: Vec,
    t: Array,
    count: int,
) -> Array:
    """Colour [3, N] of object ``number`` [N], seen at the middle of the samples that it covers."""
    weight = covered.astype(jnp.float32)
    weight = weight / jnp.maximum(weight.sum(0), 1.0)[None]
    direction = Vec(*((component * weight).sum(0) for component in (samples.x, samples.y, samples.z)))
    distance = jnp.where(number < count, (jnp.where(covered, t, 0.0) * weight).sum(0), 1.0)
    point = camera + direction * distance
    point, normal, rgb = _surface(solids, number, point, direction)
    to_camera = (camera - point).unit()
    look = (normal, to_camera, 0.5, 64.0)
    total = shading.headlight(scene.headlight, Vec.of(scene.camera_axes[:, 2]), *look).color(rgb)
    for placed in lights:
        own = shading.scene_light(placed, point, *look).color(rgb)
        total = total + own * _lit(scene, placed, solids, point, number)
    return jnp.stack([total.x, total.y, total.z])


def _surface(solids: list[_Solids], number: Array, point: Vec, direction: Vec) -> tuple[Vec, Vec, Vec]:
    """On object ``number`` [N] and near ``point``: the surface's point, unit normal and colour."""
    flat = {Kind.CYLINDER, Kind.PLANE}
    rows = [
        jnp.stack(
            [
                *(s.shape.center.x, s.shape.center.y, s.shape.center.z),
                *(s.shape.z.x, s.shape.z.y, s.shape.z.z),
                s.shape.size.x if s.kind is not Kind.PLANE else jnp.full_like(s.rgb.x, 1e6),
                s.shape.size.y if s.kind is not Kind.PLANE else jnp.zeros_like(s.rgb.x),
                jnp.full_like(s.rgb.x, 1.0 if s.kind in flat else 0.0),
                *(s.rgb.x, s.rgb.y, s.rgb.z),
            ]
        )
        for s in solids
    ]
    table = jnp.concatenate(rows, 1)  # [12, P]
    chosen = (number[None] == jnp.arange(table.shape[1], dtype=jnp.int32)[:, None]).astype(jnp.float32)  # [P, N]
    row = jax.lax.dot(table, chosen, precision=jax.lax.Precision.HIGHEST)
    center, axis, radius, half, flat_end, rgb = Vec(*row[:3]), Vec(*row[3:6]), row[6], row[7], row[8], Vec(*row[9:12])
    offset = point - center
    along = offset.dot(axis)
    end = jnp.clip(along, -half, half)
    across = offset - axis * end
    depth = radius - jnp.sqrt(across.dot(across))
    normal = across.unit()
    on_end = (flat_end > 0.5) & (half - jnp.abs(along) < depth)
    normal = Vec.where(on_end, axis * -jnp.sign(direction.dot(axis)), normal)
    for s in solids:
        if s.kind not in (Kind.BOX, Kind.ELLIPSOID):
            continue
        for i in range(len(s.casts)):
            shape = jax.tree.map(lambda a, i=i: a[i], s.shape)
            normal = Vec.where(number == s.first + i, _normal(s.kind, shape, point, direction), normal)
    return point, normal, rgb


def _normal(kind: Kind, shape: Shape, point: Vec, direction: Vec) -> Vec:
    offset = point - shape.center
    local = Vec(offset.dot(shape.x), offset.dot(shape.y), offset.dot(shape.z))
    if kind is Kind.ELLIPSOID:
        q = Vec(
            *(
                a / jnp.maximum(s * s, 1e-12)
                for a, s in zip((local.x, local.y, local.z), (shape.size.x, shape.size.y, shape.size.z), strict=True)
            )
        )
        return (shape.x * q.x + shape.y * q.y + shape.z * q.z).unit()
    gap = Vec(shape.size.x - jnp.abs(local.x), shape.size.y - jnp.abs(local.y), shape.size.z - jnp.abs(local.z))
    on_x = (gap.x <= gap.y) & (gap.x <= gap.z)
    on_y = gap.y <= gap.z
    axis = Vec.where(on_x, shape.x, Vec.where(on_y, shape.y, shape.z))
    return axis * -jnp.sign(direction.dot(axis))
