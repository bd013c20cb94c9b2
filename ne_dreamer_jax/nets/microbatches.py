"""Whole batches through a network a part at a time, where their activations do not fit all at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax

Result = TypeVar("Result")


def in_microbatches(
    function: Callable[..., Result], count: int, in_axes: int | tuple[Any, ...] = 0, out_axes: Any = 0
) -> Callable[..., Result]:
    """The function, applied to ``count`` equal parts of its arguments one after the other.

    Results and gradients are those of the whole batch, if the function treats its rows apart. What it keeps for the
    gradient is kept for one part at a time and computed again when its turn comes, which costs another forward pass
    (gradient accumulation, with the loss still taken over the whole).

    A part takes every ``count``-th row, so that rows that are divided among devices stay where they are, if each device
    has a multiple of ``count``.

    Args:
      function: of arrays with a batch axis, to arrays with one.
      count: divides the size of the batch axis; with 1 the function itself is returned.
      in_axes: where the batch axis is: of all arguments, or one for each, as for ``jax.vmap``.
      out_axes: the same of the results.
    """
    if count == 1:
        return function

    def split(axis: int, x: jax.Array) -> jax.Array:
        rows = x.shape[axis]
        if rows % count:
            raise ValueError(f"expected rows that {count} microbatches divide, got {rows}")
        x = x.reshape(*x.shape[:axis], rows // count, count, *x.shape[axis + 1 :])
        return jax.numpy.moveaxis(x, axis + 1, 0)

    def join(axis: int, x: jax.Array) -> jax.Array:
        x = jax.numpy.moveaxis(x, 0, axis + 1)
        return x.reshape(*x.shape[:axis], -1, *x.shape[axis + 2 :])

    def each(of_leaf: Callable[[int, jax.Array], jax.Array], axes: Any, tree: Any) -> Any:
        return jax.tree.map(of_leaf, jax.tree.broadcast(axes, tree), tree)

    def call(*args: Any) -> Result:
        parts = each(split, in_axes, args)
        again = jax.checkpoint(lambda part: function(*part), prevent_cse=False)
        return each(join, out_axes, jax.lax.map(again, parts))

    return call
