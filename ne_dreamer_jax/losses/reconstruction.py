"""Reconstruction of observations (DreamerV3): squared errors, summed over an observation."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from .twohot import symlog


def image_loss(predicted: jax.Array, image: jax.Array) -> jax.Array:
    """Squared error ``[...]`` of an image, summed over pixels and channels.

    Args:
      predicted: ``[..., H, W, C]``, in the unit interval.
      image: uint8 ``[..., H, W, C]``, compared as image / 255.

    Raises:
      ValueError: where the shapes do not agree, or the image is not uint8.
    """
    if predicted.shape != image.shape or image.dtype != jnp.uint8:
        raise ValueError(
            f"expected a prediction and a uint8 image of one shape, got {predicted.shape} and {image.dtype} "
            f"{image.shape}"
        )
    error = predicted.astype(jnp.float32) - image.astype(jnp.float32) / 255.0
    return jnp.sum(jnp.square(error), axis=(-3, -2, -1))


def vector_loss(predicted: jax.Array, vector: jax.Array) -> jax.Array:
    """Squared error ``[...]`` of a vector on the symlog scale, summed over its components.

    Args:
      predicted: ``[..., n]``, a prediction of symlog(vector).
      vector: ``[..., n]``.

    Raises:
      ValueError: where the shapes do not agree.
    """
    if predicted.shape != vector.shape:
        raise ValueError(f"expected a prediction and a vector of one shape, got {predicted.shape} and {vector.shape}")
    return jnp.sum(jnp.square(predicted.astype(jnp.float32) - symlog(vector.astype(jnp.float32))), axis=-1)
