"""Updates whose numbers are not finite change nothing, and are named."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import optax

from ne_dreamer_jax.types import Array, Metrics, Params

T = TypeVar("T")

SKIPPED = "skipped_updates"
"""The metric that is 1 where an update was skipped."""
PREFIX = "non_finite/"
"""Of metrics that are 1 where something was not finite: ``non_finite/loss/reward``, ``non_finite/gradient/rssm``."""


def is_count(name: str) -> bool:
    """Whether a metric is one of this module's, of which sums, not means, are told."""
    return name == SKIPPED or name.startswith(PREFIX)


def check(losses: Mapping[str, Array], gradients: Mapping[str, Params]) -> tuple[Array, Metrics]:
    """Whether an update is sound, and what is not.

    Args:
      losses: name -> float32 [].
      gradients: module -> its gradients; also those count as not finite whose squares overflow float32.

    Returns:
      bool [], and the metrics, float32 [], of this module.
    """
    sound = {f"loss/{name}": jnp.isfinite(value) for name, value in losses.items()}
    sound |= {f"gradient/{name}": jnp.isfinite(optax.tree.norm(tree)) for name, tree in gradients.items()}
    finite = jnp.stack(list(sound.values())).all()
    metrics = {f"{PREFIX}{name}": (~value).astype(jnp.float32) for name, value in sound.items()}
    return finite, metrics | {SKIPPED: (~finite).astype(jnp.float32)}


def keep_unless(finite: Array, new: T, old: T) -> T:
    """``new`` where the update was sound, else ``old``, bit for bit."""
    return jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, old)


def counted(metrics: Metrics) -> Metrics:
    """An update's metrics as they are added up: those of a skipped one are zero, but for what was not finite."""
    skipped: Any = metrics[SKIPPED] > 0
    return {name: value if is_count(name) else jnp.where(skipped, 0.0, value) for name, value in metrics.items()}
