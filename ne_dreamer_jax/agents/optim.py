"""The optimiser: adaptive gradient clipping per tensor, then Adam or LaProp, with linear warm-up."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import optax

from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import CountOrNone, Positive, Range, ShareBelowOne


@dataclass(frozen=True)
class OptimizerConfig:
    """The defaults are the paper's table; warm-up and the floor of the clipping are DreamerV3's."""

    name: Literal["adam", "laprop"] = "adam"
    """laprop is what the authors' released code and DreamerV3 use."""
    learning_rate: Positive = 4e-5
    beta1: ShareBelowOne = 0.9
    beta2: ShareBelowOne = 0.999
    eps: Positive = 1e-20
    agc: Annotated[float, Range(0.0, math.inf, above=True)] = 0.3
    """A tensor's gradient norm is at most this share of the tensor's own; inf for no clipping."""
    agc_pmin: Positive = 1e-3
    """A tensor's norm counts as at least this, so that zeros can grow."""
    warmup: CountOrNone = 1000
    """Updates until the full learning rate; 0 for none."""

    def __post_init__(self) -> None:
        ranges.check(self)


def clip_per_tensor(clip: float, pmin: float) -> optax.GradientTransformation:
    r"""Adaptive gradient clipping (Brock et al., 2021) with one norm a tensor, as DreamerV3 clips.

    Each gradient g of a parameter tensor :math:`\theta` becomes
    :math:`g / \max(1, \|g\| / (clip \cdot \max(pmin, \|\theta\|)))`. (``optax.adaptive_grad_clip`` compares the norms
    of each unit, which is another rule.)
    """

    def update(updates, state, params=None):
        if params is None:
            raise ValueError("clipping relative to the parameters needs them: call update(gradients, state, params)")

        def clipped(gradient: jax.Array, parameter: jax.Array) -> jax.Array:
            limit = clip * jnp.maximum(jnp.linalg.norm(parameter.ravel()), pmin)
            return gradient / jnp.maximum(jnp.linalg.norm(gradient.ravel()) / limit, 1.0)

        return jax.tree.map(clipped, updates, params), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def make(config: OptimizerConfig) -> optax.GradientTransformation:
    r"""The gradient transformation that ``config`` describes; ``update`` needs the parameters.

    Both rules keep bias-corrected averages m and v of first and second moments. Adam's update is
    :math:`m(g) / (\sqrt{v(g^2)} + \epsilon)`; LaProp (Ziyin et al., 2020) averages the normalised gradient instead,
    :math:`m(g / (\sqrt{v(g^2)} + \epsilon))`. Update number u (from 0) is taken with the learning rate times
    min(1, (u + 1) / warmup).

    With the default epsilon only gradients that are exactly zero, or whose squares underflow in float32 (below about
    1e-18), feel it; zero gradients give zero updates.
    """
    b1, b2, eps = config.beta1, config.beta2, config.eps
    rules = {
        "adam": lambda: optax.scale_by_adam(b1, b2, eps),
        "laprop": lambda: optax.chain(
            optax.scale_by_rms(b2, eps, eps_in_sqrt=False, bias_correction=True), optax.ema(b1)
        ),
    }

    def learning_rate(update: jax.Array) -> jax.Array:
        ramp = (update.astype(jnp.float32) + 1.0) / max(config.warmup, 1)
        return config.learning_rate * jnp.minimum(ramp, 1.0)

    # Only the clipping needs to know the tensors. The rest runs on one flat vector: a dozen kernels instead of several
    # for each of a hundred tensors, which halves the optimiser's compile time and its launches on a GPU.
    chain = optax.chain(
        clip_per_tensor(config.agc, config.agc_pmin),
        optax.flatten(optax.chain(rules[config.name](), optax.scale_by_learning_rate(learning_rate))),
    )

    def update(updates, state, params=None):
        with jax.numpy_dtype_promotion("standard"):  # optax raises floats to int32 powers
            return chain.update(updates, state, params)

    return optax.GradientTransformation(chain.init, update)
