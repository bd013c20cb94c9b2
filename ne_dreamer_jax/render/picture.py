"""Draws one state of a scene as MuJoCo's own renderer would, in pure JAX.

First the nearest surface at four samples of each pixel, seen by the camera and by its mirror image in the floor. Then
what these samples show, in layers of one object a pixel: two layers of what the camera sees (hardly a pixel shows three
objects), one of the reflection. Each layer is shaded once a pixel. A pixel is the mean of sky, floor and layers,
weighted by the samples that each covers.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.render import floor as floors
from ne_dreamer_jax.render import shading
from ne_dreamer_jax.render import solids as objects
from ne_dreamer_jax.render.camera import PlacedLight, camera_position, place_lights
from ne_dreamer_jax.render.rays import MISS, Array, Vec
from ne_dreamer_jax.render.scene import SAMPLES, Scene
from ne_dreamer_jax.render.solids import FAR, Overrides, Solids

_NUM_SAMPLES = len(SAMPLES)
_BLACK = Vec(0.0, 0.0, 0.0)


def draw(scene: Scene, data: Any, overrides: Overrides | None = None) -> Array:
    """One state's picture: uint8 [height, width, 3]. Pure; vmap it over states.

    Args:
      scene: from ``build``; closed over, not traced.
      data: an ``mjx.Data``, or anything with its ``geom_xpos``, ``geom_xmat``, ``site_xpos``, ``site_xmat``,
        ``cam_xpos``, and for lights that move ``subtree_com`` and ``xpos``.
      overrides: sizes and colours that this episode changes.
    """
    num_pixels = scene.height * scene.width
    camera, lights = camera_position(scene, data), place_lights(scene, data)
    solids = objects.place(scene, data, overrides or Overrides())
    count = objects.count(solids)  # the floor is object `count`, the sky `count + 1`
    floor = scene.floor_view
    if scene.floor is not None and floor is None:
        floor = _stage(floors.view(scene, camera, lights))

    # Views: of the camera, and of its mirror image through the floor.
    origins = [camera]
    far = objects.encode(solids, jnp.full((_NUM_SAMPLES, num_pixels), FAR, jnp.float32), count + 1)
    after, start = [jnp.zeros((_NUM_SAMPLES, num_pixels))], [far]
    if floor is not None:
        start = [jnp.minimum(far, objects.encode(solids, floor.sample_distance, count))]
    if len(scene.center_rays.x) > 1:
        assert scene.floor is not None
        assert floor is not None
        origins.append(floors.mirror(scene.floor, camera))
        after.append(floor.sample_distance)
        start.append(far)
    origin = jax.tree.map(lambda *views: jnp.stack(views), *origins)
    key = objects.nearest(
        solids, origin[:, None, None], scene.sample_rays, _stage(jnp.stack(after)), _stage(jnp.stack(start))
    )
    number, _ = objects.decode(solids, key)

    def fraction(samples: Any) -> Array:
        """Of a pixel's samples that are set [N]."""
        return sum(samples[i].astype(jnp.float32) for i in range(_NUM_SAMPLES)) * (1 / _NUM_SAMPLES)

    def largest(samples: Any) -> Array:
        return jnp.maximum(jnp.maximum(samples[0], samples[1]), jnp.maximum(samples[2], samples[3]))

    solid = number < count
    front = largest(jnp.where(solid[0], number[0], -1))
    back = count - largest(jnp.where(solid[0], count - number[0], 0))
    front_seen = fraction(number[0] == front[None])
    floor_seen = fraction(number[0] == count)
    layers = [(front, front_seen, 0, 1.0), (back, fraction(solid[0]) - front_seen, 0, 1.0)]
    if len(origins) > 1:
        assert scene.floor is not None
        mirrored = largest(jnp.where(solid[1], number[1], -1))
        layers.append((mirrored, fraction(solid[1]) * floor_seen, 1, scene.floor.reflectance))

    color = scene.sky * fraction(number[0] > count)
    if floor is not None:
        color = color + _floor_color(scene, floor, lights, solids) * floor_seen
    if count:
        chosen, seen, view, dim = (
            _stage(jnp.stack([jnp.asarray(x) for x in each])) for each in zip(*layers, strict=True)
        )

        def add_layer(color: Vec, layer: tuple[Array, Array, Array, Array]) -> tuple[Vec, None]:
            chosen, seen, view, dim = layer
            shown = seen > 0
            chosen = jnp.where(shown, chosen, 0)
            own = _layer_color(scene, lights, solids, chosen, key[view], view, origin[view], dim)
            return color + Vec.where(shown, own * seen, _BLACK), None

        color, _ = jax.lax.scan(add_layer, color, (chosen, seen, view, dim))
    return _to_bytes(color).reshape(scene.height, scene.width, 3)


def _stage(values: Any) -> Any:
    """The same arrays, computed once and stored.

    XLA:CPU fuses producers into each of their consumers, computes them again for each, and removes optimization
    barriers before it does so. Fusion ends at a loop that it can't see through; this one makes no iteration.
    """
    none = jax.lax.optimization_barrier(jnp.int32(0))
    return jax.lax.fori_loop(jnp.int32(0), none, lambda _, carry: jax.tree.map(lambda a: a + 1, carry), values)


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


def _lit(scene: Scene, placed: PlacedLight, solids: list[Solids], point: Vec, number: Array) -> Array:
    """1 where the light reaches the point [N] on object ``number`` [N], 0 in shadow."""
    light = placed.light
    if not light.casts_shadow:
        return jnp.ones_like(point.x)
    offset = point - placed.position
    if light.directional:
        dark = objects.blocked(solids, point, -light.direction, MISS, number)
        reach: Any = scene.shadow_clip
    else:
        dark = objects.blocked(solids, placed.position, offset, 1.0 - 1e-3, number)
        angle = min(2 * light.cutoff * scene.shadow_scale, 160.0) / 2
        reach = offset.dot(light.direction) * float(np.tan(np.deg2rad(angle)))
    # Outside the shadow map everything is lit.
    inside = (jnp.abs(offset.dot(light.side)) < reach) & (jnp.abs(offset.dot(light.up)) < reach)
    return 1.0 - (dark & inside).astype(jnp.float32)


def _floor_color(scene: Scene, floor: Any, lights: list[PlacedLight], solids: list[Solids]) -> Vec:
    """The floor's colour [N], with shadows and without reflections."""
    color = _round(floor.headlight)
    itself = jnp.full(floor.distance.shape, -1, jnp.int32)
    for placed, own in zip(lights, floor.lights, strict=True):
        color = _add(color, _round(own) * _lit(scene, placed, solids, floor.point, itself))
    return color


def _layer_color(
    scene: Scene,
    lights: list[PlacedLight],
    solids: list[Solids],
    chosen: Array,
    key: Array,
    view: Array,
    origin: Vec,
    dim: Array,
) -> Vec:
    """Colour [N] of object ``chosen`` [N] in the samples [4, N] that it covers.

    OpenGL shades a sample's triangle at the pixel's centre, which may lie beside that triangle, even beside the object.
    On a round object this is where the ray through the centre meets the sample's tangent plane; there the normal,
    which is linear along the triangle, is no longer unit.
    """
    seen = objects.surface(solids, chosen)
    number, distance = objects.decode(solids, key)
    center = scene.center_rays[view]
    points, normals, besides = [], [], []
    total = jnp.zeros_like(seen.radius)
    for i in range(_NUM_SAMPLES):
        covered = number[i] == chosen
        weight = covered.astype(jnp.float32)
        total += weight
        direction = scene.sample_rays[view, i]
        offset = direction * jnp.where(covered, distance[i], 1.0)  # of the point from the origin
        point = origin + offset
        normal, curvature = objects.normal(solids, chosen, seen, point, direction)
        # The centre's ray meets the tangent plane this far beside the point.
        step = center * (offset.dot(normal) / jnp.minimum(center.dot(normal), -0.1)) - offset
        on_side = jnp.abs((point - seen.center).dot(seen.axis)) <= seen.half
        step = step - seen.axis * jnp.where(on_side, step.dot(seen.axis), 0.0)
        beside = normal + step * curvature
        beside = beside * jnp.minimum(1.3 * jax.lax.rsqrt(beside.dot(beside)), 1.0)
        points.append(offset * weight)
        normals.append(normal * weight)
        besides.append(beside * weight)
    share = 1 / jnp.maximum(total, 1.0)
    point, normal, beside = _stage(
        (origin + Vec.sum(points) * share, Vec.sum(normals).unit(), Vec.sum(besides) * share)
    )
    look = (normal, (origin - point).unit(), scene.specular, scene.shininess, beside)
    rgb = seen.rgb * dim
    color = _round(shading.headlight(scene.headlight, scene.backwards, *look).color(rgb))
    for placed in lights:
        own = _stage(_round(shading.scene_light(placed, point, *look).color(rgb)))
        color = _add(color, own * jnp.where(view > 0, 1.0, _lit(scene, placed, solids, point, chosen)))
    return color
