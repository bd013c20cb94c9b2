"""32 bits, whatever JAX is told by its user's environment."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax

F = TypeVar("F", bound=Callable[..., Any])


def in_32_bits(function: F) -> F:
    """The function, with 32-bit defaults wherever it is run or traced.

    With ``JAX_ENABLE_X64=1``, which other projects need, arrays, random numbers and sums without a dtype of their own
    are of 64 bits, in the libraries beneath as in here, and then fit neither replay nor the carry of a loop. What goes
    inside of ``jax.jit`` is wrapped (``jax.jit(in_32_bits(f))``), so that the result can still be lowered.
    """

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        with jax.enable_x64(False):
            return function(*args, **options)

    return call  # type: ignore[return-value]
