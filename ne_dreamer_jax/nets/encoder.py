"""Observations to embeddings: ``e_t = f_enc(x_t)``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import flax.linen as nn
import jax.numpy as jnp
from flax.linen import initializers

from ne_dreamer_jax.losses import symlog
from ne_dreamer_jax.nets import conv
from ne_dreamer_jax.nets.blocks import MLP, kernel_init
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import Range, Width
from ne_dreamer_jax.types import Array, ArraySpec


@dataclass(frozen=True)
class EncoderConfig:
    """Sizes of the encoder."""

    depth: Width = 16
    """Channels of a stage are depth times its multiplier."""
    multipliers: tuple[Width, ...] = (2, 3, 4, 4)
    """Channel multipliers, one for each stage. A stage is a convolution that halves the sides; with `patch`, the first
    one embeds patches instead."""
    kernel: Annotated[int, Range(1, 1_000)] = 5
    """Side of the convolution kernels (but for that of patches)."""
    patch: Annotated[int, Range(2, 4_096)] | None = None
    """Side p of the patches. The first stage is then a convolution with a p x p kernel, stride p and no pooling, and
    the decoder's last layer predicts p x p patches. DreamerV3 has no such stage. None: all stages are alike."""
    layers: Annotated[int, Range(1, 1_000)] = 3
    """Layers of the multilayer perceptron for vectors."""
    units: Width = 256
    """Width of the multilayer perceptron for vectors, and its share of the embedding."""

    def __post_init__(self) -> None:
        ranges.check(self)
        if not self.multipliers:
            raise ValueError("encoder.multipliers: expected one or more, got none.")

    @property
    def factor(self) -> int:
        """By which an image's sides are divided."""
        stages = len(self.multipliers)
        return 2**stages if self.patch is None else self.patch * 2 ** (stages - 1)


def split_observation(observation: Mapping[str, ArraySpec]) -> tuple[list[str], list[str]]:
    """Names of the images (uint8, rank 3) and of the vectors (float32, rank 0 or 1), each sorted.

    Raises ValueError for an array that is neither, and for no array at all.
    """
    images, vectors = [], []
    for name, spec in sorted(observation.items()):
        if len(spec.shape) == 3 and jnp.dtype(spec.dtype) == jnp.uint8:
            images.append(name)
        elif len(spec.shape) <= 1 and jnp.dtype(spec.dtype) == jnp.float32:
            vectors.append(name)
        else:
            raise ValueError(
                f"Observation {name!r}: expected a uint8 image [height, width, channels] or a float32 vector of rank "
                f"0 or 1, got {jnp.dtype(spec.dtype).name} {list(spec.shape)}. Convert it in the environment."
            )
    if not images and not vectors:
        raise ValueError("Expected at least one observation, got none.")
    return images, vectors


def embedding_size(config: EncoderConfig, observation: Mapping[str, ArraySpec]) -> int:
    """E, the size of an embedding. Raises ValueError where an image's sides are not multiples of `config.factor`."""
    images, vectors = split_observation(observation)
    size = config.units if vectors else 0
    if images:
        shapes = {observation[name].shape[:2] for name in images}
        factor, found = config.factor, {name: list(observation[name].shape) for name in images}
        if len(shapes) > 1:
            raise ValueError(
                f"Images: expected one common height and width, got {found}. Resize them in the environment."
            )
        height, width = next(iter(shapes))
        if height % factor or width % factor:
            stages = len(config.multipliers)
            made_of = f"2**{stages}" if config.patch is None else f"{config.patch} * 2**{stages - 1}"
            raise ValueError(
                f"Images: expected a height and width that are multiples of {factor} = {made_of}, got {found}. Resize "
                "them in the environment, or change encoder.multipliers or encoder.patch."
            )
        size += (height // factor) * (width // factor) * config.depth * config.multipliers[-1]
    return size


class Encoder(nn.Module):
    """Convolution stages for images, a multilayer perceptron on symlog for vectors; the two concatenated.

    A stage is a convolution (stride 1, same padding, bias), 2x2 max-pool, RMSNorm over channels and SiLU; the first one
    may be of patches instead (`EncoderConfig.patch`).
    """

    config: EncoderConfig
    observation: Mapping[str, ArraySpec]
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, obs: Mapping[str, Array]) -> Array:
        """``obs`` with any leading axes ``[...]`` to float32 ``[..., E]``."""
        images, vectors = split_observation(self.observation)
        some = (images + vectors)[0]
        leading = obs[some].shape[: obs[some].ndim - len(self.observation[some].shape)]
        parts = []
        if images:
            x = jnp.concatenate([obs[name].reshape(-1, *self.observation[name].shape) for name in images], axis=-1)
            stages = self._stages(x.shape[-1])
            if self.config.patch is not None:
                x, stages = conv.embed_patches(x, stages[0], self.dtype), stages[1:]
            x = conv.encode_images(x, stages, self.dtype) if stages else x
            parts.append(x.reshape(*leading, -1))
        if vectors:
            flat = [obs[name].reshape(*leading, -1) for name in vectors]
            x = symlog(jnp.concatenate(flat, axis=-1))
            parts.append(MLP(self.config.layers, self.config.units, self.dtype, name="mlp")(x))
        return jnp.concatenate(parts, axis=-1).astype(jnp.float32)

    def _stages(self, channels: int) -> list[conv.Stage]:
        stages = []
        for i, multiplier in enumerate(self.config.multipliers):
            out = self.config.depth * multiplier
            patches = i == 0 and self.config.patch is not None
            side = self.config.patch if patches else self.config.kernel
            shape = (side, side, channels, out)
            stages.append(
                conv.Stage(
                    kernel=self.param(f"stage{i}_kernel", kernel_init(), shape, jnp.float32),
                    bias=self.param(f"stage{i}_bias", initializers.zeros_init(), (out,), jnp.float32),
                    scale=self.param(f"stage{i}_scale", initializers.ones_init(), (out,), jnp.float32),
                )
            )
            channels = out
        return stages
