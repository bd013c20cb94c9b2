"""Draws one state of a scene as MuJoCo's own renderer would, in pure JAX.

First the nearest surface at four samples of each pixel, seen by the camera and by its mirror image in the floor. Then
what these samples show, each shaded once a pixel: the sky, the floor and one object, the one that most samples see or,
where none does, the one that the floor reflects. A pixel is the mean of these weighted by the samples that each covers.
"""

from __future__ import annotations

from collections.abc import Sequence
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


@jax.named_scope("rendering")
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

    # Two views: of the camera, and of its mirror image through the floor.
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

    floor_seen = _fraction([n == count for n in number[0]])
    color = scene.sky * _fraction([n > count for n in number[0]])
    if floor is not None:
        color = color + _floor_color(scene, floor, lights, solids) * floor_seen
    if count:
        color = color + _solid_color(scene, origin, lights, solids, key, floor_seen)
    return _to_bytes(color).reshape(scene.height, scene.width, 3)


def _fraction(samples: Sequence[Array]) -> Array:
    """Of a pixel's samples that are set [N]."""
    return jnp.stack(samples).astype(jnp.float32).mean(0)


def _majority(numbers: Array, count: int) -> Array:
    """The object that most of a pixel's samples, numbers [samples, N], see [N]; -1 if they see none."""
    votes = []
    for number in numbers:
        same = sum((number == other).astype(jnp.int32) for other in numbers)
        votes.append(jnp.where(number < count, same * (count + 1) + number + 1, 0))
    most = jnp.maximum(jnp.maximum(votes[0], votes[1]), jnp.maximum(votes[2], votes[3]))
    return most % (count + 1) - 1


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


def _solid_color(
    scene: Scene, origin: Vec, lights: list[PlacedLight], solids: list[Solids], key: Array, floor_seen: Array
) -> Vec:
    """What objects add to the pixels [N]: the colour of one of them, times what is seen of it.

    OpenGL shades a sample's triangle at the pixel's centre, which may lie beside that triangle, even beside the object.
    On a round object this is where the ray through the centre meets the tangent plane; there the normal, which is
    linear along the triangle, is no longer unit.
    """
    count = objects.count(solids)
    number, distance = objects.decode(solids, key)
    chosen = _majority(number[0], count)
    seen = _fraction([n < count for n in number[0]])
    rays, center, start = scene.sample_rays[0], scene.center_rays[0], origin[0]
    dim: Any = 1.0
    reflected: Any = False
    if len(number) == 1:
        number, distance = number[0], distance[0]
    else:
        assert scene.floor is not None
        reflected = chosen < 0
        chosen = jnp.where(reflected, _majority(number[1], count), chosen)
        seen = jnp.where(reflected, _fraction([n < count for n in number[1]]) * floor_seen, seen)
        number, distance = (jnp.where(reflected[None], a[1], a[0]) for a in (number, distance))
        rays = Vec.where(reflected[None], scene.sample_rays[1], rays)
        center, start = Vec.where(reflected, scene.center_rays[1], center), Vec.where(reflected, origin[1], start)
        dim = jnp.where(reflected, scene.floor.reflectance, 1.0)
    chosen = jnp.maximum(chosen, 0)
    # The middle of the points that are seen of it.
    weight = (number == chosen[None]).astype(jnp.float32)
    weight = weight / jnp.maximum(weight.sum(0), 1.0)[None]
    offset = Vec(*((c * distance * weight).sum(0) for c in (rays.x, rays.y, rays.z)))
    offset, chosen, seen, center = _stage((offset, chosen, seen, center))

    surface = objects.surface(solids, chosen)
    point = start + offset
    normal, curvature = objects.normal(solids, chosen, surface, point, offset)
    point, normal = _stage((point, normal))
    # From there to where the ray through the centre meets the tangent plane; along a capsule the normal stays the same.
    offset = point - start
    step = center * (offset.dot(normal) / jnp.minimum(center.dot(normal), -0.1)) - offset
    on_side = jnp.abs((point - surface.center).dot(surface.axis)) <= surface.half
    step = step - surface.axis * jnp.where(on_side, step.dot(surface.axis), 0.0)
    beside = normal + step * curvature
    beside = _stage(beside * jnp.minimum(1.3 * jax.lax.rsqrt(beside.dot(beside)), 1.0))

    look = (normal, (start - point).unit(), scene.specular, scene.shininess, beside)
    rgb = surface.rgb * dim
    color = _round(shading.headlight(scene.headlight, scene.backwards, *look).color(rgb))
    for placed in lights:
        own = _stage(_round(shading.scene_light(placed, point, *look).color(rgb)))
        lit = _lit(scene, placed, solids, point, chosen)
        color = _add(color, own * jnp.where(reflected, 1.0, lit))
    return Vec.where(seen > 0, color * seen, _BLACK)
