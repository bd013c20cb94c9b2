"""The floor: a checkered, reflective rectangle, lit at the corners of a grid as OpenGL lights it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.render import shading
from ne_dreamer_jax.render.camera import PlacedLight
from ne_dreamer_jax.render.rays import Array, Shape, Vec
from ne_dreamer_jax.render.scene import Floor, Scene

_MAX_GRID = 198  # MuJoCo's limit on the cells along half a side


def shape(floor: Floor) -> Shape:
    """The floor as rays meet it."""
    axes = floor.axes.T
    return Shape(Vec.of(floor.center), Vec.of(axes[0]), Vec.of(axes[1]), Vec.of(axes[2]), Vec.of(floor.size))


def _cell(position: Any, half: float, spacing: float) -> tuple[Any, Any]:
    """Ends of the grid cell around ``position``: cells of twice the spacing, with what is left over at both sides."""
    spacing = max(spacing, half / _MAX_GRID)
    count = int(half // spacing)
    pad = half - (count - count % 2) * spacing
    low = -half + pad + jnp.floor((position + half - pad) / (2 * spacing)) * (2 * spacing)
    return jnp.maximum(low, -half), jnp.minimum(low + 2 * spacing, half)


def light(scene: Scene, x: Any, y: Any, camera: Vec, lights: list[PlacedLight]) -> list[Vec]:
    """Levels of the headlight and of each light at the floor's own coordinates: unshadowed, before the texture."""
    floor = scene.floor
    assert floor is not None
    frame = shape(floor)
    backwards = Vec.of(scene.camera_axes[:, 2])
    rgb = Vec(*(float(c) for c in floor.rgb))

    def corner(x: Any, y: Any) -> list[Vec]:
        point = frame.center + frame.x * x + frame.y * y
        to_camera = (camera - point).unit()
        look = (frame.z, to_camera, floor.specular, floor.shininess)
        head = shading.headlight(scene.headlight, backwards, *look)
        return [head.color(rgb), *(shading.scene_light(placed, point, *look).color(rgb) for placed in lights)]

    size_x, size_y, spacing = (float(s) for s in floor.size)
    if size_x <= 0 or size_y <= 0:  # an infinite plane's cells are far finer than what the picture shows
        return corner(x, y)
    x0, x1 = _cell(x, size_x, spacing)
    y0, y1 = _cell(y, size_y, spacing)
    u, v = (x - x0) / (x1 - x0), (y - y0) / (y1 - y0)
    upper = u + v > 1
    # A cell is two triangles that share the diagonal from (x1, y0) to (x0, y1).
    weights = (jnp.where(upper, 1 - v, u), jnp.where(upper, 1 - u, v), jnp.abs(1 - u - v))
    corners = (corner(x1, y0), corner(x0, y1), corner(jnp.where(upper, x1, x0), jnp.where(upper, y1, y0)))
    return [a * weights[0] + b * weights[1] + c * weights[2] for a, b, c in zip(*corners, strict=True)]


def texture(scene: Scene, x: Any, y: Any, distance: Any, direction: Vec) -> Vec:
    """The checker's colour where ``direction`` meets the floor at ``distance``, filtered over the pixel's footprint.

    A box filter in closed form stands for the mipmaps: no gathers.
    """
    floor = scene.floor
    assert floor is not None
    checker = floor.checker
    if checker is None:
        return Vec(1.0, 1.0, 1.0)
    u = x * checker.scale[0] + checker.offset[0]
    v = checker.offset[1] - y * checker.scale[1]
    width = jnp.maximum(footprint(scene, distance, direction), 1.0) * (_FILTER / checker.texels)

    def wave(phase: Any) -> Any:  # integral of the square wave that is +1, then -1
        return jnp.abs(2 * (phase - jnp.floor(phase)) - 1)

    def mean(phase: Any) -> Any:  # of that square wave over the filter's width
        return (wave(phase + width * 0.5) - wave(phase - width * 0.5)) / (2 * width)

    quarter = checker.texels // 4
    sign = float(2 * checker.pattern[quarter, quarter] - 1)
    level = 0.5 + (0.5 * sign) * mean(u) * mean(v)
    low, high = checker.colors
    return Vec(*(float(a) + level * float(b - a) for a, b in zip(low, high, strict=True)))


_FILTER = 1.5  # width of the box, in texels of the chosen mipmap


def footprint(scene: Scene, distance: Any, direction: Vec) -> Array:
    """Texels of the finest mipmap between neighbouring pixels, the larger of the two ways (OpenGL's rho)."""
    floor = scene.floor
    assert floor is not None
    assert floor.checker is not None
    axes = floor.axes
    depth = 1 / direction.dot(Vec.of(axes[:, 2]))
    texels = floor.checker.scale * floor.checker.texels
    result: Any = 0.0
    for step in (scene.camera_axes[:, 0] * scene.pixel_size, scene.camera_axes[:, 1] * scene.pixel_size):
        across, along, down = (float(s) for s in step @ axes)
        dx = distance * (across - direction.dot(Vec.of(axes[:, 0])) * down * depth)
        dy = distance * (along - direction.dot(Vec.of(axes[:, 1])) * down * depth)
        result = jnp.maximum(result, jnp.maximum(jnp.abs(dx) * float(texels[0]), jnp.abs(dy) * float(texels[1])))
    return jnp.asarray(result)


def reflectance(floor: Floor | None) -> float:
    """How much of the scene shows in the floor, 0 to 1."""
    return 0.0 if floor is None else floor.reflectance


def mirror(floor: Floor, camera: Vec, direction: Vec) -> tuple[Vec, Vec]:
    """Camera and ray directions mirrored in the floor."""
    normal = Vec.of(np.asarray(floor.axes[:, 2]))
    height = (camera - Vec.of(floor.center)).dot(normal)
    return camera - normal * (2 * height), direction - normal * (2 * direction.dot(normal))
