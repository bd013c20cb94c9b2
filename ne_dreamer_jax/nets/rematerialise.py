"""What a scan's gradient keeps, and what it computes again."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")


def keeping_products(function: Callable[P, R]) -> Callable[P, R]:
    """The function, of which a scan's gradient keeps the results of matrix products and computes the rest again.

    Each array that is kept is written in every step and read back: on a CPU that is more work than what lies between
    two products, and on an accelerator each is a kernel of its own. (Outside a scan the compiler may keep more.)
    """
    return jax.checkpoint(function, policy=jax.checkpoint_policies.dots_saveable, prevent_cse=False)
