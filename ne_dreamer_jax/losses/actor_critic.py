"""Actor and critic losses of DreamerV3 on imagined trajectories, one value a step; the mean is the caller's.

In all of them ``weight`` is the probability-like weight of a step (the cumulative product of the discounted
continuations up to it), so that steps after an imagined end of the episode do not count.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ._shapes import expect_leading, expect_same
from .twohot import twohot_loss


def reinforce_loss(
    log_prob: jax.Array,
    advantage: jax.Array,
    entropy: jax.Array,
    weight: jax.Array,
    entropy_scale: float | jax.Array = 3e-4,
) -> jax.Array:
    r"""Score-function actor loss, :math:`-w_t (\mathrm{sg}(A_t) \log \pi(a_t | s_t) + \eta H[\pi(\cdot | s_t)])`.

    Args:
      log_prob: ``[...]``, log-density of the raw sampled action at t, through which the advantage trains the actor.
      advantage: ``[...]``, :math:`A_t = (R_t - v_t) / \max(1, S)`; receives no gradient.
      entropy: ``[...]``, in nats.
      weight: ``[...]``; receives no gradient.
      entropy_scale: :math:`\eta`.

    Returns:
      float32 ``[...]``.

    Raises:
      ValueError: where the shapes do not agree.

    Source: NE-Dreamer and DreamerV3, eq. for the actor loss.
    """
    expect_same(log_prob=log_prob, advantage=advantage, entropy=entropy, weight=weight)
    weight, advantage = jax.lax.stop_gradient((weight, advantage))
    objective = advantage.astype(jnp.float32) * log_prob.astype(jnp.float32)
    bonus = jnp.asarray(entropy_scale, jnp.float32) * entropy.astype(jnp.float32)
    return -weight.astype(jnp.float32) * (objective + bonus)


def dynamics_loss(
    normalized_return: jax.Array,
    entropy: jax.Array,
    weight: jax.Array,
    entropy_scale: float | jax.Array = 3e-4,
) -> jax.Array:
    r"""Actor loss backpropagated through the world model, :math:`-w_t (R_t / \max(1, S) + \eta H[\pi(\cdot | s_t)])`.

    The return must depend on the policy through reparameterised actions (continuous ones) and the imagined states. A
    baseline would change no gradient, so there is none. Whether an action is also trained for how it moves the states
    in which later ones are chosen is decided where these are: Dreamer's code holds the actor's inputs fixed.

    Args:
      normalized_return: ``[...]``, :math:`R_t / \max(1, S)`, with gradients.
      entropy: ``[...]``, in nats.
      weight: ``[...]``; receives no gradient.
      entropy_scale: :math:`\eta`.

    Returns:
      float32 ``[...]``.

    Raises:
      ValueError: where the shapes do not agree.

    Source: NE-Dreamer, "Actor-Critic Learning" (text); Dreamer (Hafner et al., 2020).
    """
    expect_same(normalized_return=normalized_return, entropy=entropy, weight=weight)
    weight = jax.lax.stop_gradient(weight).astype(jnp.float32)
    bonus = jnp.asarray(entropy_scale, jnp.float32) * entropy.astype(jnp.float32)
    return -weight * (normalized_return.astype(jnp.float32) + bonus)


def critic_loss(
    logits: jax.Array,
    returns: jax.Array,
    slow_value: jax.Array,
    weight: jax.Array,
    bins: jax.Array,
    slow_scale: float = 1.0,
) -> jax.Array:
    r"""Distributional critic loss, regularised towards its own slow copy.

    .. math::
        L_t = w_t \big( -\log p(R_t | s_t) - \beta \log p(v^{slow}_t | s_t) \big),

    each log-likelihood being the two-hot cross-entropy of `twohot_loss`.

    Args:
      logits: ``[..., K]``, the critic's output at t.
      returns: ``[...]``, :math:`R_t`, not normalised; receives no gradient.
      slow_value: ``[...]``, mean of the slow critic's prediction at t; receives no gradient.
      weight: ``[...]``; receives no gradient.
      bins: ``[K]``.
      slow_scale: :math:`\beta`.

    Returns:
      float32 ``[...]``.

    Raises:
      ValueError: where the shapes do not agree.

    Source: NE-Dreamer, eq. for the critic loss; DreamerV3 for the regulariser.
    """
    expect_leading("logits", logits.shape, returns=returns, slow_value=slow_value, weight=weight)
    loss = twohot_loss(logits, returns, bins) + slow_scale * twohot_loss(logits, slow_value, bins)
    return jax.lax.stop_gradient(weight).astype(jnp.float32) * loss
