"""How programs are compiled."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp

P = ParamSpec("P")
R = TypeVar("R")

LITTLE_OPTIMISED: dict[str, Any] = {"xla_backend_optimization_level": 1}


def jit_to_run_once(function: Callable[P, R]) -> Callable[P, R]:
    """``jax.jit`` for a function that runs once: it compiles sooner, to less optimised machine code.

    Called while another function is traced or under ``jax.vmap``, it is a plain ``jax.jit``, as compiler options count
    for whole programs. The result is the same up to rounding.
    """
    alone, within = jax.jit(function, compiler_options=LITTLE_OPTIMISED), jax.jit(function)

    @functools.wraps(function)
    def call(*args: P.args, **options: P.kwargs) -> R:
        return (within if _is_traced((args, options)) else alone)(*args, **options)

    return call


def computed_now(function: Callable[[], R]) -> R:
    """What a function of constants returns, by one program that runs at once, also while another function is traced."""
    return jax.jit(function).lower().compile(LITTLE_OPTIMISED)()


def _is_traced(arguments: Any) -> bool:
    """Whether a function called with these arguments becomes part of another program.

    New arrays are tracers while a function is traced, whatever its arguments are; under ``vmap`` only arguments are.
    """
    return any(isinstance(x, jax.core.Tracer) for x in (jnp.zeros(()), *jax.tree.leaves(arguments)))
