"""A string between two sites: a hanging catenary while it is slack, a straight line when it is taut."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.render.rays import Array, Shape, Vec
from ne_dreamer_jax.render.scene import String

_NEWTON_STEPS = 6


def segments(string: String, site_xpos: Any) -> Shape:
    """The string as capsules, from its first site to its second; arrays over the segments."""
    first, second = (jnp.asarray(site_xpos, jnp.float32)[site] for site in string.sites)
    points = _points(string, first, second)
    start, end = Vec.of(points[:-1]), Vec.of(points[1:])
    along = end - start
    length = jnp.sqrt(along.dot(along))
    axis = along * (1 / jnp.maximum(length, 1e-9))
    radius = jnp.full_like(length, string.radius)
    return Shape((start + end) * 0.5, axis, axis, axis, Vec(radius, length * 0.5, radius))


def color(string: String, site_xpos: Any) -> Array:
    """float32 [3]. The colour fades to that of an active constraint as the string becomes taut.

    The weight is the impedance of the length limit: MuJoCo's solimp curve of the distance past the limit's margin.
    """
    first, second = (jnp.asarray(site_xpos, jnp.float32)[site] for site in string.sites)
    slack = string.length - jnp.linalg.norm(second - first)
    least, most, width, midpoint, exponent = string.impedance
    x = jnp.clip(jnp.abs(slack - string.margin) / width, 0.0, 1.0)
    rising = x**exponent / midpoint ** (exponent - 1)
    falling = 1 - (1 - x) ** exponent / (1 - midpoint) ** (exponent - 1)
    weight = least + (most - least) * (jnp.where(x <= midpoint, rising, falling) if exponent > 1 else x)
    weight = jnp.where(slack < string.margin, weight, 0.0)
    return jnp.asarray(string.rgb) * (1 - weight) + jnp.asarray(string.taut_rgb) * weight


def _points(string: String, first: Array, second: Array) -> Array:
    """Points [segments + 1, 3] along the string, evenly spaced horizontally.

    A catenary of length L over a horizontal span h and a rise v is z(u) = a cosh((u - u0) / a) + const, where
    sinh(x) / x = sqrt(L^2 - v^2) / h with x = h / 2a, and u0 = h / 2 - a atanh(v / L).
    """
    up = np.asarray(string.up, np.float32)
    gap = second - first
    rise = gap @ up
    across = gap - rise * up
    span = jnp.sqrt(across @ across + 1e-12)
    distance = jnp.sqrt(gap @ gap + 1e-12)
    where = jnp.linspace(0.0, 1.0, string.segments + 1)
    straight = first[None] + gap[None] * where[:, None]

    length = jnp.maximum(string.length, distance * 1.0001)
    width = jnp.maximum(span, string.length / 100)  # a string that hangs straight down is drawn as a narrow loop
    ratio = jnp.sqrt(length**2 - rise**2) / width
    x = jnp.where(ratio < 3, jnp.sqrt(6 * jnp.maximum(ratio - 1, 1e-6)), jnp.log(2 * ratio * jnp.log(2 * ratio)))
    for _ in range(_NEWTON_STEPS):  # on log(sinh(x) / x), which is nearly linear where x is large
        error = jnp.log(jnp.sinh(x) / x) - jnp.log(ratio)
        x = jnp.maximum(x - error / (1 / jnp.tanh(x) - 1 / x), 1e-3)
    a = width / (2 * x)
    u = where * width
    lowest = width / 2 - a * jnp.arctanh(rise / length)
    height = 2 * a * jnp.sinh(u / (2 * a)) * jnp.sinh((u / 2 - lowest) / a)
    hanging = first[None] + across[None] * where[:, None] + height[:, None] * up[None]
    return jnp.where(distance >= string.length, straight, hanging)
