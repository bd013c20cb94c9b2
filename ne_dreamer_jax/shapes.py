"""Whether arrays are what is expected of them."""

from __future__ import annotations

from typing import Any

import jax


def check(expected: Any, got: Any, what: str) -> None:
    """Compares two pytrees of arrays (or of ``jax.ShapeDtypeStruct``) by their leaves' names, shapes and dtypes.

    Raises:
      ValueError: "does not fit ``what``", naming every leaf that differs.
    """
    want, have = _describe(expected), _describe(got)
    wrong = [
        f"{name}: expected {want.get(name, 'nothing')}, got {have.get(name, 'nothing')}"
        for name in sorted(want.keys() | have.keys())
        if want.get(name) != have.get(name)
    ]
    if wrong:
        raise ValueError(f"does not fit {what}: " + "; ".join(wrong))


def _describe(tree: Any) -> dict[str, str]:
    leaves = jax.tree.leaves_with_path(tree)
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): f"{jax.numpy.dtype(x.dtype)}{list(x.shape)}"
        for path, x in leaves
    }
