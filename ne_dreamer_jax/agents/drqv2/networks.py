"""DrQ-v2's encoder, actor and critics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from flax.linen import initializers

from ne_dreamer_jax.agents.drqv2.config import DrQv2Config
from ne_dreamer_jax.nets.conv import conv2d
from ne_dreamer_jax.nets.encoder import split_observation
from ne_dreamer_jax.nets.pixels import centred, space_to_depth
from ne_dreamer_jax.types import Array, ContinuousAction, EnvSpec, Params

LAYER_NORM_EPSILON = 1e-5
SMALLEST_IMAGE = 15  # what four 3x3 convolutions, the first of stride 2, leave a pixel of


class Encoder(nn.Module):
    """Four 3x3 convolutions without padding, the first of stride 2, each with a ReLU; vectors go by as they are.

    Stacked observations ``[N, S, ...]`` by name to ``[N, R]``; the frames of a stack become channels, oldest first.
    """

    channels: int

    @nn.compact
    def __call__(self, stacked: Mapping[str, Array]) -> Array:
        values = [x for _, x in sorted(stacked.items())]
        images = [x for x in values if x.dtype == jnp.uint8]
        parts = [x.reshape(x.shape[0], -1) for x in values if x.dtype != jnp.uint8]
        if images:
            x = jnp.moveaxis(jnp.concatenate(images, axis=-1), 1, -2)
            x = centred(space_to_depth(x.reshape(*x.shape[:3], -1), 2))
            for i in range(4):
                channels = x.shape[-1] if i else x.shape[-1] // 4
                shape = (3, 3, channels, self.channels)
                kernel = self.param(f"conv{i}_kernel", initializers.orthogonal(2**0.5), shape, jnp.float32)
                bias = self.param(f"conv{i}_bias", initializers.zeros_init(), shape[-1:], jnp.float32)
                x = conv2d(x, kernel)[:, 1:-1, 1:-1] if i else conv2d(x, stride_two(kernel))[:, :-1, :-1]
                x = nn.relu(x + bias[None, None, None])
            parts.append(x.reshape(x.shape[0], -1))
        return jnp.concatenate(parts, axis=-1)


def stride_two(kernel: Array) -> Array:
    """The 2x2 kernel ``[2, 2, 4 * C, O]`` on `space_to_depth` that is a 3x3 kernel ``[3, 3, C, O]`` of stride 2."""
    C, O = kernel.shape[2:]
    kernel = jnp.pad(kernel, ((0, 1), (0, 1), (0, 0), (0, 0))).reshape(2, 2, 2, 2, C, O)
    return kernel.transpose(0, 2, 1, 3, 4, 5).reshape(2, 2, 4 * C, O)


def _dense(units: int, name: str) -> nn.Dense:
    return nn.Dense(units, kernel_init=initializers.orthogonal(), name=name)


class Actor(nn.Module):
    """Encodings ``[N, R]`` to the policy's means ``[N, A]`` in (-1, 1)."""

    features: int
    units: int
    actions: int

    @nn.compact
    def __call__(self, encoding: Array) -> Array:
        h = _dense(self.features, "trunk")(encoding)
        x = jnp.tanh(nn.LayerNorm(LAYER_NORM_EPSILON, name="norm")(h))
        for i in range(2):
            x = nn.relu(_dense(self.units, f"hidden{i}")(x))
        return jnp.tanh(_dense(self.actions, "mean")(x))


class Critic(nn.Module):
    """Encodings ``[N, R]`` and actions ``[N, A]`` to two values ``[N, 2]``, on one trunk."""

    features: int
    units: int

    @nn.compact
    def __call__(self, encoding: Array, action: Array) -> Array:
        h = _dense(self.features, "trunk")(encoding)
        h = jnp.tanh(nn.LayerNorm(LAYER_NORM_EPSILON, name="norm")(h))
        values = []
        for q in range(2):
            x = jnp.concatenate([h, action], axis=-1)
            for i in range(2):
                x = nn.relu(_dense(self.units, f"q{q}_hidden{i}")(x))
            values.append(_dense(1, f"q{q}_value")(x))
        return jnp.concatenate(values, axis=-1)


@dataclass(frozen=True)
class Networks:
    """The three networks for environments of ``spec``."""

    spec: EnvSpec
    encoder: Encoder
    actor: Actor
    critic: Critic
    stack: int

    @staticmethod
    def build(config: DrQv2Config, spec: EnvSpec) -> Networks:
        """Raises ValueError for discrete actions and for observations that the encoder can't take."""
        if not isinstance(spec.action, ContinuousAction):
            raise ValueError(
                f"drqv2: expected continuous actions, got {spec.action}. Its policy gradient goes through the action; "
                "use a world-model method."
            )
        images, _ = split_observation(spec.observation)
        sides = {spec.observation[name].shape[:2] for name in images}
        if len(sides) > 1 or any(side < SMALLEST_IMAGE for size in sides for side in size):
            raise ValueError(
                f"drqv2: expected images of one common height and width, each at least {SMALLEST_IMAGE}, got "
                f"{ {name: list(spec.observation[name].shape) for name in images} }. Resize them in the environment."
            )
        actor = Actor(config.features, config.units, spec.action.size)
        critic = Critic(config.features, config.units)
        return Networks(spec, Encoder(config.channels), actor, critic, config.frame_stack)

    def init(self, keys: Array) -> dict[str, Params]:
        """Parameters by network, from three typed keys ``[3]``."""
        stacked = {
            name: jnp.zeros((1, self.stack, *spec.shape), spec.dtype) for name, spec in self.spec.observation.items()
        }
        encoder: Any = self.encoder.init(keys[0], stacked).get("params", {})  # there are none where all is vectors
        encoding = self.encode(encoder, stacked)
        action = jnp.zeros((1, *self.spec.action.shape))
        return {
            "encoder": encoder,
            "actor": self.actor.init(keys[1], encoding)["params"],
            "critic": self.critic.init(keys[2], encoding, action)["params"],
        }

    def encode(self, params: Params, stacked: Mapping[str, Array]) -> Array:
        """Stacked observations ``[N, S, ...]`` to encodings ``[N, R]``."""
        return self.encoder.apply({"params": params}, stacked)  # type: ignore[return-value]

    def mean(self, params: Params, encoding: Array) -> Array:
        """The policy's means ``[N, A]``."""
        return self.actor.apply({"params": params}, encoding)  # type: ignore[return-value]

    def values(self, params: Params, encoding: Array, action: Array) -> Array:
        """Both critics' values ``[N, 2]``."""
        return self.critic.apply({"params": params}, encoding, action)  # type: ignore[return-value]
