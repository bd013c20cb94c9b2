"""KL terms between categorical latents, with DreamerV3's stabilisers (Hafner et al., 2023)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ._shapes import expect_same


def unimix_logits(logits: jax.Array, mix: float = 0.01) -> jax.Array:
    """Normalised log-probabilities of ``(1 - mix) * softmax(logits) + mix / K``.

    Keeps every probability at or above ``mix / K`` and so every KL finite.

    Args:
      logits: ``[..., K]``.
      mix: share of the uniform distribution, in [0, 1]; 0 leaves the distribution as it is.

    Returns:
      float32 ``[..., K]``.

    Raises:
      ValueError: where ``mix`` is no share.

    Source: DreamerV3, "unimix".
    """
    if not 0.0 <= mix <= 1.0:
        raise ValueError(f"expected a mix from 0 to 1, got {mix}")
    logits = logits.astype(jnp.float32)
    if mix == 0.0:
        return jax.nn.log_softmax(logits)
    return jnp.log((1.0 - mix) * jax.nn.softmax(logits) + mix / logits.shape[-1])


def categorical_kl(p_logits: jax.Array, q_logits: jax.Array) -> jax.Array:
    """KL(p || q) = sum_k p_k (log p_k - log q_k) of categorical distributions.

    Args:
      p_logits: ``[..., K]``, normalised or not; ``-inf`` masks a class, which then adds nothing.
      q_logits: ``[..., K]``, likewise; a class that it alone masks makes the divergence infinite.

    Returns:
      float32 ``[...]``, in nats.

    Raises:
      ValueError: where the shapes do not agree.
    """
    expect_same(p_logits=p_logits, q_logits=q_logits)
    log_p = jax.nn.log_softmax(p_logits.astype(jnp.float32))
    log_q = jax.nn.log_softmax(q_logits.astype(jnp.float32))
    possible, excluded = log_p != -jnp.inf, log_q == -jnp.inf
    counts = possible & ~excluded  # 0 log 0 = 0, and so its gradients; NaN stays NaN
    ratio = jnp.where(counts, log_p, 0.0) - jnp.where(counts, log_q, 0.0)
    finite = jnp.sum(jnp.where(counts, jnp.exp(log_p) * ratio, 0.0), axis=-1)
    return jnp.where(jnp.any(possible & excluded, axis=-1), finite + jnp.inf, finite)


def balanced_kl(
    posterior_logits: jax.Array,
    prior_logits: jax.Array,
    free_nats: float = 1.0,
    unimix: float = 0.01,
) -> tuple[jax.Array, jax.Array]:
    r"""The two directions of DreamerV3's KL balancing, :math:`L_{dyn}` and :math:`L_{rep}`.

    .. math::
        L_{dyn} = \max\big(f, \sum_s KL(\mathrm{sg}(q_s) \| p_s)\big), \qquad
        L_{rep} = \max\big(f, \sum_s KL(q_s \| \mathrm{sg}(p_s))\big)

    with q the posterior and p the prior over latent s, both mixed with the uniform distribution, and f the free nats.
    The maximum is taken once, after the sum over the S latents; below f there is no gradient. DreamerV3 scales them by
    1.0 (dynamics: trains the prior) and 0.1 (representation: trains the posterior).

    Args:
      posterior_logits: ``[..., S, K]``.
      prior_logits: ``[..., S, K]``.
      free_nats: f.
      unimix: see `unimix_logits`; applied to both sides.

    Returns:
      ``(dynamics, representation)``, each float32 ``[...]``, in nats; the mean is the caller's. Their values are
      equal, their gradients are not.

    Raises:
      ValueError: where the shapes do not agree.
    """
    expect_same(posterior_logits=posterior_logits, prior_logits=prior_logits)
    posterior = unimix_logits(posterior_logits, unimix)
    prior = unimix_logits(prior_logits, unimix)
    dynamics = jnp.sum(categorical_kl(jax.lax.stop_gradient(posterior), prior), axis=-1)
    representation = jnp.sum(categorical_kl(posterior, jax.lax.stop_gradient(prior)), axis=-1)
    return jnp.maximum(dynamics, free_nats), jnp.maximum(representation, free_nats)
