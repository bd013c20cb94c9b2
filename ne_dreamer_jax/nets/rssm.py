"""The recurrent state-space model: ``h_t = f_rec(h_{t-1}, z_{t-1}, a_{t-1})``, its prior and its posterior.

The recurrence is DreamerV3's block-diagonal GRU. What does not depend on the carry (the embedding's and the action's
share, the prior's logits) is computed for all steps at once, outside the scans.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.linen import initializers

from ne_dreamer_jax.losses import unimix_logits
from ne_dreamer_jax.nets.blocks import (
    MLP,
    Block,
    Linear,
    RMSNorm,
    add_bias,
    block_linear,
    kernel_init,
    per_block,
)
from ne_dreamer_jax.nets.rematerialise import keeping_products
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import Depth, Share, Width
from ne_dreamer_jax.types import Array, Latent

PARTS_OF_ONE_TENSOR = {"state_kernel": "hidden_kernel", "input_kernel": "hidden_kernel"}
"""Parameter of `RSSM` -> the tensor that it is part of in DreamerV3 and the released code, whose block-linear layers
have one kernel each: gradients are clipped by the norm of the whole."""


@dataclass(frozen=True)
class RSSMConfig:
    """Sizes of the recurrent state-space model (defaults: the 12m preset)."""

    deter: Width = 2048
    """D, size of the deterministic state."""
    stoch: Width = 32
    """S, number of categorical latents."""
    classes: Width = 16
    """K, classes per latent."""
    hidden: Width = 256
    """Width of the layers around the recurrence."""
    blocks: Width = 8
    """Blocks of the recurrence; each sees only its own D / blocks of the state, and all of the inputs."""
    prior_layers: Depth = 2
    """Hidden layers from h_t to the prior's logits."""
    unimix: Share = 0.01
    """Share of the uniform distribution mixed into the distribution that latents are sampled from."""

    def __post_init__(self) -> None:
        ranges.check(self)
        if self.deter % self.blocks:
            raise ValueError(
                f"rssm.deter must be a multiple of rssm.blocks, got {self.deter} and {self.blocks}; "
                f"the nearest below is {self.deter // self.blocks * self.blocks}."
            )

    @property
    def feature(self) -> int:
        """F = S * K + D."""
        return self.stoch * self.classes + self.deter


def feature(latent: Latent) -> Array:
    """``concat(flat z_t, h_t)``: float32 [..., F]."""
    flat = latent.stoch.reshape(*latent.stoch.shape[:-2], -1)
    return jnp.concatenate([flat, latent.deter], axis=-1)


def initial_latent(config: RSSMConfig, batch: tuple[int, ...]) -> Latent:
    """Zeros: the state before the first observation of an episode, with leading axes ``batch``."""
    return Latent(jnp.zeros((*batch, config.deter)), jnp.zeros((*batch, config.stoch, config.classes)))


def mask_first(x: Array, is_first: Array) -> Array:
    """``x [N, ...]`` with zeros where ``is_first [N]``."""
    return jnp.where(jnp.expand_dims(is_first, range(is_first.ndim, x.ndim)), jnp.zeros_like(x), x)


def sample_onehot(uniform: Array, logits: Array) -> Array:
    """One-hot samples of ``logits [..., K]`` by inverting the cumulative distribution at ``uniform [...]`` in [0, 1).

    The gradient is straight-through: that of the probabilities. One uniform number a latent is an order of
    magnitude less random-number work than one Gumbel a class.
    """
    probs = jax.nn.softmax(logits, axis=-1)
    below = jnp.cumsum(jax.lax.stop_gradient(probs), axis=-1)[..., :-1] <= uniform[..., None]
    sample = jax.nn.one_hot(jnp.sum(below, axis=-1), logits.shape[-1], dtype=probs.dtype)
    return sample + (probs - jax.lax.stop_gradient(probs))  # in this order the value is one-hot to the bit


def _gate(x: Array, state: Array, kernel: Array, bias: Array) -> Array:
    """A block's GRU gates: its new state [N, D / blocks] float32 from the candidate's input x and the old state."""
    gates = add_bias(x @ kernel, bias).astype(jnp.float32)
    reset, candidate, update = jnp.split(gates, 3, axis=-1)
    candidate = jnp.tanh(nn.sigmoid(reset) * candidate)
    update = nn.sigmoid(update - 1)
    return update * candidate + (1 - update) * state


class RSSM(nn.Module):
    """Recurrence, prior and posterior. Its methods take any number of rows N."""

    config: RSSMConfig
    embedding: int
    action: int
    dtype: Any = jnp.float32

    def setup(self) -> None:
        c = self.config
        block = c.deter // c.blocks
        self.deter_in = Block(c.hidden, self.dtype)
        self.stoch_in = Block(c.hidden, self.dtype)
        self.action_in = Block(c.hidden, self.dtype)
        # A block's linear layer reads its own D / blocks of the state and all three inputs. The two shares are kept
        # apart: the second is one dense product. As in DreamerV3, the fan in of a block-linear layer counts the inputs
        # of all blocks.
        std = (1 / (c.blocks * (block + 3 * c.hidden))) ** 0.5
        init = initializers.truncated_normal(std / 0.87962566103423978)
        self.state_kernel = self.param("state_kernel", init, (c.blocks, block, block), jnp.float32)
        self.input_kernel = self.param("input_kernel", init, (3 * c.hidden, c.deter), jnp.float32)
        self.hidden_bias = self.param("hidden_bias", initializers.zeros_init(), (c.deter,), jnp.float32)
        self.hidden_norm = RMSNorm()
        self.gate_kernel = self.param("gate_kernel", kernel_init(), (c.blocks, block, 3 * block), jnp.float32)
        self.gate_bias = self.param("gate_bias", initializers.zeros_init(), (c.blocks, 3 * block), jnp.float32)
        self.posterior_kernel = self.param(
            "posterior_kernel", kernel_init(), (c.deter + self.embedding, c.hidden), jnp.float32
        )
        self.posterior_bias = self.param("posterior_bias", initializers.zeros_init(), (c.hidden,), jnp.float32)
        self.posterior_norm = RMSNorm()
        self.posterior_out = Linear(c.stoch * c.classes, dtype=self.dtype)
        self.prior_mlp = MLP(c.prior_layers, c.hidden, self.dtype)
        self.prior_out = Linear(c.stoch * c.classes, dtype=self.dtype)

    def __call__(self, latent: Latent, embedding: Array, prev_action: Array) -> tuple[Array, Array]:
        """One step, for initialisation: prior and posterior logits."""
        deter = self.recur(latent, self.embed_action(prev_action))
        return self.prior(deter), self.posterior(deter, self.embed_observation(embedding))

    def embed_action(self, prev_action: Array) -> Array:
        """The previous action's input to the recurrence: ``[..., A]`` to ``[..., hidden]``; divided by max(1, |a|)."""
        size = jnp.maximum(jax.lax.stop_gradient(jnp.abs(prev_action)), 1.0)
        return self.action_in(prev_action / size)

    def embed_observation(self, embedding: Array) -> Array:
        """The embedding's share of the posterior's first layer: ``[..., E]`` to ``[..., hidden]``."""
        product = embedding.astype(self.dtype) @ self.posterior_kernel[self.config.deter :].astype(self.dtype)
        return add_bias(product, self.posterior_bias)

    def recur(self, latent: Latent, action_in: Array) -> Array:
        """``h_t`` float32 [N, D] from the previous latent [N, ...] and ``embed_action(a_{t-1}) [N, hidden]``."""
        c, dtype = self.config, self.dtype
        flat = latent.stoch.reshape(latent.stoch.shape[0], -1)
        inputs = jnp.concatenate([self.deter_in(latent.deter), self.stoch_in(flat), action_in], axis=-1)
        state = latent.deter.reshape(-1, c.blocks, c.deter // c.blocks)
        own = block_linear(state.astype(dtype), self.state_kernel.astype(dtype))
        x = add_bias(own.reshape(-1, c.deter) + inputs @ self.input_kernel.astype(dtype), self.hidden_bias)
        x = nn.silu(self.hidden_norm(x)).reshape(state.shape)
        return per_block(_gate, (x, state), (self.gate_kernel.astype(dtype), self.gate_bias)).reshape(-1, c.deter)

    def prior(self, deter: Array) -> Array:
        """Logits of ``p(z_t | h_t)``: ``[..., D]`` to float32 ``[..., S, K]``, not yet mixed with the uniform."""
        return self._logits(self.prior_out(self.prior_mlp(deter)))

    def posterior(self, deter: Array, observation_in: Array) -> Array:
        """Logits of ``q(z_t | h_t, e_t)`` from h_t and ``embed_observation(e_t)``: float32 [..., S, K], not mixed."""
        product = deter.astype(self.dtype) @ self.posterior_kernel[: self.config.deter].astype(self.dtype)
        return self._logits(self.posterior_out(nn.silu(self.posterior_norm(product + observation_in))))

    def sample(self, uniform: Array, logits: Array) -> Array:
        """Straight-through one-hot sample [..., S, K] of logits mixed with ``unimix`` of the uniform distribution."""
        return sample_onehot(uniform, unimix_logits(logits, self.config.unimix))

    def _logits(self, x: Array) -> Array:
        return x.reshape(*x.shape[:-1], self.config.stoch, self.config.classes).astype(jnp.float32)

    def observe_step(
        self, latent: Latent, observation_in: Array, action_in: Array, is_first: Array, uniform: Array
    ) -> tuple[Latent, Array]:
        """One step of the posterior for N rows: the latent and the posterior's logits.

        ``action_in`` must already come from a zero action where ``is_first``; the carry is zeroed here.
        """
        latent = jax.tree.map(lambda x: mask_first(x, is_first), latent)
        deter = self.recur(latent, action_in)
        logits = self.posterior(deter, observation_in)
        return Latent(deter, self.sample(uniform, logits)), logits

    def imagine_step(self, latent: Latent, action: Array, uniform: Array) -> Latent:
        """One step of the prior: the latent after ``action [N, A]``, with ``uniform [N, S]``."""
        deter = self.recur(latent, self.embed_action(action))
        return Latent(deter, self.sample(uniform, self.prior(deter)))


def observe(
    rssm: RSSM, params: Any, uniform: Array, context: Latent, embedding: Array, prev_action: Array, is_first: Array
) -> tuple[Latent, Array]:
    """Posterior latents [B, T, ...] and logits [B, T, S, K] along sequences.

    ``context`` [B, ...] is the latent before the first step, ``embedding`` [B, T, E], ``prev_action`` [B, T, A],
    ``is_first`` [B, T]. The latents are drawn by ``uniform`` [B, T, S], numbers in [0, 1).
    """

    def call(method: Any, *args: Any) -> Any:
        return rssm.apply({"params": params}, *args, method=method)

    time_major = lambda x: jnp.swapaxes(x, 0, 1)
    observation_in = call(RSSM.embed_observation, embedding)
    action_in = call(RSSM.embed_action, mask_first(prev_action, is_first))

    def step(latent: Latent, inputs: tuple[Array, ...]) -> tuple[Latent, tuple[Latent, Array]]:
        latent, logits = call(RSSM.observe_step, latent, *inputs)
        return latent, (latent, logits)

    inputs = jax.tree.map(time_major, (observation_in, action_in, is_first, uniform))
    _, outputs = jax.lax.scan(keeping_products(step), context, inputs)
    return jax.tree.map(time_major, outputs)
