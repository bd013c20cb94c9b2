"""How programs are compiled."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")

_LITTLE_OPTIMISED = {"xla_backend_optimization_level": 1}


def jit_to_run_once(function: Callable[P, R]) -> Callable[P, R]:
    """``jax.jit`` for what runs once: compiled sooner, to machine code that is optimised less.

    The result is the same but for rounding. Within another program, whose own options count, it is a plain ``jax.jit``.
    """
    alone, within = jax.jit(function, compiler_options=_LITTLE_OPTIMISED), jax.jit(function)

    @functools.wraps(function)
    def call(*args: P.args, **options: P.kwargs) -> R:
        traced = any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((args, options)))
        return (within if traced else alone)(*args, **options)

    return call
