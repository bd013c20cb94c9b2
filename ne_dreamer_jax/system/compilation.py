"""How programs are compiled."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax

F = TypeVar("F", bound=Callable[..., Any])

_LITTLE_OPTIMISED = {"xla_backend_optimization_level": 1}


def jit_to_run_once(function: F) -> F:
    """``jax.jit`` for what runs once: a fifth of the compilation, for machine code that is optimised less.

    What is computed stays the same. Within another program, whose own options count, it is a plain ``jax.jit``.
    """
    alone, within = jax.jit(function, compiler_options=_LITTLE_OPTIMISED), jax.jit(function)

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        traced = any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(args))
        return (within if traced else alone)(*args)

    return call  # type: ignore[return-value]
