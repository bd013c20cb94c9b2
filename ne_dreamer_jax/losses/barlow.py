"""Barlow Twins (Zbontar et al., 2021) over masked sets, and the next-embedding loss of NE-Dreamer built on it."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp


def barlow_twins(
    prediction: jax.Array,
    target: jax.Array,
    mask: jax.Array | None = None,
    redundancy: float = 5e-4,
    eps: float = 1e-8,
    sample_deviation: bool = False,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    r"""Redundancy-reduction loss between two sets of paired vectors.

    With :math:`\tilde p, \tilde q` the two inputs standardised per dimension over the N pairs of the set (zero mean,
    unit population variance),

    .. math::
        C_{ij} = \frac1N \sum_n \tilde p_{n,i} \, \tilde q_{n,j}, \qquad
        L = \sum_i (1 - C_{ii})^2 + \lambda \sum_{i \ne j} C_{ij}^2 .

    The loss is not divided by E: two unrelated sets give about E.

    Args:
      prediction: ``[..., E]``.
      target: ``[..., E]``. Gradients flow into it too; stop them outside where it is a target.
      mask: bool ``[...]``, which pairs form the set; None for all. The others change neither the loss nor any gradient,
        whatever they hold.
      redundancy: :math:`\lambda`.
      eps: added to each variance, so that a constant dimension correlates with nothing instead of giving NaN.
      sample_deviation: standardise by the sample's standard deviation (N - 1), to which ``eps`` is added, as the
        authors' released code does: with perfect predictions :math:`C_{ii}` is then 1 - 1/N. It protects less: of a
        dimension that is constant but for rounding it makes correlations, and very large gradients.

    Returns:
      The loss, float32 ``[]``, and metrics without gradient: ``diagonal`` (mean of :math:`C_{ii}`), ``off_diagonal``
      (root mean square of :math:`C_{ij}, i \ne j`) and ``pairs`` (N). An empty set gives 0 everywhere.

    Raises:
      ValueError: where the shapes do not agree.

    Source: NE-Dreamer, "Alignment loss (Barlow Twins)".
    """
    if prediction.shape != target.shape:
        raise ValueError(f"expected a prediction and a target of one shape, got {prediction.shape} and {target.shape}")
    size = prediction.shape[-1]
    if mask is None:
        mask = jnp.ones(prediction.shape[:-1], bool)
    if mask.shape != prediction.shape[:-1]:
        raise ValueError(f"expected a mask of shape {prediction.shape[:-1]}, got {mask.shape}")
    included = mask.astype(bool).reshape(-1, 1)
    pairs = jnp.sum(included, dtype=jnp.float32)
    count = jnp.maximum(pairs, 1.0)

    def standardise(x: jax.Array) -> jax.Array:
        x = jnp.where(included, x.reshape(-1, size).astype(jnp.float32), 0.0)
        mean = jnp.sum(x, axis=0, keepdims=True) / count
        centred = jnp.where(included, x - mean, 0.0)
        squares = jnp.sum(jnp.square(centred), axis=0, keepdims=True)
        if not sample_deviation:
            return centred * jax.lax.rsqrt(squares / count + eps)
        variance = squares / jnp.maximum(count - 1.0, 1.0)
        varies = variance > 0.0  # the root's gradient at zero is infinite
        return centred / (jnp.where(varies, jnp.sqrt(jnp.where(varies, variance, 1.0)), 0.0) + eps)

    # TensorFloat-32 would leave three digits of a correlation, hence the precision. Dividing a factor by N instead of
    # the product spares a second E x E array.
    scaled = standardise(prediction) / count
    correlation = jnp.matmul(scaled.T, standardise(target), precision=jax.lax.Precision.HIGHEST)
    diagonal = jnp.diagonal(correlation)
    off_diagonal = jnp.sum(jnp.square(correlation)) - jnp.sum(jnp.square(diagonal))
    loss = jnp.sum(jnp.square(1.0 - diagonal)) + redundancy * off_diagonal
    metrics = {
        "diagonal": jnp.mean(diagonal),
        "off_diagonal": jnp.sqrt(jnp.maximum(off_diagonal, 0.0) / max(size * (size - 1), 1)),
        "pairs": pairs,
    }
    return jnp.where(pairs > 0.0, loss, 0.0), jax.lax.stop_gradient(metrics)


def next_embedding_loss(
    predicted: jax.Array,
    embedding: jax.Array,
    is_first: jax.Array,
    redundancy: float = 5e-4,
    shift: int = 1,
    masked: bool = True,
    align: Callable[..., tuple[jax.Array, dict[str, jax.Array]]] | None = None,
    sample_deviation: bool = False,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    r"""Next-embedding predictive alignment, :math:`L_{NE}`: `barlow_twins` between predictions and later embeddings.

    ``predicted[:, t]`` stands for :math:`\hat e_{t+k}`, computed from what is known up to t, and is aligned to the
    target :math:`\mathrm{sg}(e_{t+k})` = ``stop_gradient(embedding[:, t + k])`` with k = ``shift``.

    Which pairs count: the paper's :math:`c_t` is 1 "if the episode continues from t to t+1". In terms of ``is_first``,
    :math:`c_t = 1` exactly where ``is_first[:, t + 1]`` is false: t and t+1 lie in the same episode. The step into the
    last observation of an episode counts (that observation follows from the action), the one from it into the next
    episode does not (nothing before it predicts a reset), whether the episode ended in a terminal state or was cut. For
    k steps, the pair (t, t+k) counts where none of t+1, ..., t+k is first.

    Args:
      predicted: ``[B, T, E]``; the last ``shift`` steps have no target and are not used.
      embedding: ``[B, T, E]``; receives no gradient.
      is_first: bool ``[B, T]``.
      redundancy: :math:`\lambda_{BT}`.
      shift: k >= 0. 1 is the paper's loss; 0 its ablation "w/o shift", where every step counts.
      masked: False counts every pair, also those across two episodes, as the authors' released code does.
      align: (prediction, target, mask) -> loss and metrics, in place of `barlow_twins`; such as `cosine_alignment`.
      sample_deviation: as for `barlow_twins`.

    Returns:
      As `barlow_twins`, or as ``align``.

    Raises:
      ValueError: where the shapes do not agree, or where ``shift`` leaves no pair in T steps.

    Source: NE-Dreamer, "Next-embedding predictive alignment".
    """
    if predicted.ndim != 3 or embedding.shape != predicted.shape or is_first.shape != predicted.shape[:2]:
        raise ValueError(
            f"expected predicted and embedding [B, T, E] and is_first [B, T], got {predicted.shape}, {embedding.shape} "
            f"and {is_first.shape}"
        )
    length = predicted.shape[1]
    if not 0 <= shift < length:
        raise ValueError(f"expected 0 <= shift < T = {length}, got shift = {shift}")
    mask = None
    if masked:
        episode = jnp.cumsum(is_first.astype(jnp.int32), axis=1)  # the same number on all steps of an episode
        mask = episode[:, : length - shift] == episode[:, shift:]
    target = jax.lax.stop_gradient(embedding[:, shift:])
    pairs = predicted[:, : length - shift], target, mask
    if align is not None:
        return align(*pairs)
    return barlow_twins(*pairs, redundancy, sample_deviation=sample_deviation)
