"""How much arithmetic a program's matrix products are, counted from what it traces to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import jax


def product_flops(function: Callable[..., Any], *args: Any) -> int:
    """Floating-point operations of the matrix products and convolutions of ``function(*args)``.

    A multiplication and an addition count as two. A scan's body counts once for each of its steps; of a conditional the
    branch with the most counts; a loop that ends by its values counts as one turn, so that it gives a lower bound.

    Args:
      function: traced, not run; ``args`` may be shapes.
    """
    return _flops(jax.make_jaxpr(function)(*args).jaxpr)


def _flops(jaxpr: Any) -> int:
    return sum(_of_equation(equation) for equation in jaxpr.eqns)


def _of_equation(equation: Any) -> int:
    name, params = equation.primitive.name, equation.params
    if name == "dot_general":
        (contracted, _), _ = params["dimension_numbers"]
        left = equation.invars[0].aval.shape
        return 2 * math.prod(equation.outvars[0].aval.shape) * math.prod(left[axis] for axis in contracted)
    if name == "conv_general_dilated":
        kernel = equation.invars[1].aval.shape
        outputs = kernel[params["dimension_numbers"].rhs_spec[0]]
        return 2 * math.prod(equation.outvars[0].aval.shape) * math.prod(kernel) // outputs
    counts = [_flops(inner) for inner in _inner(params)]
    if name == "cond":
        return max(counts)
    return params.get("length", 1) * sum(counts) if name == "scan" else sum(counts)


def _inner(params: dict[str, Any]) -> Iterator[Any]:
    """The programs in an equation's parameters."""
    for value in params.values():
        for candidate in value if isinstance(value, (tuple, list)) else (value,):
            candidate = getattr(candidate, "jaxpr", candidate)
            if hasattr(candidate, "eqns"):
                yield candidate
