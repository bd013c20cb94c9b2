"""Symexp two-hot regression of scalars (DreamerV3, Hafner et al., 2023): a categorical over fixed bins."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def symlog(x: jax.Array) -> jax.Array:
    """sign(x) log(1 + |x|), the inverse of `symexp`; float32, of the shape of ``x``. Its derivative at 0 is 1."""
    x = jnp.asarray(x, jnp.float32)
    magnitude = jnp.log1p(jnp.where(x < 0.0, -x, x))
    return jnp.where(x < 0.0, -magnitude, magnitude)


def symexp(x: jax.Array) -> jax.Array:
    """sign(x) (exp(|x|) - 1), the inverse of `symlog`; float32, of the shape of ``x``. Its derivative at 0 is 1."""
    x = jnp.asarray(x, jnp.float32)
    magnitude = jnp.expm1(jnp.where(x < 0.0, -x, x))
    return jnp.where(x < 0.0, -magnitude, magnitude)


def symexp_bins(count: int = 255, limit: float = 20.0) -> jax.Array:
    """Bins ``symexp(linspace(-limit, limit, count))``, increasing and antisymmetric to the last bit.

    Returns:
      float32 ``[count]``.

    Raises:
      ValueError: where there are fewer than two bins or ``limit`` is not positive.
    """
    if count < 2 or limit <= 0.0:
        raise ValueError(f"expected at least two bins and a positive limit, got count = {count}, limit = {limit}")
    grid = jnp.linspace(-limit, limit, count, dtype=jnp.float32)
    return symexp((grid - grid[::-1]) / 2.0)  # linspace alone is antisymmetric only up to rounding


def twohot_encode(x: jax.Array, bins: jax.Array) -> jax.Array:
    """The distribution over bins that has mean x and touches only the two neighbours of x.

    For bins[k] <= x <= bins[k + 1] the weight on k + 1 is ``(x - bins[k]) / (bins[k + 1] - bins[k])``, the rest is on
    k. Beyond the outer bins x counts as the outer bin.

    Args:
      x: ``[...]``.
      bins: increasing, ``[K]``.

    Returns:
      float32 ``[..., K]``, summing to one.

    Source: DreamerV3, eq. for twohot(x).
    """
    x, bins = x.astype(jnp.float32), bins.astype(jnp.float32)
    # Every bin's weight is a hat function of x: one at the bin, falling to zero at its neighbours. That is one
    # elementwise pass, which fuses into whatever consumes the weights; a search for the neighbours would not.
    x = jnp.clip(x, bins[0], bins[-1])[..., None]
    before, after = 2 * bins[:1] - bins[1:2], 2 * bins[-1:] - bins[-2:-1]  # where neighbours of the outer bins would be
    hat = (jnp.concatenate([before, bins[:-1]]), bins, jnp.concatenate([bins[1:], after]))
    below, at, above = (jnp.expand_dims(b, range(x.ndim - 1)) for b in hat)
    return jnp.clip(jnp.minimum((x - below) / (at - below), (above - x) / (above - at)), 0.0, 1.0)


def twohot_mean(logits: jax.Array, bins: jax.Array) -> jax.Array:
    """Expectation of the bins under ``softmax(logits)``.

    Bin k and its mirror image K - 1 - k are added up together, as
    ``((p_k - p_-k) (b_k - b_-k) + (p_k + p_-k) (b_k + b_-k)) / 4``: with antisymmetric bins, equal probabilities on
    both sides (zero logits, as a head with a zero-initialised last layer gives) have a mean of exactly zero, however
    the compiler contracts and orders the sum.

    Args:
      logits: ``[..., K]``.
      bins: ``[K]``.

    Returns:
      float32 ``[...]``.
    """
    probs = jax.nn.softmax(logits.astype(jnp.float32))
    bins = bins.astype(jnp.float32)
    mirrored = probs[..., ::-1]
    odd = jnp.broadcast_to(bins - bins[::-1], probs.shape)
    even = jnp.broadcast_to(bins + bins[::-1], probs.shape)
    return jnp.sum((probs - mirrored) * odd + (probs + mirrored) * even, axis=-1) / 4.0


def twohot_loss(logits: jax.Array, target: jax.Array, bins: jax.Array) -> jax.Array:
    """Cross-entropy ``-sum_k twohot(target)_k log softmax(logits)_k``.

    Args:
      logits: ``[..., K]``.
      target: ``[...]``, in the bins' units; receives no gradient.
      bins: increasing, ``[K]``.

    Returns:
      float32 ``[...]``; the mean is the caller's.

    Raises:
      ValueError: where the shapes do not agree.
    """
    if logits.shape != (*target.shape, *bins.shape):
        raise ValueError(
            f"expected logits of shape {(*target.shape, *bins.shape)}, for a target {target.shape} and bins "
            f"{bins.shape}, got {logits.shape}"
        )
    weights = twohot_encode(jax.lax.stop_gradient(target), bins)
    logits = logits.astype(jnp.float32)
    # The weights sum to one, so the normaliser comes out of the sum, and no array of log-probabilities is needed.
    return jax.nn.logsumexp(logits, axis=-1) - jnp.sum(weights * logits, axis=-1)
