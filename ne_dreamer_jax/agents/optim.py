"""The optimiser: adaptive gradient clipping per tensor, then Adam or LaProp, with linear warm-up."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax

from ne_dreamer_jax.nets.rssm import PARTS_OF_ONE_TENSOR
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import CountOrNone, Positive, Range, ShareBelowOne


@dataclass(frozen=True)
class OptimizerConfig:
    """The defaults are the paper's table; warm-up and the floor of the clipping are DreamerV3's."""

    name: Literal["adam", "laprop", "laprop_weighted"] = "adam"
    """laprop is what DreamerV3 uses; laprop_weighted, whose momentum weighs each step by its learning rate, what the
    authors' released code and LaProp's own do."""
    learning_rate: Positive = 4e-5
    actor_rate_factor: Positive = 1.0
    """The actor's learning rate is so many times `learning_rate`. DreamerV3 and the paper have one rate for all;
    Dreamer (Hafner et al., 2020) trains actor and value model at 8e-5, beside the world model's 6e-4."""
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


Path = tuple[Any, ...]


def clip_per_tensor(
    clip: float, pmin: float, tensor: Callable[[Path], Hashable] = lambda path: path
) -> optax.GradientTransformation:
    r"""Adaptive gradient clipping (Brock et al., 2021) with one norm a tensor, as DreamerV3 clips.

    Each gradient g of a parameter tensor :math:`\theta` becomes
    :math:`g / \max(1, \|g\| / (clip \cdot \max(pmin, \|\theta\|)))`. (``optax.adaptive_grad_clip`` compares the norms
    of each unit, which is another rule.)

    Args:
      clip: largest norm of a gradient, relative to its tensor's.
      pmin: a tensor's norm counts as at least this.
      tensor: path of a leaf -> which tensor it is of; leaves of one tensor share a norm. Default: each its own.
    """

    def update(updates, state, params=None):
        if params is None:
            raise ValueError("clipping relative to the parameters needs them: call update(gradients, state, params)")
        leaves, structure = jax.tree.flatten_with_path(updates)
        if not leaves:
            return updates, state
        gradients: dict[Hashable, list[jax.Array]] = {}
        parameters: dict[Hashable, list[jax.Array]] = {}
        for (path, gradient), parameter in zip(leaves, jax.tree.leaves(params), strict=True):
            gradients.setdefault(tensor(path), []).append(gradient)
            parameters.setdefault(tensor(path), []).append(parameter)
        limit = clip * jnp.maximum(_norms(parameters), pmin)
        divisor = jnp.maximum(_norms(gradients) / limit, 1.0)
        of_tensor = dict(zip(gradients, jnp.split(divisor, len(gradients)), strict=True))
        clipped = [
            gradient / of_tensor[tensor(path)].reshape((1,) * gradient.ndim).astype(gradient.dtype)
            for path, gradient in leaves
        ]
        return jax.tree.unflatten(structure, clipped), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def _norms(tensors: Mapping[Hashable, Sequence[jax.Array]]) -> jax.Array:
    """The norm of each tensor, float32 [n].

    One array, so that what is done with the norms is a few kernels in all and not a few for each of them.
    """
    return jnp.sqrt(jnp.stack([optax.tree.norm(x, squared=True).astype(jnp.float32) for x in tensors.values()]))


def whole_tensor(path: Path) -> Path:
    """The tensor of the published networks that a leaf of ours is part of (`rssm.PARTS_OF_ONE_TENSOR`)."""
    names: list[Any] = [getattr(entry, "key", entry) for entry in path]
    if names[:1] == ["rssm"]:
        names[-1] = PARTS_OF_ONE_TENSOR.get(names[-1], names[-1])
    return tuple(names)


class WeightedAverage(NamedTuple):
    """State of `weighted_ema`."""

    updates: jax.Array  # int32 []
    weight: jax.Array  # float32 [], average of the weights so far
    mean: Any  # like the updates, average of weight times update


def weighted_ema(decay: float, weight: Callable[[jax.Array], jax.Array]) -> optax.GradientTransformation:
    r"""Exponential moving average in which step t counts ``weight(t)`` times: :math:`\overline{w u} / \overline w`.

    Bias-corrected by its own weights; with constant ones it is ``optax.ema``.
    """

    def init(params):
        zero = jnp.zeros(())
        return WeightedAverage(jnp.zeros((), jnp.int32), zero, jax.tree.map(jnp.zeros_like, params))

    def update(updates, state, params=None):
        now = weight(state.updates)
        average = lambda old, new: decay * old + (1 - decay) * now * new
        mean, total = jax.tree.map(average, state.mean, updates), average(state.weight, 1.0)
        return jax.tree.map(lambda m: m / total, mean), WeightedAverage(state.updates + 1, total, mean)

    return optax.GradientTransformation(init, update)


def make(config: OptimizerConfig) -> optax.GradientTransformation:
    r"""The gradient transformation that ``config`` describes; ``update`` needs the parameters.

    Both rules keep bias-corrected averages m and v of first and second moments. Adam's update is
    :math:`m(g) / (\sqrt{v(g^2)} + \epsilon)`; LaProp (Ziyin et al., 2020) averages the normalised gradient instead,
    :math:`m(g / (\sqrt{v(g^2)} + \epsilon))`. Update number u (from 0) is taken with the learning rate times
    min(1, (u + 1) / warmup); in LaProp's own code a normalised gradient counts in m by the learning rate of its update,
    which is another average while that rises (``laprop_weighted``). The learning rate of parameters under the name
    ``actor`` is ``actor_rate_factor`` times that.

    The default epsilon, 1e-20, keeps zero gradients from dividing by zero: they give zero updates. It damps nothing
    else. Gradients below 3e-18, whose squares' average underflows in float32, are divided by epsilon alone, which is a
    step of up to 300 learning rates in place of one.
    """
    b1, b2, eps = config.beta1, config.beta2, config.eps

    def ramp(update: jax.Array) -> jax.Array:
        return jnp.minimum((update.astype(jnp.float32) + 1.0) / max(config.warmup, 1), 1.0)

    def learning_rate(update: jax.Array) -> jax.Array:
        return config.learning_rate * ramp(update)

    normalised = lambda: optax.scale_by_rms(b2, eps, eps_in_sqrt=False, bias_correction=True)
    rules = {
        "adam": lambda: optax.scale_by_adam(b1, b2, eps),
        "laprop": lambda: optax.chain(normalised(), optax.ema(b1)),
        "laprop_weighted": lambda: optax.chain(normalised(), weighted_ema(b1, ramp)),
    }

    # Only the clipping needs to know the tensors. The rest runs on one flat vector: a dozen kernels instead of several
    # for each of a hundred tensors, which halves the optimiser's compile time and its launches on a GPU.
    chain = optax.chain(
        clip_per_tensor(config.agc, config.agc_pmin, whole_tensor),
        optax.flatten(optax.chain(rules[config.name](), optax.scale_by_learning_rate(learning_rate))),
    )

    def update(updates, state, params=None):
        with jax.numpy_dtype_promotion("standard"):  # optax raises floats to int32 powers
            updates, state = chain.update(updates, state, params)
        if config.actor_rate_factor != 1.0:
            updates = {**updates, "actor": optax.tree.scale(config.actor_rate_factor, updates["actor"])}
        return updates, state

    return optax.GradientTransformation(chain.init, update)
