"""Draws one state of a scene as MuJoCo's own renderer would, in pure JAX.

The passes: the nearest surface at four samples of each pixel; then, for the floor and for the (at most two) objects
that a pixel shows, colour and shadow once; then the reflection in the floor, once a pixel. A pixel is the mean of these
weighted by the samples that each covers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.render import floor as floors
from ne_dreamer_jax.render import rays, shading
from ne_dreamer_jax.render import string as strings
from ne_dreamer_jax.render.camera import PlacedLight, camera_position, place_lights
from ne_dreamer_jax.render.rays import MISS, Array, Shape, Vec
from ne_dreamer_jax.render.scene import FloorView, Group, Kind, Scene

_INTERSECT: dict[Kind, Callable[[Shape, Vec, Vec], Array]] = {
    Kind.ROUND: rays.capsule,
    Kind.CYLINDER: rays.cylinder,
    Kind.ELLIPSOID: rays.ellipsoid,
    Kind.BOX: rays.box,
    Kind.PLANE: rays.plane,
}
_FAR = MISS / 2  # the distance of what is behind everything: a hit is nearer, a miss farther
_BLACK = Vec(0.0, 0.0, 0.0)


class Overrides(NamedTuple):
    """What an episode changes of the model: arrays over ALL geoms or sites in the model's order, None for no change.

    An alpha of 0 hides. The floor can't be changed. Places need no override: write them into ``data.geom_xpos`` or
    ``data.site_xpos``.
    """

    geom_size: Array | None = None  # float32 [ngeom, 3], as MuJoCo's
    geom_rgba: Array | None = None  # float32 [ngeom, 4]
    site_size: Array | None = None  # float32 [nsite, 3]
    site_rgba: Array | None = None  # float32 [nsite, 4]


class _Solids(NamedTuple):
    """The drawn objects of one kind in one state; arrays over its n objects."""

    kind: Kind
    shape: Shape  # [n]
    rgb: Vec  # [n]
    casts: np.ndarray  # bool [n]: sites cast no shadow
    first: int  # number of the group's first object among all


class _View(NamedTuple):
    """One state of a scene, placed in the world."""

    scene: Scene
    camera: Vec  # scalars
    lights: list[PlacedLight]
    solids: list[_Solids]
    objects: int  # how many; numbers from 0, then the floor's, then the sky's


def draw(scene: Scene, data: Any, overrides: Overrides | None = None) -> Array:
    """One state's picture: uint8 [height, width, 3]. Pure; vmap it over states.

    Args:
      scene: from ``build``; closed over, not traced.
      data: an ``mjx.Data``, or anything with its ``geom_xpos``, ``geom_xmat``, ``site_xpos``, ``site_xmat``,
        ``cam_xpos``, and for lights that move ``subtree_com`` and ``xpos``.
      overrides: sizes, places and colours that this episode changes.
    """
    solids = _place(scene, data, overrides or Overrides())
    count = sum(len(group.casts) for group in solids)
    view = _View(scene, camera_position(scene, data), place_lights(scene, data), solids, count)
    floor = scene.floor_view
    if scene.floor is not None and floor is None:
        floor = _stage(floors.view(scene, view.camera, view.lights))

    key = _encode(view, jnp.full((4, scene.height * scene.width), _FAR, jnp.float32), count + 1)
    if floor is not None:
        key = jnp.minimum(key, _encode(view, floor.sample_distance, count))
    key = _stage(_nearest(view, view.camera, scene.sample_rays, key))
    number, distance = _decode(view, key)

    solid = number < count
    front = jnp.where(solid, number, -1).max(0)  # one of the objects seen, and ...
    front_seen = _fraction(number == front[None])
    other = jnp.where(solid, number, count).min(0)  # ... another, if there are two
    other_seen = _fraction(solid) - front_seen
    color = scene.sky * _fraction(number > count)
    if floor is not None:
        color = color + _floor_color(view, floor) * _fraction(number == count)
    for chosen, seen in ((front, front_seen), (other, other_seen)):
        covered = number == chosen[None]
        shown = seen > 0
        layer = _solid_color(view, scene.sample_rays, scene.center_rays, jnp.where(shown, chosen, 0), covered, distance)
        color = color + Vec.where(shown, layer * seen, _BLACK)
    return _to_bytes(color).reshape(scene.height, scene.width, 3)


def _stage(values: Any) -> Any:
    """The same arrays, computed once and stored.

    XLA:CPU fuses producers into each of their consumers, computes them again for each, and removes optimization
    barriers before it does so. Fusion ends at a loop that it can't see through; this one makes no iteration.
    """
    none = jax.lax.optimization_barrier(jnp.int32(0))
    return jax.lax.fori_loop(jnp.int32(0), none, lambda _, carry: jax.tree.map(lambda a: a + 1, carry), values)


def _encode(view: _View, distance: Any, number: Any) -> Array:
    """A distance and an object's number in one int32, whose order is the distance's.

    Positive floats sort as their bits do; the number replaces the lowest of these.
    """
    mask = (1 << (view.objects + 1).bit_length()) - 1
    return (jax.lax.bitcast_convert_type(jnp.asarray(distance), jnp.int32) & ~mask) | number


def _decode(view: _View, key: Array) -> tuple[Array, Array]:
    """Object's number and distance."""
    mask = (1 << (view.objects + 1).bit_length()) - 1
    return key & mask, jax.lax.bitcast_convert_type(key & ~mask, jnp.float32)


def _fraction(samples: Array) -> Array:
    """Of the samples [4, N] that are set: [N]."""
    return samples.astype(jnp.float32).sum(0) * 0.25


def _to_bytes(color: Vec) -> Array:
    """Colours in [0, 1] as uint8 [N, 3]."""
    red, green, blue = ((c * 255.0 + 0.5).astype(jnp.int32) for c in (color.x, color.y, color.z))
    packed = _stage(red | (green << 8) | (blue << 16))
    return jax.lax.bitcast_convert_type(packed, jnp.uint8)[:, :3]


def _add(color: Vec, more: Vec) -> Vec:
    """Two passes, as they add up in the frame buffer."""
    return Vec(*(jnp.minimum(a + b, 1.0) for a, b in ((color.x, more.x), (color.y, more.y), (color.z, more.z))))


def _round(color: Vec) -> Vec:
    """As one pass leaves it in the frame buffer: eight bits."""
    return Vec(*(jnp.floor(c * 255.0 + 0.5) * (1 / 255) for c in (color.x, color.y, color.z)))


def _place(scene: Scene, data: Any, overrides: Overrides) -> list[_Solids]:
    solids, first = [], 0
    for group in scene.groups:
        solids.append(_place_group(group, data, overrides, first))
        first += len(group.rgba)
    for string in scene.strings:
        shape = strings.segments(string, data.site_xpos)
        rgb = strings.color(string, data.site_xpos)
        casts = np.ones(string.segments, bool)
        solids.append(_Solids(Kind.ROUND, shape, Vec(*(jnp.full_like(shape.center.x, c) for c in rgb)), casts, first))
        first += string.segments
    return solids


def _place_group(group: Group, data: Any, overrides: Overrides, first: int) -> _Solids:
    split = len(group.geoms)

    def select(geom: Any, site: Any, geom_default: Any, site_default: Any) -> Array:
        """Rows of the group's geoms and sites out of arrays over all; defaults are over the group's only."""
        rows = []
        if split:
            rows.append(geom_default if geom is None else jnp.asarray(geom, jnp.float32)[group.geoms])
        if len(group.sites):
            rows.append(site_default if site is None else jnp.asarray(site, jnp.float32)[group.sites])
        return jnp.concatenate(rows)

    position = select(data.geom_xpos, data.site_xpos, None, None)
    frame = select(data.geom_xmat, data.site_xmat, None, None).reshape(-1, 3, 3)
    rgba = select(overrides.geom_rgba, overrides.site_rgba, group.rgba[:split], group.rgba[split:])
    size = select(overrides.geom_size, overrides.site_size, group.size[:split], group.size[split:]) * group.size_mask
    if group.kind is not Kind.PLANE:  # whose size 0 is infinite; all others vanish
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


def _nearest(view: _View, origin: Vec, direction: Vec, key: Array, after: Any = None) -> Array:
    """The smallest of ``key`` and the keys of all objects that the rays enter (beyond distance ``after``)."""
    for group in view.solids:
        intersect = _INTERSECT[group.kind]

        def nearer(
            key: Array, item: tuple[Shape, Array], intersect: Callable[..., Array] = intersect
        ) -> tuple[Array, None]:
            shape, number = item
            t = intersect(shape, origin, direction)
            if after is not None:
                t = jnp.where(t > after, t, MISS)
            return jnp.minimum(key, _encode(view, t, number)), None

        numbers = jnp.arange(len(group.casts), dtype=jnp.int32) + group.first
        key, _ = jax.lax.scan(nearer, key, (group.shape, numbers))
    return key


def _lit(view: _View, placed: PlacedLight, point: Vec, number: Any) -> Array:
    """1 where the light reaches the point [N] on object ``number``, 0 in shadow."""
    light = placed.light
    if not light.casts_shadow:
        return jnp.ones_like(point.x)
    offset = point - placed.position
    if light.directional:
        origin, direction, end = point, -light.direction, MISS
    else:
        origin, direction, end = placed.position, offset, 1.0 - 1e-3
    dark = jnp.zeros(point.x.shape, bool)
    for group in view.solids:
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
    # Outside the shadow map everything is lit.
    reach: Any = view.scene.shadow_clip
    if not light.directional:
        angle = min(2 * light.cutoff * view.scene.shadow_scale, 160.0) / 2
        reach = offset.dot(light.direction) * float(np.tan(np.deg2rad(angle)))
    inside = (jnp.abs(offset.dot(light.side)) < reach) & (jnp.abs(offset.dot(light.up)) < reach)
    return 1.0 - (dark & inside).astype(jnp.float32)


def _floor_color(view: _View, floor: FloorView) -> Vec:
    """The floor's colour [N], with shadows and reflections."""
    color = _round(floor.headlight)
    for placed, own in zip(view.lights, floor.lights, strict=True):
        color = _add(color, _round(own) * _lit(view, placed, floor.point, jnp.int32(-1)))
    assert view.scene.floor is not None
    if view.scene.floor.reflectance > 0 and view.objects:
        color = _add(color, _round(_reflection(view, floor)))
    return color


def _reflection(view: _View, floor: FloorView) -> Vec:
    """What the floor mirrors [N], to be added to it: unshadowed, colours (but not highlights) dimmed."""
    scene = view.scene
    assert scene.floor is not None
    mirrored = view._replace(camera=floors.mirror_point(scene.floor, view.camera))
    samples, center = (floors.mirror(scene.floor, d) for d in (scene.sample_rays, scene.center_rays))
    key = _encode(view, jnp.full(floor.sample_distance.shape, _FAR, jnp.float32), view.objects)
    key = _stage(_nearest(view, mirrored.camera, samples, key, after=floor.sample_distance))
    number, distance = _decode(view, key)
    hit = number < view.objects
    front = jnp.where(hit, number, -1).max(0)
    color = _solid_color(mirrored, samples, center, front, number == front[None], distance, scene.floor.reflectance)
    return Vec.where(front >= 0, color * _fraction(hit), _BLACK)


def _solid_color(
    view: _View, samples: Vec, center: Vec, number: Array, covered: Array, distance: Array, dim: float | None = None
) -> Vec:
    """Colour [N] of object ``number`` [N] in the samples [4, N] that it covers.

    OpenGL shades a sample's triangle at the pixel's centre, which may lie beside that triangle, even beside the object.
    On a round object this is where the ray through the centre meets the sample's tangent plane; there the normal,
    which is linear along the triangle, is no longer unit.
    """
    scene = view.scene
    weight = covered.astype(jnp.float32)
    weight = weight / jnp.maximum(weight.sum(0), 1.0)[None]
    surface = _fetch(view, number)
    point = view.camera + samples * jnp.where(covered, distance, 1.0)
    normal, curvature = _normal(view, number, surface, point, samples)  # [4, N]
    center = Vec(center.x[None], center.y[None], center.z[None])
    slope = jnp.minimum(center.dot(normal), -0.1)
    step = (point - view.camera).dot(normal) / slope
    step = view.camera + center * step - point
    axis = Vec(surface.axis.x[None], surface.axis.y[None], surface.axis.z[None])
    along = (point - Vec(*(c[None] for c in (surface.center.x, surface.center.y, surface.center.z)))).dot(axis)
    on_side = jnp.abs(along) <= surface.half[None]
    step = step - axis * jnp.where(on_side, step.dot(axis), 0.0)
    beside = normal + step * curvature
    beside = beside * jnp.minimum(1.3 * jax.lax.rsqrt(beside.dot(beside)), 1.0)

    def mean(v):
        return Vec((v.x * weight).sum(0), (v.y * weight).sum(0), (v.z * weight).sum(0))

    point, normal, beside = _stage((mean(point), mean(normal), mean(beside)))
    normal = normal.unit()
    look = (normal, (view.camera - point).unit(), scene.specular, scene.shininess)
    if dim is not None:
        parts = [shading.headlight(scene.headlight, scene.backwards, *look, beside)]
        parts += [shading.scene_light(placed, point, *look, beside) for placed in view.lights]
        total = shading.Reflected(sum(part.diffuse for part in parts) * dim, sum(part.specular for part in parts))
        return total.color(surface.rgb)
    color = _round(shading.headlight(scene.headlight, scene.backwards, *look, beside).color(surface.rgb))
    for placed in view.lights:
        own = _stage(_round(shading.scene_light(placed, point, *look, beside).color(surface.rgb)))
        color = _add(color, own * _lit(view, placed, point, number))
    return color


class _Surface(NamedTuple):
    """Of the object that each pixel shows; [N]."""

    center: Vec
    axis: Vec
    radius: Array
    half: Array
    is_flat: Array
    rgb: Vec


def _fetch(view: _View, number: Array) -> _Surface:
    rows = []
    for group in view.solids:
        shape, flat = group.shape, group.kind in (Kind.CYLINDER, Kind.PLANE)
        ones = jnp.ones_like(group.rgb.x)
        radius, half = (ones * 1e6, ones * 0.0) if group.kind is Kind.PLANE else (shape.size.x, shape.size.y)
        row = (shape.center, shape.z, Vec(radius, half, ones if flat else ones * 0.0), group.rgb)
        rows.append(jnp.stack([component for v in row for component in (v.x, v.y, v.z)]))
    table = jnp.concatenate(rows, 1)  # [12, P]
    chosen = (number[None] == jnp.arange(view.objects, dtype=jnp.int32)[:, None]).astype(jnp.float32)  # [P, N]
    fetched = jax.lax.dot(table, chosen, precision=jax.lax.Precision.HIGHEST)
    return _Surface(
        Vec(*fetched[:3]), Vec(*fetched[3:6]), fetched[6], fetched[7], fetched[8] > 0.5, Vec(*fetched[9:12])
    )


def _normal(view: _View, number: Array, surface: _Surface, point: Vec, direction: Vec) -> tuple[Vec, Array]:
    """Unit normal of object ``number`` [N] at ``point`` [..., N] near its surface, and 1 / radius where it is round."""
    if point.x.ndim > number.ndim:
        number = number[None]
        surface = jax.tree.map(lambda a: a[None], surface)
    offset = point - surface.center
    along = offset.dot(surface.axis)
    across = offset - surface.axis * jnp.clip(along, -surface.half, surface.half)
    normal = across.unit()
    on_end = surface.is_flat & (surface.half - jnp.abs(along) < surface.radius - jnp.sqrt(across.dot(across)))
    normal = Vec.where(on_end, surface.axis * -jnp.sign(direction.dot(surface.axis)), normal)
    curvature = jnp.where(on_end, 0.0, 1.0 / jnp.maximum(surface.radius, 1e-6))
    for group in view.solids:
        if group.kind in (Kind.BOX, Kind.ELLIPSOID):
            for i in range(len(group.casts)):
                shape = jax.tree.map(lambda a, i=i: a[i], group.shape)
                mine = number == group.first + i
                normal = Vec.where(mine, _special_normal(group.kind, shape, point), normal)
                curvature = jnp.where(mine, 0.0, curvature)
    return normal, curvature


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
