"""Frozen dataclasses as text (`text`), the ranges of their numbers (`ranges`), and names (`names`). Loads no JAX."""

from ne_dreamer_jax.settings.text import (
    BEFORE,
    as_text,
    did_you_mean,
    differences,
    from_dict,
    nearest,
    override,
    paths,
    to_dict,
)

__all__ = ["BEFORE", "as_text", "did_you_mean", "differences", "from_dict", "nearest", "override", "paths", "to_dict"]
