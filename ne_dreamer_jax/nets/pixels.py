"""Pixels rearranged and scaled, as the image networks take and give them."""

from __future__ import annotations

import jax.numpy as jnp

from ne_dreamer_jax.types import Array


def centred(images: Array) -> Array:
    """uint8 images as ``image / 255 - 0.5``, float32; images of a floating dtype as they are."""
    return images.astype(jnp.float32) / 255.0 - 0.5 if images.dtype == jnp.uint8 else images


def space_to_depth(x: Array, side: int) -> Array:
    """``[N, H, W, C]`` to ``[N, ceil(H / side), ceil(W / side), side * side * C]``: each square of pixels becomes one.

    Zeros fill the squares that reach over the last row or column.
    """
    N, H, W, C = x.shape
    h, w = -(-H // side), -(-W // side)
    x = jnp.pad(x, ((0, 0), (0, h * side - H), (0, w * side - W), (0, 0)))
    return x.reshape(N, h, side, w, side, C).transpose(0, 1, 3, 2, 4, 5).reshape(N, h, w, side * side * C)


def depth_to_space(x: Array, side: int) -> Array:
    """``[N, h, w, side * side * C]`` to ``[N, h * side, w * side, C]``: each vector becomes a square of pixels."""
    N, h, w, _ = x.shape
    return x.reshape(N, h, w, side, side, -1).transpose(0, 1, 3, 2, 4, 5).reshape(N, h * side, w * side, -1)
