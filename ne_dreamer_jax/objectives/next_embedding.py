"""NE-Dreamer's objective: predict the next encoder embedding from the history, and align it with Barlow Twins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import jax.numpy as jnp

from ne_dreamer_jax.losses import cosine_alignment, next_embedding_loss, vicreg
from ne_dreamer_jax.nets.microbatches import in_microbatches
from ne_dreamer_jax.nets.predictor import Predictor, PredictorConfig, check_length
from ne_dreamer_jax.objectives.base import Model, Objective, keep_target, no_target
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import NonNegative, Positive, Range
from ne_dreamer_jax.types import Array, DiscreteAction, Metrics, Params, Rollout

ALIGNMENTS: dict[str, Any] = {"barlow_twins": None, "cosine": cosine_alignment, "vicreg": vicreg}
"""Name -> what `next_embedding_loss` takes in place of Barlow Twins."""


@dataclass(frozen=True)
class NextEmbedding:
    """Settings of the next-embedding objective. The ablations of the paper are values of these fields."""

    predictor: PredictorConfig = field(default_factory=PredictorConfig)
    """``layers=0`` is w/o transformer, ``projector=False`` w/o projector."""
    shift: Annotated[int, Range(0, 10_000)] = 1
    """The embedding at t + shift is the target of the prediction at t; 0 is w/o shift."""
    steps: Annotated[int, Range(1, 10_000)] = 1
    """K: at each step the embeddings at t + shift, ..., t + shift + K - 1 are predicted, each by outputs of its own."""
    step_discount: Positive = 0.5
    """The loss of each step further ahead weighs so much less; the weights are scaled to the sum 1."""
    alignment: Literal["barlow_twins", "cosine", "vicreg"] = "barlow_twins"
    """How predictions are aligned to embeddings: as in the paper, or by a loss that it names as open."""
    redundancy: NonNegative = 5e-4
    """Weight of the off-diagonal terms of Barlow Twins; the other alignments have weights of their own."""
    sample_deviation: bool = False
    """Whether Barlow Twins, and it alone, standardises by the sample's deviation (N - 1; the released code) or the
    population's."""
    action: Literal["current", "previous"] = "current"
    """Whether the predictor at t is fed a_t (the paper) or a_{t-1} (the released code)."""
    masked: bool = True
    """Whether pairs across two episodes are left out of the loss (the paper) or not (the released code)."""
    across_episodes: bool = False
    """Whether attention reaches back beyond the start of the episode (the released code)."""
    unshifted_token: Literal["action", "state"] = "action"
    """At which token of step t predictions are read where ``shift`` is 0: the action's, as otherwise, or the state's,
    which does not see a_t (the released code)."""

    def __post_init__(self) -> None:
        ranges.check(self)

    @property
    def losses(self) -> Mapping[str, float]:
        """Names and weights of the losses."""
        return {"next_embedding": 1.0}

    @property
    def extensions(self) -> tuple[str, ...]:
        """What goes beyond the paper, for the method's name."""
        extended = {f"{self.steps}_steps": self.steps > 1, self.alignment: self.alignment != "barlow_twins"}
        return tuple(name for name, applies in extended.items() if applies)

    def build(self, model: Model) -> Objective:
        """The objective's functions.

        Raises ValueError where sequences are too short for the shift, or too long for the predictor's positions.
        """
        if self.shift >= model.length:
            raise ValueError(
                f"objective.shift: expected less than agent.batch_length {model.length}, got {self.shift}."
            )
        if self.shift + self.steps > model.length:
            raise ValueError(
                f"objective.steps: expected at most agent.batch_length {model.length} less objective.shift "
                f"{self.shift}, got {self.steps}."
            )
        check_length(self.predictor, model.length)
        nets, space = model.nets, model.nets.spec.action
        discrete = isinstance(space, DiscreteAction)
        at_state = self.shift == 0 and self.unshifted_token == "state"
        predictor = Predictor(
            self.predictor, nets.embedding, discrete, self.across_episodes, nets.dtype, self.steps, at_state
        )
        weights = [self.step_discount**k for k in range(self.steps)]
        align: Any = ALIGNMENTS[self.alignment]

        def init(key: Array) -> Params:
            feature, action = jnp.zeros((1, 1, nets.feature)), jnp.zeros((1, 1, space.size))
            return predictor.init(key, feature, action, jnp.zeros((1, 1), bool))["params"]

        def loss(params: Params, target: Params, key: Array, rollout: Rollout) -> tuple[dict[str, Array], Metrics]:
            action = rollout.action if self.action == "current" else rollout.prev_action
            is_first = rollout.batch.is_first
            predict = lambda *inputs: predictor.apply({"params": params["objective"]}, *inputs)
            predicted: Any = in_microbatches(predict, model.microbatches)(rollout.feature, action, is_first)
            total = jnp.zeros(())
            metrics: Metrics = {}
            for k, (weight, ahead) in enumerate(zip(weights, jnp.split(predicted, self.steps, axis=-1), strict=True)):
                value, details = next_embedding_loss(
                    ahead,
                    rollout.embedding,
                    is_first,
                    self.redundancy,
                    self.shift + k,
                    self.masked,
                    align,
                    self.sample_deviation,
                )
                total = total + weight / sum(weights) * value
                prefix = f"next_embedding/{k + 1}_" if k else "next_embedding/"
                metrics |= {prefix + name: x for name, x in details.items()}
            return {"next_embedding": total}, metrics

        return Objective(init, no_target, loss, keep_target)
