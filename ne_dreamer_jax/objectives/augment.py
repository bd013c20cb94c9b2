"""Random views of image sequences."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ne_dreamer_jax.types import Array


def shift_images(images: Array, shift: Array) -> Array:
    """Translates every sequence of images by its own number of pixels, bilinearly, edges continued outwards.

    Args:
      images: float32 ``[B, T, H, W, C]``.
      shift: float32 ``[B, 2]``, rows and columns: the result at (i, j) is the image at (i + shift[0], j + shift[1]).
        The same for all T steps.
    """

    def weights(offset: Array, side: int) -> Array:
        """``[B, side, side]``: how much each input contributes to each output."""
        position = jnp.clip(jnp.arange(side, dtype=jnp.float32)[None] + offset[:, None], 0.0, side - 1.0)
        distance = jnp.abs(position[:, :, None] - jnp.arange(side, dtype=jnp.float32)[None, None])
        return jnp.maximum(1.0 - distance, 0.0)

    height, width = images.shape[2:4]
    exact = jax.lax.Precision.HIGHEST
    rows = jnp.einsum("bij,btjwc->btiwc", weights(shift[:, 0], height), images, precision=exact)
    return jnp.einsum("bij,bthjc->bthic", weights(shift[:, 1], width), rows, precision=exact)


def random_shift(key: Array, images: Array, largest: float, whole: bool = False) -> Array:
    """`shift_images` by up to ``largest`` pixels, uniform in each direction; the key is consumed.

    With ``whole`` every whole number of pixels from -largest to largest, largest rounded down, is as likely.
    """
    shape = (images.shape[0], 2)
    if whole:
        shift = jax.random.randint(key, shape, -int(largest), int(largest) + 1).astype(jnp.float32)
    else:
        shift = jax.random.uniform(key, shape, minval=-largest, maxval=largest)
    return shift_images(images, shift)
