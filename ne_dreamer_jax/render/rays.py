"""Where rays meet primitive shapes.

Every function takes a ray ``origin + t * direction`` and returns the distance ``t`` (in units of ``|direction|``) at
which it enters the shape from outside, or ``MISS``. Vectors are triples of arrays that broadcast as scalars or as
equal shapes: component by component, XLA fuses a whole intersection into one loop and stores nothing but ``t``.
A ray that starts inside a shape, or only leaves it, misses it.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp

Array = jax.Array
MISS = 1e8  # farther than anything drawn; finite, so that arithmetic on it stays finite
_TINY = 1e-12


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Vec:
    """Three components, each an array of the same shape (or a scalar)."""

    x: Any
    y: Any
    z: Any

    def __add__(self, other: Vec) -> Vec:
        return Vec(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Vec) -> Vec:
        return Vec(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, scale: Any) -> Vec:
        """By a number, or component by component by a vector."""
        by = scale if isinstance(scale, Vec) else Vec(scale, scale, scale)
        return Vec(self.x * by.x, self.y * by.y, self.z * by.z)

    def __neg__(self) -> Vec:
        return Vec(-self.x, -self.y, -self.z)

    def __getitem__(self, index: Any) -> Vec:
        return Vec(*(jnp.asarray(c)[index] for c in (self.x, self.y, self.z)))

    def dot(self, other: Vec) -> Any:
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: Vec) -> Vec:
        return Vec(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def unit(self) -> Vec:
        return self * jax.lax.rsqrt(jnp.maximum(self.dot(self), 1e-20))

    @staticmethod
    def of(array: Any) -> Vec:
        """From an array whose last axis has length 3."""
        return Vec(array[..., 0], array[..., 1], array[..., 2])

    @staticmethod
    def sum(vectors: Iterable[Vec]) -> Vec:
        first, *rest = vectors
        return functools.reduce(operator.add, rest, first)

    @staticmethod
    def where(condition: Any, yes: Vec, no: Vec) -> Vec:
        return Vec(
            jnp.where(condition, yes.x, no.x), jnp.where(condition, yes.y, no.y), jnp.where(condition, yes.z, no.z)
        )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Shape:
    """A placed primitive: centre, axes of its own frame and MuJoCo's three size numbers (metres)."""

    center: Vec
    x: Vec
    y: Vec
    z: Vec
    size: Vec


def away_from_zero(value: Any) -> Any:
    """``value``, but never so near zero that dividing by it overflows float32."""
    return jnp.where(jnp.abs(value) < _TINY, _TINY, value)


def capsule(shape: Shape, origin: Vec, direction: Vec) -> Array:
    """Capsule along the shape's z axis: ``size.x`` radius, ``size.y`` half length. Half length 0 is a sphere."""
    axis, radius, half = shape.z, shape.size.x, shape.size.y
    offset = origin - shape.center
    # The infinite cylinder. Cross products keep float32 precise where the ray's origin is hundreds of radii away.
    normal = direction.cross(axis)
    a = jnp.maximum(normal.dot(normal), _TINY)
    gap = offset.dot(normal)
    along, slope, facing = offset.dot(axis), direction.dot(axis), offset.dot(direction)
    discriminant = radius * radius * a - gap * gap
    t_side = (along * slope - facing - jnp.sqrt(jnp.maximum(discriminant, 0.0))) / a
    reach = along + t_side * slope
    # Beyond the side's end, the sphere at that end.
    end = jnp.clip(reach, -half, half)
    from_end = offset - axis * end
    moment = from_end.cross(direction)
    length2 = direction.dot(direction)
    discriminant_end = radius * radius * length2 - moment.dot(moment)
    t_end = (end * slope - facing - jnp.sqrt(jnp.maximum(discriminant_end, 0.0))) / length2
    on_side = jnp.abs(reach) <= half
    t = jnp.where(on_side, t_side, t_end)
    hit = (discriminant > 0) & (on_side | (discriminant_end > 0)) & (t > 0)
    return jnp.where(hit, t, MISS)


def cylinder(shape: Shape, origin: Vec, direction: Vec) -> Array:
    """Closed cylinder along the shape's z axis: ``size.x`` radius, ``size.y`` half length."""
    axis, radius, half = shape.z, shape.size.x, shape.size.y
    offset = origin - shape.center
    normal = direction.cross(axis)
    a = jnp.maximum(normal.dot(normal), _TINY)
    gap = offset.dot(normal)
    along, slope = offset.dot(axis), direction.dot(axis)
    discriminant = radius * radius * a - gap * gap
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0)) / a
    middle = (along * slope - offset.dot(direction)) / a
    inverse = 1.0 / away_from_zero(slope)
    cap_middle, cap_half = -along * inverse, jnp.abs(half * inverse)
    t = jnp.maximum(middle - root, cap_middle - cap_half)
    hit = (discriminant > 0) & (t < jnp.minimum(middle + root, cap_middle + cap_half)) & (t > 0)
    return jnp.where(hit, t, MISS)


def ellipsoid(shape: Shape, origin: Vec, direction: Vec) -> Array:
    """Ellipsoid with half axes ``size``: the unit sphere after each axis is divided by its size."""
    offset = origin - shape.center
    inverse = Vec(*(1.0 / jnp.maximum(size, _TINY) for size in (shape.size.x, shape.size.y, shape.size.z)))
    o = Vec(offset.dot(shape.x) * inverse.x, offset.dot(shape.y) * inverse.y, offset.dot(shape.z) * inverse.z)
    d = Vec(direction.dot(shape.x) * inverse.x, direction.dot(shape.y) * inverse.y, direction.dot(shape.z) * inverse.z)
    length2 = d.dot(d)
    moment = o.cross(d)
    discriminant = length2 - moment.dot(moment)
    t = (-o.dot(d) - jnp.sqrt(jnp.maximum(discriminant, 0.0))) / length2
    return jnp.where((discriminant > 0) & (t > 0), t, MISS)


def box(shape: Shape, origin: Vec, direction: Vec) -> Array:
    """Box with half sides ``size``: the ray enters when it is within the last of three slabs."""
    offset = origin - shape.center
    enter, leave = [], []
    for axis, half in ((shape.x, shape.size.x), (shape.y, shape.size.y), (shape.z, shape.size.z)):
        inverse = 1.0 / away_from_zero(direction.dot(axis))
        middle, reach = -offset.dot(axis) * inverse, jnp.abs(half * inverse)
        enter.append(middle - reach)
        leave.append(middle + reach)
    t = jnp.maximum(jnp.maximum(enter[0], enter[1]), enter[2])
    hit = (t < jnp.minimum(jnp.minimum(leave[0], leave[1]), leave[2])) & (t > 0)
    return jnp.where(hit, t, MISS)


def plane(shape: Shape, origin: Vec, direction: Vec) -> Array:
    """The front of a rectangle of half sides ``size.x``, ``size.y`` (infinite where not positive), normal z."""
    offset = origin - shape.center
    height = offset.dot(shape.z)
    t = -height / away_from_zero(direction.dot(shape.z))
    hit = (height > 0) & (t > 0)
    for axis, half in ((shape.x, shape.size.x), (shape.y, shape.size.y)):
        hit &= (half <= 0) | (jnp.abs(offset.dot(axis) + t * direction.dot(axis)) <= half)
    return jnp.where(hit, t, MISS)
