"""Ways other than Barlow Twins to align predictions with targets: BYOL's cosine and VICReg, over masked sets."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def cosine_alignment(
    prediction: jax.Array, target: jax.Array, mask: jax.Array | None = None
) -> tuple[jax.Array, dict[str, jax.Array]]:
    r"""BYOL's loss (Grill et al., 2020, eq. 2): :math:`2 - 2 \cos(p, q)`, averaged over the pairs of the set.

    Args:
      prediction: ``[..., E]``.
      target: ``[..., E]``. Gradients flow into it too; stop them outside where it is a target.
      mask: bool ``[...]``, which pairs form the set; None for all. The others change neither the loss nor a gradient.

    Returns:
      The loss, float32 ``[]`` in [0, 4], and metrics without gradient: ``cosine`` (its mean) and ``pairs``. An empty
      set gives 0.

    Raises:
      ValueError: where the shapes do not agree.
    """
    p, q, included, pairs = _set(prediction, target, mask)
    unit = lambda x: x * jax.lax.rsqrt(jnp.sum(jnp.square(x), axis=-1, keepdims=True) + 1e-12)
    cosine = jnp.sum(jnp.where(included[:, 0], jnp.sum(unit(p) * unit(q), axis=-1), 0.0)) / jnp.maximum(pairs, 1.0)
    loss = jnp.where(pairs > 0.0, 2.0 - 2.0 * cosine, 0.0)
    return loss, jax.lax.stop_gradient({"cosine": cosine, "pairs": pairs})


def vicreg(
    prediction: jax.Array,
    target: jax.Array,
    mask: jax.Array | None = None,
    invariance: float = 25.0,
    variance: float = 25.0,
    covariance: float = 1.0,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    r"""VICReg (Bardes et al., 2022, eqs. 1 to 6) with the regularisers on the predictions alone.

    .. math::
        L = \frac{i}{E} \, \overline{\|p - q\|^2} + \frac{v}{E} \sum_j \max(0, 1 - \sqrt{S_{jj} + 10^{-4}})
            + \frac{c}{E} \sum_{j \ne k} S_{jk}^2

    with S the predictions' covariance over the set. The targets' own would have no gradient here.

    Args:
      prediction: ``[..., E]``.
      target: ``[..., E]``. Gradients flow into it too; stop them outside where it is a target.
      mask: bool ``[...]``, which pairs form the set; None for all. The others change neither the loss nor a gradient.
      invariance: i.
      variance: v.
      covariance: c.

    Returns:
      The loss, float32 ``[]``, and metrics without gradient: ``invariance``, ``variance`` and ``covariance`` (the three
      terms before their weights) and ``pairs``. A set of less than two pairs gives 0.

    Raises:
      ValueError: where the shapes do not agree.
    """
    p, q, included, pairs = _set(prediction, target, mask)
    size = p.shape[-1]
    error = jnp.sum(jnp.square(p - q)) / (jnp.maximum(pairs, 1.0) * size)
    centred = jnp.where(included, p - jnp.sum(p, axis=0, keepdims=True) / jnp.maximum(pairs, 1.0), 0.0)
    scatter = jnp.matmul(centred.T, centred, precision=jax.lax.Precision.HIGHEST) / jnp.maximum(pairs - 1.0, 1.0)
    own = jnp.diagonal(scatter)
    hinge = jnp.mean(jnp.maximum(1.0 - jnp.sqrt(own + 1e-4), 0.0))
    between = (jnp.sum(jnp.square(scatter)) - jnp.sum(jnp.square(own))) / size
    terms = {"invariance": error, "variance": hinge, "covariance": between}
    loss = invariance * error + variance * hinge + covariance * between
    return jnp.where(pairs > 1.0, loss, 0.0), jax.lax.stop_gradient({**terms, "pairs": pairs})


def _set(
    prediction: jax.Array, target: jax.Array, mask: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """float32 ``[N, E]`` twice with zeros outside the set, what is inside ``[N, 1]``, and how many."""
    if prediction.shape != target.shape:
        raise ValueError(f"expected a prediction and a target of one shape, got {prediction.shape} and {target.shape}")
    if mask is None:
        mask = jnp.ones(prediction.shape[:-1], bool)
    if mask.shape != prediction.shape[:-1]:
        raise ValueError(f"expected a mask of shape {prediction.shape[:-1]}, got {mask.shape}")
    included = mask.astype(bool).reshape(-1, 1)
    flat = lambda x: jnp.where(included, x.reshape(-1, x.shape[-1]).astype(jnp.float32), 0.0)
    return flat(prediction), flat(target), included, jnp.sum(included, dtype=jnp.float32)
