"""NE-Dreamer's objective: predict the next encoder embedding from the history, and align it with Barlow Twins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import jax.numpy as jnp

from ne_dreamer_jax.losses import next_embedding_loss
from ne_dreamer_jax.nets.predictor import Predictor, PredictorConfig, check_length
from ne_dreamer_jax.objectives.base import Model, Objective, keep_target, no_target
from ne_dreamer_jax.types import Array, DiscreteAction, Metrics, Params, Rollout


@dataclass(frozen=True)
class NextEmbedding:
    """Settings of the next-embedding objective. The ablations of the paper are values of these fields."""

    predictor: PredictorConfig = field(default_factory=PredictorConfig)
    """``layers=0`` is w/o transformer, ``projector=False`` w/o projector."""
    shift: int = 1
    """The embedding at t + shift is the target of the prediction at t; 0 is w/o shift."""
    redundancy: float = 5e-4
    """Weight of the off-diagonal terms of Barlow Twins."""
    action: Literal["current", "previous"] = "current"
    """Whether the predictor at t is fed a_t (the paper) or a_{t-1} (the released code)."""
    masked: bool = True
    """Whether pairs across two episodes are left out of the loss (the paper) or not (the released code)."""
    across_episodes: bool = False
    """Whether attention reaches back beyond the start of the episode (the released code)."""

    def __post_init__(self) -> None:
        if self.action not in ("current", "previous"):
            raise ValueError(f"objective.action: expected 'current' or 'previous', got {self.action!r}.")
        if self.shift < 0:
            raise ValueError(f"objective.shift: expected 0 or more, got {self.shift}.")

    @property
    def losses(self) -> Mapping[str, float]:
        """Names and weights of the losses."""
        return {"next_embedding": 1.0}

    @property
    def method(self) -> str:
        """Name of the method, with what is ablated."""
        ablated = {
            "no_transformer": self.predictor.layers == 0,
            "no_shift": self.shift == 0,
            "no_projector": not self.predictor.projector,
        }
        return "/".join(["ne_dreamer", *filter(None, ["+".join(name for name, absent in ablated.items() if absent)])])

    def build(self, model: Model) -> Objective:
        """The objective's functions.

        Raises ValueError where sequences are too short for the shift, or too long for the predictor's positions.
        """
        if self.shift >= model.length:
            raise ValueError(
                f"objective.shift: expected less than agent.batch_length {model.length}, got {self.shift}."
            )
        check_length(self.predictor, model.length)
        nets, space = model.nets, model.nets.spec.action
        discrete = isinstance(space, DiscreteAction)
        predictor = Predictor(self.predictor, nets.embedding, discrete, self.across_episodes, nets.dtype)

        def init(key: Array) -> Params:
            feature, action = jnp.zeros((1, 1, nets.feature)), jnp.zeros((1, 1, space.size))
            return predictor.init(key, feature, action, jnp.zeros((1, 1), bool))["params"]

        def loss(params: Params, target: Params, key: Array, rollout: Rollout) -> tuple[dict[str, Array], Metrics]:
            action = rollout.action if self.action == "current" else rollout.prev_action
            is_first = rollout.batch.is_first
            predicted: Any = predictor.apply({"params": params["objective"]}, rollout.feature, action, is_first)
            value, metrics = next_embedding_loss(
                predicted, rollout.embedding, is_first, self.redundancy, self.shift, self.masked
            )
            return {"next_embedding": value}, {f"next_embedding/{name}": x for name, x in metrics.items()}

        return Objective(init, no_target, loss, keep_target)
