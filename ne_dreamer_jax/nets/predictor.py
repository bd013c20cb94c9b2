"""The causal temporal transformer of the paper: ``e-hat_{t+1} = T(h_<=t, z_<=t, a_<=t)``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.linen import initializers

from ne_dreamer_jax.nets.blocks import Linear, add_bias, kernel_init
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import Depth, Width
from ne_dreamer_jax.types import Array


@dataclass(frozen=True)
class PredictorConfig:
    """Sizes of the predictor."""

    layers: Depth = 2
    """Transformer layers; 0 is the ablation without a transformer: a perceptron on each step alone."""
    width: Width = 256
    heads: Width = 4
    feedforward: Width = 1024
    positions: Width = 128
    """Longest sequence, in steps; a step is two tokens, each with a learned position."""
    projector: bool = True
    """A bias-free linear layer F to E before the tokens' own linear layer. Without it the function class is the
    same; what changes is the optimisation (the paper's w/o projector)."""
    discrete_action: Literal["embedding", "normalised"] = "embedding"
    """How a discrete action becomes a token: an embedding, or its one-hot through linear, LayerNorm and GELU, as a
    continuous action (the released code, which never reaches its own embedding)."""
    attention_init: Literal["fan_in", "xavier"] = "fan_in"
    """How queries, keys and values start: as every other layer (standard deviation 0.0625 at width 256), or uniform, by
    Xavier's rule for one layer that gives all three (0.0442; the released code)."""

    def __post_init__(self) -> None:
        ranges.check(self)
        if self.width % self.heads:
            raise ValueError(
                f"objective.predictor.width must be a multiple of its heads, got {self.width} and {self.heads}; the "
                f"nearest above is {-(-self.width // self.heads) * self.heads}."
            )


def check_length(config: PredictorConfig, length: int) -> None:
    """Raises ValueError where a sequence of ``length`` steps exceeds the learned positions."""
    if config.layers and length > config.positions:
        raise ValueError(
            f"Sequences of {length} steps, but the predictor has positions for {config.positions}. Shorten "
            f"agent.batch_length or raise agent.objective.predictor.positions."
        )


def episode_causal_mask(is_first: Array, *, across_episodes: bool = False) -> Array:
    """Which tokens see which: bool [B, 2T, 2T] for the interleaved tokens state, action, state, action.

    A token sees those at or before it whose step lies in the same episode, episodes being split at ``is_first``
    [B, T]; with ``across_episodes`` all at or before it.
    """
    tokens = 2 * is_first.shape[1]
    causal = jnp.tril(jnp.ones((1, tokens, tokens), bool))
    if across_episodes:
        return jnp.broadcast_to(causal, (is_first.shape[0], tokens, tokens))
    episode = jnp.repeat(jnp.cumsum(is_first.astype(jnp.int32), axis=1), 2, axis=1)
    return causal & (episode[:, :, None] == episode[:, None, :])


class LayerNorm(nn.Module):
    """LayerNorm over the last axis in float32, returned in ``dtype``."""

    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array) -> Array:
        return nn.LayerNorm(epsilon=1e-5, dtype=jnp.float32, name="norm")(x.astype(jnp.float32)).astype(self.dtype)


class TransformerLayer(nn.Module):
    """Pre-norm attention and feed-forward: ``[B, L, width]`` with ``mask`` bool [B, L, L]."""

    config: PredictorConfig
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array, mask: Array) -> Array:
        c = self.config
        start = initializers.xavier_uniform() if c.attention_init == "xavier" else kernel_init()
        normed = LayerNorm(self.dtype, name="attention_norm")(x)
        qkv = Linear(3 * c.width, kernel_init=start, dtype=self.dtype, name="qkv")(normed)
        query, key, value = jnp.split(qkv.reshape(*x.shape[:-1], 3 * c.heads, c.width // c.heads), 3, axis=-2)
        # Float32 operands: at 2T tokens they cost next to nothing beside the linear layers.
        query, key, value = (part.astype(jnp.float32) for part in (query, key, value))
        attended = jax.nn.dot_product_attention(query, key, value, mask=mask[:, None])
        x = x + Linear(c.width, dtype=self.dtype, name="out")(attended.reshape(x.shape))
        y = Linear(c.feedforward, dtype=self.dtype, name="up")(LayerNorm(self.dtype, name="feedforward_norm")(x))
        return x + Linear(c.width, dtype=self.dtype, name="down")(nn.gelu(y, approximate=False))


class Predictor(nn.Module):
    """Predicts an embedding at every step from the states and actions up to it, within the episode."""

    config: PredictorConfig
    embedding: int
    discrete: bool
    across_episodes: bool = False
    dtype: Any = jnp.float32
    steps: int = 1  # K, how many embeddings are predicted at each step
    at_state: bool = False  # read at the state's token, which does not see the action of its own step

    @nn.compact
    def __call__(self, feature: Array, action: Array, is_first: Array) -> Array:
        """``feature`` [B, T, F], ``action`` [B, T, A] and ``is_first`` [B, T] to float32 [B, T, K * E].

        Raises ValueError where T exceeds the learned positions.
        """
        c, dtype = self.config, self.dtype
        state = feature
        if c.projector:
            state = Linear(self.embedding, use_bias=False, dtype=dtype, name="projector")(state)
        state = Linear(c.width, dtype=dtype, name="state_in")(state)
        if self.discrete and c.discrete_action == "embedding":
            act = Linear(c.width, use_bias=False, dtype=dtype, name="action_in")(action)
        else:
            act = Linear(c.width, dtype=dtype, name="action_in")(action)
            act = nn.gelu(LayerNorm(dtype, name="action_norm")(act), approximate=False)
        alone = state if self.at_state else state + act
        x = self._attend(state, act, is_first) if c.layers else alone
        x = Linear(c.width, dtype=dtype, name="hidden")(LayerNorm(dtype, name="out_norm")(x))
        x = Linear(self.steps * self.embedding, dtype=dtype, name="out")(nn.gelu(x, approximate=False))
        return x.astype(jnp.float32)

    def _attend(self, state: Array, act: Array, is_first: Array) -> Array:
        c = self.config
        batch, length, width = state.shape
        check_length(c, length)
        x = jnp.stack([state, act], axis=2).reshape(batch, 2 * length, width)
        positions = self.param("positions", initializers.normal(0.02), (2 * c.positions, c.width), jnp.float32)
        x = add_bias(x, positions[: 2 * length])
        mask = episode_causal_mask(is_first, across_episodes=self.across_episodes)
        for i in range(c.layers):
            x = TransformerLayer(c, self.dtype, name=f"layer{i}")(x, mask)
        return x[:, 0::2] if self.at_state else x[:, 1::2]
