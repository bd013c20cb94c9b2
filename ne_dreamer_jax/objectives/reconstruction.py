"""DreamerV3's objective: decode the observation from the latent state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from ne_dreamer_jax.losses import image_loss, vector_loss
from ne_dreamer_jax.nets.decoder import Decoder
from ne_dreamer_jax.nets.microbatches import in_microbatches
from ne_dreamer_jax.nets.rssm import initial_latent
from ne_dreamer_jax.objectives.base import Model, Objective, keep_target, no_target
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import Width
from ne_dreamer_jax.types import Array, Latent, Metrics, Params, Rollout


@dataclass(frozen=True)
class Reconstruction:
    """Settings of the reconstruction objective. The decoder's sizes are the encoder's.

    The observation of a step is decoded from the posterior state of the same step; images by the squared error of
    image / 255 summed over pixels and channels, vectors by that of their symlog, averaged over B and T.

    Source: DreamerV3 (Hafner et al., 2025).
    """

    blocks: Width = 8
    """Blocks of the decoder's linear map from the deterministic state."""

    def __post_init__(self) -> None:
        ranges.check(self)

    @property
    def losses(self) -> Mapping[str, float]:
        """Names and weights of the losses."""
        return {"reconstruction": 1.0}

    def build(self, model: Model) -> Objective:
        """The objective's functions. Raises ValueError where the blocks don't divide the sizes."""
        nets = model.nets
        decoder = Decoder(nets.encoder.config, nets.spec.observation, self.blocks, nets.dtype)

        def init(key: Array) -> Params:
            return decoder.init(key, initial_latent(nets.rssm.config, (1,)))["params"]

        def loss(params: Params, target: Params, key: Array, rollout: Rollout) -> tuple[dict[str, Array], Metrics]:
            def decode(latent: Latent, obs: Mapping[str, Array]) -> dict[str, Array]:
                """The errors of each observation, [b, T]."""
                decoded: Any = decoder.apply({"params": params["objective"]}, latent)
                return {name: _error(predicted, obs[name]) for name, predicted in decoded.items()}

            of_each = in_microbatches(decode, model.microbatches)(rollout.latent, rollout.batch.obs)
            errors = {name: jnp.mean(error) for name, error in of_each.items()}
            total = sum(errors.values(), jnp.zeros(()))
            return {"reconstruction": total}, {f"reconstruction/{name}": x for name, x in errors.items()}

        return Objective(init, no_target, loss, keep_target)


def _error(predicted: Array, observed: Array) -> Array:
    """Of a decoded image or vector, by step."""
    if observed.dtype == jnp.uint8:
        return image_loss(predicted, observed)
    return vector_loss(predicted, observed.reshape(predicted.shape))
