"""Lambda-returns and the scale by which DreamerV3 normalises them."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ._shapes import expect_same


def lambda_returns(
    reward: jax.Array,
    value: jax.Array,
    discount: jax.Array,
    lam: float = 0.95,
    is_last: jax.Array | None = None,
) -> jax.Array:
    r"""TD(lambda) returns along trajectories of H + 1 states, time on the LAST axis.

    .. math::
        R_t = r_{t+1} + d_{t+1} \big( (1 - \lambda_{t+1}) v_{t+1} + \lambda_{t+1} R_{t+1} \big),
        \qquad R_H = v_H, \qquad t = 0, \dots, H - 1

    Rewards are received ON ARRIVAL: :math:`r_{t+1}` is what the action at t earned, and :math:`d_{t+1}` whether, and
    how discounted, life goes on from the state at t+1. The paper prints
    :math:`R_t = r_t + \gamma c_t ((1 - \lambda) V_{t+1} + \lambda R_{t+1})`, where :math:`r_t, c_t` belong to the
    transition out of t; the world model predicts both from the state that the transition leads to, so the paper's
    :math:`r_t, \gamma c_t` are ``reward[t + 1], discount[t + 1]`` here. ``reward[..., 0]`` and ``discount[..., 0]``
    (how the first state was reached) are not used.

    Imagined trajectories: ``discount`` = predicted continuation (times :math:`\gamma` where the head does not contain
    it). Replayed sequences: ``discount`` = :math:`\gamma` (1 - is_terminal), ``value`` = what to bootstrap with
    (DreamerV3: the first imagined return from each replayed state), and ``is_last``. A terminal step then cuts the
    value, and a last step cuts the chain: :math:`\lambda_t = \lambda (1 - last_t)`, so that an episode ended by a time
    limit bootstraps from the value of its last state. The return AT a last step mixes two episodes: weight it by zero.

    Args:
      reward: ``[..., H + 1]``.
      value: ``[..., H + 1]``.
      discount: ``[..., H + 1]``.
      lam: :math:`\lambda`.
      is_last: bool ``[..., H + 1]``, or None where no step is.

    Returns:
      :math:`R_0, \dots, R_{H-1}`, float32 ``[..., H]``. Differentiable in all three.

    Raises:
      ValueError: where the shapes do not agree, or where there are fewer than two states.

    Source: NE-Dreamer, eq. for :math:`R^\lambda_t`; DreamerV3, eq. for the same; Sutton and Barto (2018), 12.1.
    """
    expect_same(reward=reward, value=value, discount=discount, **({} if is_last is None else {"is_last": is_last}))
    if reward.ndim < 1 or reward.shape[-1] < 2:
        raise ValueError(f"expected a reward of shape [..., H + 1] with H >= 1, got {reward.shape}")
    reward, value, discount = (x[..., 1:].astype(jnp.float32) for x in (reward, value, discount))
    chain = jnp.full_like(value, lam)
    if is_last is not None:
        chain = jnp.where(is_last[..., 1:], 0.0, chain)
    chain = chain.at[..., -1].set(0.0)  # R_H = v_H
    # R_t = offset_t + slope_t R_{t+1} is a composition of affine maps, so it takes log2(H) parallel steps.
    offset = reward + discount * (1.0 - chain) * value
    slope = discount * chain

    def compose(later: tuple[jax.Array, jax.Array], earlier: tuple[jax.Array, jax.Array]):
        return earlier[0] + earlier[1] * later[0], earlier[1] * later[1]

    returns, _ = jax.lax.associative_scan(compose, (offset, slope), reverse=True, axis=offset.ndim - 1)
    return returns


def update_percentiles(
    low: jax.Array,
    high: jax.Array,
    returns: jax.Array,
    decay: float = 0.99,
    percentiles: tuple[float, float] = (5.0, 95.0),
    method: str = "linear",
) -> tuple[jax.Array, jax.Array]:
    """Exponential moving averages of two percentiles of the returns: ``decay * old + (1 - decay) * new``.

    They start from zero and are not debiased, as in DreamerV3: the scale grows into place over the first updates.

    Args:
      low: float32 ``[]``, average of the lower percentile so far; 0 at the start.
      high: float32 ``[]``, of the upper one.
      returns: any shape; receives no gradient.
      decay: of the averages.
      percentiles: lower and upper, in percent.
      method: what a percentile between two returns is: ``"linear"`` interpolates, ``"nearest"`` takes the nearer one.

    Returns:
      The new ``(low, high)``.

    Source: DreamerV3, "return normalization".
    """
    fractions = jnp.asarray(percentiles, jnp.float32) / 100.0
    returns = jax.lax.stop_gradient(returns).astype(jnp.float32)
    if method == "nearest":
        now = jnp.sort(returns.ravel())[jnp.round(fractions * (returns.size - 1)).astype(jnp.int32)]
    else:
        now = jnp.quantile(returns, fractions, method=method)
    low, high = low.astype(jnp.float32), high.astype(jnp.float32)
    return decay * low + (1.0 - decay) * now[0], decay * high + (1.0 - decay) * now[1]


def return_scale(low: jax.Array, high: jax.Array, floor: float = 1.0) -> jax.Array:
    """What returns and advantages are divided by: ``max(floor, high - low)``, float32 ``[]``, without gradient.

    The floor keeps small returns (sparse rewards not yet found) from being blown up into noise.
    """
    low, high = jax.lax.stop_gradient((low.astype(jnp.float32), high.astype(jnp.float32)))
    return jnp.maximum(high - low, floor)
