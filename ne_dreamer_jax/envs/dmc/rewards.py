"""Soft indicator functions, as the Control Suite's rewards use them."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax.numpy as jnp

from ne_dreamer_jax.types import Array

_SIGMOIDS: dict[str, Callable[[Array, float], Array]] = {
    "gaussian": lambda d, v: jnp.exp(-0.5 * (d * math.sqrt(-2 * math.log(v))) ** 2),
    "linear": lambda d, v: jnp.maximum(1 - d * (1 - v), 0.0),
    "quadratic": lambda d, v: jnp.maximum(1 - (d * math.sqrt(1 - v)) ** 2, 0.0),
}


def tolerance(
    x: Array,
    bounds: tuple[float, float] = (0.0, 0.0),
    margin: float = 0.0,
    sigmoid: str = "gaussian",
    value_at_margin: float = 0.1,
) -> Array:
    """1 where ``x`` lies within ``bounds``, falling to ``value_at_margin`` at a distance ``margin`` outside of them.

    Equal to ``dm_control.utils.rewards.tolerance`` for the three shapes that the tasks here use.

    Args:
      x: float32, any shape.
      bounds: lower and upper end of the interval, ends included; either may be infinite.
      margin: distance, in units of ``x``, at which the value is ``value_at_margin``; 0 makes a hard indicator.
      sigmoid: how the value falls with distance: ``"gaussian"``, ``"linear"`` or ``"quadratic"``.
      value_at_margin: in (0, 1) for ``"gaussian"``, in [0, 1) for the others.

    Returns:
      float32 in [0, 1], of ``x``'s shape.

    Raises:
      ValueError: bounds out of order, a negative margin, an unknown sigmoid or a value_at_margin out of range.
    """
    lower, upper = bounds
    if lower > upper:
        raise ValueError(f"expected bounds (lower, upper) in that order, got {bounds}")
    if margin < 0:
        raise ValueError(f"expected a margin >= 0, got {margin}")
    if sigmoid not in _SIGMOIDS:
        raise ValueError(f"expected a sigmoid out of {sorted(_SIGMOIDS)}, got {sigmoid!r}")
    if not (0 < value_at_margin < 1 or (value_at_margin == 0 and sigmoid != "gaussian")):
        raise ValueError(
            f"expected value_at_margin below 1 and above 0 (0 allowed unless gaussian), got {value_at_margin}"
        )
    inside = (lower <= x) & (x <= upper)
    if margin == 0:
        return inside.astype(jnp.float32)
    distance = jnp.where(x < lower, lower - x, x - upper) / margin
    return jnp.where(inside, 1.0, _SIGMOIDS[sigmoid](distance, value_at_margin))
