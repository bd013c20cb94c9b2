"""The light that reaches the camera from a point: OpenGL's fixed-function lighting, in grey.

MuJoCo draws in two passes that are added, the headlight's and then the shadow light's, and clamps each to [0, 1].
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.render.camera import PlacedLight
from ne_dreamer_jax.render.rays import Array, Vec
from ne_dreamer_jax.render.scene import Headlight, Light


class Reflected(NamedTuple):
    """What one light contributes: ``color * diffuse + specular``, before the clamp."""

    diffuse: Any
    specular: Any

    def level(self, color: Any) -> Array:
        return jnp.clip(color * self.diffuse + self.specular, 0.0, 1.0)

    def color(self, rgb: Vec) -> Vec:
        return Vec(self.level(rgb.x), self.level(rgb.y), self.level(rgb.z))


def power(base: Any, exponent: Any) -> Any:
    """``base ** exponent`` for base >= 0; by repeated squaring where the exponent is a whole Python number."""
    if isinstance(exponent, float) and exponent.is_integer():
        result, square, left = None, base, int(exponent)
        while left:
            if left & 1:
                result = square if result is None else result * square
            square, left = square * square, left >> 1
        return jnp.ones_like(base) if result is None else result
    return jnp.exp(exponent * jnp.log(jnp.maximum(base, 1e-12)))


def _reflect(
    to_light: Vec,
    normal: Vec,
    to_camera: Vec,
    strength: Headlight | Light,
    specular: Any,
    shininess: Any,
    attenuation: Any = 1.0,
    beside: Vec | None = None,
) -> Reflected:
    """Blinn's model with all vectors unit: diffuse N.L, specular (N.H)^shininess where N.L > 0.

    ``beside`` stands for the normal in the diffuse term, see ``layers``.
    """
    facing = normal.dot(to_light)
    diffuse = jnp.where(facing > 0, (beside or normal).dot(to_light), 0.0)
    half = (to_light + to_camera).unit()
    # Below 0.3 the power of any shininess in use is nothing; the floor keeps its squarings out of denormal numbers.
    shine = power(jnp.maximum(normal.dot(half), 0.3), shininess) * specular * strength.specular
    return Reflected(
        diffuse=(strength.ambient + strength.diffuse * diffuse) * attenuation,
        specular=jnp.where(facing > 0, shine, 0.0) * attenuation,
    )


def headlight(
    strength: Headlight, backwards: Vec, normal: Vec, to_camera: Vec, specular: Any, shininess: Any, beside=None
) -> Reflected:
    """The headlight's contribution; ``backwards`` is the direction opposite to the camera's."""
    return _reflect(backwards, normal, to_camera, strength, specular, shininess, 1.0, beside)


def scene_light(
    placed: PlacedLight, point: Vec, normal: Vec, to_camera: Vec, specular: Any, shininess: Any, beside=None
) -> Reflected:
    """One scene light's contribution at ``point``, unshadowed."""
    light = placed.light
    if light.directional:
        return _reflect(-light.direction, normal, to_camera, light, specular, shininess, 1.0, beside)
    offset = placed.position - point
    distance2 = offset.dot(offset)
    to_light = offset.unit()
    constant, linear, quadratic = light.attenuation
    attenuation: Any = 1.0
    if (constant, linear, quadratic) != (1.0, 0.0, 0.0):
        attenuation = 1.0 / (constant + linear * jnp.sqrt(distance2) + quadratic * distance2)
    if light.cutoff < 180:
        cosine = -to_light.dot(light.direction)
        spot = power(jnp.maximum(cosine, 0.0), light.exponent)
        attenuation = attenuation * jnp.where(cosine >= float(np.cos(np.deg2rad(light.cutoff))), spot, 0.0)
    return _reflect(to_light, normal, to_camera, light, specular, shininess, attenuation, beside)
