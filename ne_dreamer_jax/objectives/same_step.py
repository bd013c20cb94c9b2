"""R2-Dreamer's objective: Barlow Twins between the latent state and the embedding of the same step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from ne_dreamer_jax.losses import barlow_twins
from ne_dreamer_jax.nets.blocks import Linear
from ne_dreamer_jax.objectives.base import Model, Objective, keep_target, no_target
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import NonNegative
from ne_dreamer_jax.types import Array, Metrics, Params, Rollout


@dataclass(frozen=True)
class SameStep:
    r"""Settings of the same-step objective.

    :math:`k_t = W \, [z_t, h_t]`, a bias-free linear projection of the posterior state F to E, is aligned to
    :math:`\mathrm{sg}(e_t)` over all steps of the batch. Beside the next-embedding objective it has no action, no
    history beyond the recurrence's own, and no shift.

    Source: R2-Dreamer: Redundancy-Reduced World Models without Decoders or Augmentation (arXiv:2603.18202).
    """

    redundancy: NonNegative = 5e-4
    """Weight of the off-diagonal terms of Barlow Twins."""
    sample_deviation: bool = False
    """Whether Barlow Twins standardises by the sample's deviation (N - 1; the released code) or the population's."""

    def __post_init__(self) -> None:
        ranges.check(self)

    @property
    def losses(self) -> Mapping[str, float]:
        """Names and weights of the losses."""
        return {"same_step": 0.05}

    def build(self, model: Model) -> Objective:
        """The objective's functions."""
        projector = Linear(model.nets.embedding, use_bias=False, dtype=model.nets.dtype)

        def init(key: Array) -> Params:
            return {"projector": projector.init(key, jnp.zeros((1, model.nets.feature)))["params"]}

        def loss(params: Params, target: Params, key: Array, rollout: Rollout) -> tuple[dict[str, Array], Metrics]:
            projected: Any = projector.apply({"params": params["objective"]["projector"]}, rollout.feature)
            embedding = jax.lax.stop_gradient(rollout.embedding)
            value, metrics = barlow_twins(
                projected.astype(jnp.float32), embedding, None, self.redundancy, sample_deviation=self.sample_deviation
            )
            return {"same_step": value}, {f"same_step/{name}": x for name, x in metrics.items()}

        return Objective(init, no_target, loss, keep_target)
