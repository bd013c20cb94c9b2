"""Updates whose numbers are not finite change nothing, and are named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from ne_dreamer_jax.types import Array, Metrics, Params

State = TypeVar("State")

SKIPPED = "skipped_updates"
"""The metric that is 1 where an update was skipped."""
PREFIX = "non_finite/"
"""Of metrics that are 1 where something was not finite: ``non_finite/loss/reward``, ``non_finite/gradient/rssm``."""
_BITS_OF_2_TO_50 = (127 + 50) << 23  # the biased exponent; no fraction


def is_count(name: str) -> bool:
    """Whether a metric is one of this module's, of which sums, not means, are told."""
    return name == SKIPPED or name.startswith(PREFIX)


def check(losses: Mapping[str, Array], gradients: Mapping[str, Params]) -> tuple[Array, Metrics]:
    """Whether an update is sound, and what is not.

    Args:
      losses: name -> float32 [].
      gradients: module -> its gradients, float32; those count as not finite whose norms might overflow, see `is_sound`.

    Returns:
      bool [], and the metrics, float32 [], of this module.
    """
    sound = {f"loss/{name}": jnp.isfinite(value) for name, value in losses.items()}
    sound |= {f"gradient/{name}": is_sound(tree) for name, tree in gradients.items()}
    finite = jnp.stack(list(sound.values())).all()
    metrics = {f"{PREFIX}{name}": (~value).astype(jnp.float32) for name, value in sound.items()}
    return finite, metrics | {SKIPPED: (~finite).astype(jnp.float32)}


def is_sound(tree: Params) -> Array:
    """Whether all elements of a tree of float32 arrays are below 2^50 in magnitude, and so finite: bool [].

    The sum of the squares of up to 10^8 such elements fits float32. Compared are the bits less the sign, which order
    as the magnitudes do, NaN last: XLA's CPU backend vectorizes a maximum of integers, which makes this several times
    cheaper than ``isfinite``.
    """
    sound = jnp.ones((), bool)
    for x in jax.tree.leaves(tree):
        magnitude = jax.lax.bitcast_convert_type(x, jnp.int32) & 0x7FFF_FFFF
        sound &= jnp.max(magnitude, initial=0) < _BITS_OF_2_TO_50
    return sound


def update_if(finite: Array, update: Callable[..., State], state: State, *operands: Any) -> State:
    """``update(state, *operands)`` where ``finite``, else ``state``, bit for bit.

    A conditional: selecting between old and new arrays instead would read and write the whole state once more, which
    costs several percent of a small agent's update on a CPU.
    """
    return jax.lax.cond(finite, update, lambda state, *_: state, state, *operands)


def counted(metrics: Metrics) -> Metrics:
    """An update's metrics as they are added up: those of a skipped one are zero, but for what was not finite."""
    skipped: Any = metrics[SKIPPED] > 0
    return {name: value if is_count(name) else jnp.where(skipped, 0.0, value) for name, value in metrics.items()}
