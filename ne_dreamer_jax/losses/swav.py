"""Online clustering with prototypes: SwAV (Caron et al., 2020) as DreamerPro (Deng et al., 2022) uses it."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def sinkhorn(scores: jax.Array, epsilon: float = 0.05, iterations: int = 3) -> jax.Array:
    r"""Soft assignments of N samples to K prototypes that use all prototypes about equally.

    With :math:`Q = \exp(scores / \epsilon)`, every iteration scales each prototype's column to the sum N / K, then each
    sample's row to the sum 1 (Sinkhorn-Knopp), in the logarithmic domain. The rows end as distributions; the columns'
    sums approach N / K with the iterations.

    Args:
      scores: ``[N, K]``, cosine similarities.
      epsilon: the smaller, the harder the assignments.
      iterations: one or more.

    Returns:
      float32 ``[N, K]``. No gradient passes.
    """
    samples, prototypes = scores.shape
    log_q = jax.lax.stop_gradient(scores).astype(jnp.float32) / epsilon
    for _ in range(iterations):
        log_q = log_q - jax.nn.logsumexp(log_q, axis=0, keepdims=True) + jnp.log(jnp.float32(samples / prototypes))
        log_q = log_q - jax.nn.logsumexp(log_q, axis=1, keepdims=True)
    return jnp.exp(log_q)


def assignment_loss(scores: jax.Array, assignment: jax.Array, temperature: float = 0.1) -> jax.Array:
    r"""Cross-entropy ``[N]`` between assignments and predictions :math:`\mathrm{softmax}(scores / \tau)`, in nats.

    Args:
      scores: ``[N, K]``.
      assignment: ``[N, K]``, rows that sum to one, such as `sinkhorn` gives. Receives no gradient.
      temperature: :math:`\tau`.

    Raises:
      ValueError: where the shapes differ.
    """
    if scores.shape != assignment.shape:
        raise ValueError(f"expected scores and assignments of one shape, got {scores.shape} and {assignment.shape}")
    log_probs = jax.nn.log_softmax(scores.astype(jnp.float32) / temperature, axis=-1)
    return -jnp.sum(jax.lax.stop_gradient(assignment).astype(jnp.float32) * log_probs, axis=-1)
