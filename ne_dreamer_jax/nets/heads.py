"""Heads on features: reward, continue, value and policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from ne_dreamer_jax.losses import unimix_logits
from ne_dreamer_jax.nets.blocks import MLP, Linear, kernel_init
from ne_dreamer_jax.nets.rssm import sample_onehot
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import Depth, NonNegative, Positive, Range, Share, Width
from ne_dreamer_jax.types import ActionSpec, Array, DiscreteAction


@dataclass(frozen=True)
class HeadsConfig:
    """Sizes of the heads."""

    units: Width = 256
    """Width of all heads."""
    reward_layers: Depth = 1
    continue_layers: Depth = 1
    actor_layers: Depth = 3
    critic_layers: Depth = 3
    bins: Annotated[int, Range(2, 1_000_000)] = 255
    """Bins of the symexp-twohot distributions of reward and value."""
    actor_scale: NonNegative = 0.01
    """Scale of the policy's last layer at initialisation (reward and value start at zero, continue at one)."""
    min_std: Positive = 0.1
    """Least standard deviation of the bounded normal policy."""
    max_std: Positive = 1.0
    """Greatest standard deviation of the bounded normal policy."""
    unimix: Share = 0.01
    """Share of the uniform distribution in a discrete policy."""
    clip_actions: bool = True
    """Whether continuous actions are clipped to their bounds where they enter replay or a model (an environment clips
    them itself). The released code doesn't: its recurrence divides by max(1, |a|), its predictor sees them as drawn."""

    def __post_init__(self) -> None:
        ranges.check(self)
        if self.min_std > self.max_std:
            raise ValueError(f"heads: expected min_std of at most max_std, got {self.min_std} and {self.max_std}.")


class Head(nn.Module):
    """Blocks and a last linear layer: ``[..., F]`` to float32 ``[..., outputs]``."""

    layers: int
    units: int
    outputs: int
    scale: float
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, feature: Array) -> Array:
        x = MLP(self.layers, self.units, self.dtype, name="mlp")(feature)
        out = Linear(self.outputs, kernel_init=kernel_init(self.scale), dtype=self.dtype, name="out")
        return out(x).astype(jnp.float32)


def reward_head(c: HeadsConfig, dtype: Any) -> Head:
    """Logits over the twohot bins of r_t, the reward received on arrival at the state."""
    return Head(c.reward_layers, c.units, c.bins, 0.0, dtype)


def continue_head(c: HeadsConfig, dtype: Any) -> Head:
    """The logit [..., 1] of continuing from the state."""
    return Head(c.continue_layers, c.units, 1, 1.0, dtype)


def critic_head(c: HeadsConfig, dtype: Any) -> Head:
    """Logits over the twohot bins of the value."""
    return Head(c.critic_layers, c.units, c.bins, 0.0, dtype)


def actor_head(c: HeadsConfig, action: ActionSpec, dtype: Any) -> Head:
    """The policy's parameters [..., outputs], read by `policy`."""
    outputs = action.size if isinstance(action, DiscreteAction) else 2 * action.size
    return Head(c.actor_layers, c.units, outputs, c.actor_scale, dtype)


@dataclass(frozen=True)
class BoundedNormal:
    """Independent normals whose mean lies in [-1, 1]; samples may lie outside and are clipped where they are used.

    ``mean``, ``std``: float32 [..., A].
    """

    mean: Array
    std: Array

    def sample(self, key: Array) -> Array:
        """Raw, reparametrised sample [..., A]."""
        return self.from_noise(jax.random.normal(key, self.mean.shape))

    def from_noise(self, noise: Array) -> Array:
        """The sample that `policy_noise` [..., A] makes."""
        return self.mean + self.std * noise

    def mode(self) -> Array:
        """The mean [..., A]."""
        return self.mean

    def log_prob(self, action: Array) -> Array:
        """Log-density [...] of the raw sample ``action [..., A]``, summed over A."""
        z = (action - self.mean) / self.std
        return jnp.sum(-0.5 * jnp.square(z) - jnp.log(self.std) - 0.5 * jnp.log(2 * jnp.pi), axis=-1)

    def entropy(self) -> Array:
        """Differential entropy [...] in nats, summed over A."""
        return jnp.sum(jnp.log(self.std) + 0.5 * (1 + jnp.log(2 * jnp.pi)), axis=-1)


@dataclass(frozen=True)
class Categorical:
    """One-hot actions; ``logits``: float32 [..., A], already mixed with the uniform distribution."""

    logits: Array

    def sample(self, key: Array) -> Array:
        """One-hot sample [..., A] with the straight-through gradient of the probabilities."""
        return self.from_noise(jax.random.uniform(key, self.logits.shape[:-1]))

    def from_noise(self, noise: Array) -> Array:
        """The sample that `policy_noise` [...] makes."""
        return sample_onehot(noise, self.logits)

    def mode(self) -> Array:
        """One-hot of the likeliest action [..., A]."""
        return jax.nn.one_hot(jnp.argmax(self.logits, axis=-1), self.logits.shape[-1])

    def log_prob(self, action: Array) -> Array:
        """Log-probability [...] of the one-hot ``action [..., A]``."""
        return jnp.sum(jax.nn.log_softmax(self.logits, axis=-1) * action, axis=-1)

    def entropy(self) -> Array:
        """Entropy [...] in nats."""
        log_probs = jax.nn.log_softmax(self.logits, axis=-1)
        return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)


def policy(config: HeadsConfig, action: ActionSpec, outputs: Array) -> BoundedNormal | Categorical:
    """The policy of ``actor_head``'s outputs: Normal(tanh(m), min + (max - min) * sigmoid(s + 2)), or categorical."""
    if isinstance(action, DiscreteAction):
        return Categorical(unimix_logits(outputs, config.unimix))
    mean, std = jnp.split(outputs, 2, axis=-1)
    return BoundedNormal(jnp.tanh(mean), config.min_std + (config.max_std - config.min_std) * jax.nn.sigmoid(std + 2.0))


def squared_means(action: ActionSpec, outputs: Array) -> Array:
    """Squares [...] of the normals' means before their tanh, summed over A; zeros where actions are discrete.

    ``outputs`` [..., 2A] (or [..., A] where discrete) are the actor head's.
    """
    if isinstance(action, DiscreteAction):
        return jnp.zeros(outputs.shape[:-1], outputs.dtype)
    return jnp.sum(jnp.square(outputs[..., : action.size]), axis=-1)


def policy_noise(action: ActionSpec, key: Array, shape: tuple[int, ...]) -> Array:
    """What samples of policies of this shape are made of: normal [*shape, A], or uniform [*shape] where discrete."""
    if isinstance(action, DiscreteAction):
        return jax.random.uniform(key, shape)
    return jax.random.normal(key, (*shape, action.size))


def model_action(action: ActionSpec, raw: Array, clip: bool = True) -> Array:
    """An action as the models see it, float32 [..., A]: a raw sample clipped to the bounds, or a one-hot as it is.

    The gradient passes the clipping unchanged.
    """
    if isinstance(action, DiscreteAction) or not clip:
        return raw
    return jax.lax.stop_gradient(jnp.clip(raw, -1.0, 1.0)) + (raw - jax.lax.stop_gradient(raw))


def encode_action(action: ActionSpec, env_action: Array, clip: bool = True) -> Array:
    """An action as the environment takes it to float32 [..., A], as the models see it."""
    if isinstance(action, DiscreteAction):
        return jax.nn.one_hot(env_action, action.size)
    return jnp.clip(env_action, -1.0, 1.0) if clip else env_action


def decode_action(action: ActionSpec, model: Array, clip: bool = True) -> Array:
    """The inverse of `encode_action`: what the environment takes."""
    if isinstance(action, DiscreteAction):
        return jnp.argmax(model, axis=-1).astype(jnp.int32)
    return jnp.clip(model, -1.0, 1.0) if clip else model
