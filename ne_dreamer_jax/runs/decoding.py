"""A decoder that is made after training, on frozen latents: an analysis of what they hold, with no part in the agent.

Source: NE-Dreamer, "Representation diagnostics".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.loop.play import Steps
from ne_dreamer_jax.losses import image_loss
from ne_dreamer_jax.nets.decoder import Decoder
from ne_dreamer_jax.types import Array, Latent

BATCH, LEARNING_RATE = 64, 1e-3


class Decoded(NamedTuple):
    """A decoder made after training, and how well it draws frames that it has not seen."""

    draw: Callable[[Latent], np.ndarray]  # latents [N, ...] to uint8 [N, H, W, C]
    explained: float  # share of the variance of the pixels, beside the mean frame


def post_hoc_decoder(
    agent: Agent, key: Array, fit: Steps, held_out: Steps, name: str, updates: int, batch: int = BATCH
) -> Decoded:
    """Trains DreamerV3's decoder, mirroring the agent's encoder, on frozen latents and the image called ``name``."""
    frames, latents = fit.obs[name][fit.counts], jax.tree.map(lambda x: x[fit.counts], fit.latent)
    spec = {name: jax.eval_shape(lambda: jnp.asarray(frames[0]))}
    config = agent.config.encoder
    blocks = math.gcd(math.gcd(8, latents.deter.shape[-1]), config.depth * config.multipliers[-1])
    decoder = Decoder(config, spec, blocks)
    optimizer = optax.flatten(optax.adam(LEARNING_RATE))
    init_key, key = jax.random.split(key)
    params = decoder.init(init_key, jax.tree.map(lambda x: x[:1], latents))
    decode: Any = lambda params, latent: decoder.apply(params, latent)

    @jax.jit
    def update(params: Any, state: Any, latent: Latent, image: Array) -> tuple[Any, Any]:
        loss = lambda params: jnp.mean(image_loss(decode(params, latent)[name], image))
        with jax.numpy_dtype_promotion("standard"):  # optax raises floats to int32 powers
            change, state = optimizer.update(jax.grad(loss)(params), state, params)
        return optax.apply_updates(params, change), state

    state = optimizer.init(params)
    rows = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    for _ in range(updates):
        chosen = rows.integers(len(frames), size=batch)
        params, state = update(params, state, jax.tree.map(lambda x, i=chosen: x[i], latents), frames[chosen])
    drawn = jax.jit(lambda latent: decode(params, latent)[name])
    draw = lambda latent: np.asarray(jnp.round(255 * drawn(latent)).astype(jnp.uint8))

    mean, error, variance = frames.mean(0) / 255, 0.0, 0.0
    seen, unseen = held_out.obs[name][held_out.counts], jax.tree.map(lambda x: x[held_out.counts], held_out.latent)
    for i in range(0, len(seen), batch):
        image = seen[i : i + batch] / 255
        predicted = np.asarray(drawn(jax.tree.map(lambda x, i=i: x[i : i + batch], unseen)))
        error, variance = error + np.square(image - predicted).sum(), variance + np.square(image - mean).sum()
    return Decoded(draw, float(1 - error / max(variance, 1e-12)))
