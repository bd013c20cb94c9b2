"""The floor: a checkered, reflective rectangle, lit at the corners of a grid as OpenGL lights it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from ne_dreamer_jax.render import rays, shading, texture
from ne_dreamer_jax.render.camera import PlacedLight
from ne_dreamer_jax.render.rays import MISS, Array, Shape, Vec
from ne_dreamer_jax.render.scene import Floor, FloorView, Scene

_MAX_CELLS = 198  # of MuJoCo's grid, along half a side


def view(scene: Scene, camera: Vec, lights: list[PlacedLight]) -> FloorView:
    """The scene's floor as the camera sees it, without shadows and reflections."""
    floor = scene.floor
    assert floor is not None
    shape = Shape(floor.center, floor.x, floor.y, floor.normal, Vec(*floor.size))
    samples, center = scene.sample_rays[0], scene.center_rays[0]
    sample_distance = rays.plane(shape, camera, samples)
    # Where the floor ends within a pixel it is looked at in the middle of what is seen of it.
    seen = (sample_distance < MISS).astype(jnp.float32)
    count = seen.sum(0)
    weight = seen / jnp.maximum(count, 1.0)[None]
    middle = Vec((samples.x * weight).sum(0), (samples.y * weight).sum(0), (samples.z * weight).sum(0))
    direction = Vec.where((count > 0) & (count < 4), middle, center)
    offset = camera - floor.center
    distance = -offset.dot(floor.normal) / rays.away_from_zero(direction.dot(floor.normal))
    distance = jnp.where((count > 0) & (distance > 0), distance, 1.0)
    point = camera + direction * distance
    x, y = (point - floor.center).dot(floor.x), (point - floor.center).dot(floor.y)
    color = _texture(scene, floor, x, y, distance, direction)
    headlight, *rest = (level * color for level in _light(scene, floor, x, y, camera, lights))
    return FloorView(sample_distance, direction, distance, point, headlight, tuple(rest))


def mirror(floor: Floor, point: Vec) -> Vec:
    """A point mirrored in the floor."""
    return point - floor.normal * (2 * (point - floor.center).dot(floor.normal))


def _texture(scene: Scene, floor: Floor, x: Array, y: Array, distance: Array, direction: Vec) -> Vec:
    """The checker's colour where ``direction`` meets the floor, filtered over the pixel's footprint."""
    checker = floor.checker
    if checker is None:
        return Vec(1.0, 1.0, 1.0)
    # How x and y change from this pixel to its neighbours; OpenGL takes the largest change, in texels.
    footprint: Any = 0.0
    for step in (scene.right * scene.pixel_size, scene.up * scene.pixel_size):
        stretch = step.dot(floor.normal) / rays.away_from_zero(direction.dot(floor.normal))
        for axis, scale in zip((floor.x, floor.y), checker.scale, strict=True):
            change = distance * (step.dot(axis) - direction.dot(axis) * stretch)
            footprint = jnp.maximum(footprint, jnp.abs(change) * (scale * checker.side))
    u, v = x * checker.scale[0] + checker.offset[0], checker.offset[1] - y * checker.scale[1]
    return texture.look_up(checker, u, v, footprint)


def _light(scene: Scene, floor: Floor, x: Array, y: Array, camera: Vec, lights: list[PlacedLight]) -> list[Vec]:
    """What the headlight and each light give the floor at its own coordinates, in [0, 1], before the texture."""

    def corner(x: Any, y: Any) -> list[Vec]:
        point = floor.center + floor.x * x + floor.y * y
        to_camera = (camera - point).unit()
        look = (floor.normal, to_camera, floor.specular, floor.shininess)
        reflected = [shading.headlight(scene.headlight, scene.backwards, *look)]
        reflected += [shading.scene_light(light, point, *look) for light in lights]
        return [each.color(floor.rgb) for each in reflected]

    size_x, size_y, spacing = floor.size
    if size_x <= 0 or size_y <= 0:  # the cells of an infinite plane are far smaller than what is seen of it
        return corner(x, y)
    x0, x1 = _cell(x, size_x, spacing)
    y0, y1 = _cell(y, size_y, spacing)
    u, v = (x - x0) / (x1 - x0), (y - y0) / (y1 - y0)
    upper = u + v > 1
    # A cell is two triangles that share the diagonal from (x1, y0) to (x0, y1); colours are linear in each.
    corners = (corner(x1, y0), corner(x0, y1), corner(jnp.where(upper, x1, x0), jnp.where(upper, y1, y0)))
    weights = (jnp.where(upper, 1 - v, u), jnp.where(upper, 1 - u, v), jnp.abs(1 - u - v))
    return [a * weights[0] + b * weights[1] + c * weights[2] for a, b, c in zip(*corners, strict=True)]


def _cell(position: Array, half: float, spacing: float) -> tuple[Array, Array]:
    """Ends of the grid cell around ``position``.

    An even number of cells of twice the spacing, and at both sides a cell as wide as what is left over.
    """
    spacing = max(spacing, half / _MAX_CELLS)
    count = int(half / spacing) // 2 * 2
    pad = half - count * spacing
    first, last = (-1, count) if pad > 1e-6 * half else (0, count - 1)
    index = jnp.clip(jnp.floor((position + half - pad) / (2 * spacing)), first, last)
    low = jnp.maximum(-half + pad + index * (2 * spacing), -half)
    return low, jnp.where(index < 0, -half + pad, jnp.minimum(low + 2 * spacing, half))
