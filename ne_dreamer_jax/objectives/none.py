"""No objective: reward, continuation and KL alone shape the latent states (the paper's "no reconstruction")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ne_dreamer_jax.objectives.base import Model, Objective, keep_target, no_target
from ne_dreamer_jax.types import Array, Metrics, Params, Rollout


@dataclass(frozen=True)
class NoObjective:
    """Has no settings, no parameters and no losses."""

    @property
    def losses(self) -> Mapping[str, float]:
        """None."""
        return {}

    def build(self, model: Model) -> Objective:
        """The objective's functions."""

        def loss(params: Params, target: Params, key: Array, rollout: Rollout) -> tuple[dict[str, Array], Metrics]:
            return {}, {}

        return Objective(lambda key: {}, no_target, loss, keep_target)
