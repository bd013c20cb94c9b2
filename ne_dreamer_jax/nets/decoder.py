"""Latent states to observations: DreamerV3's decoder, the mirror image of the encoder."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.linen import initializers

from ne_dreamer_jax.nets import conv
from ne_dreamer_jax.nets.blocks import MLP, Block, Linear, RMSNorm, add_bias, block_linear, kernel_init
from ne_dreamer_jax.nets.encoder import EncoderConfig, split_observation
from ne_dreamer_jax.nets.pixels import depth_to_space
from ne_dreamer_jax.nets.rssm import feature
from ne_dreamer_jax.types import Array, ArraySpec, Latent


def spread_blocks(x: Array, height: int, width: int) -> Array:
    """``[N, G, height * width * C]`` to ``[N, height, width, G * C]``: each block fills C channels of its own."""
    N, G = x.shape[:2]
    return x.reshape(N, G, height, width, -1).transpose(0, 2, 3, 1, 4).reshape(N, height, width, -1)


class Decoder(nn.Module):
    """Images from a block-linear map of h_t plus a two-layer path from z_t, upsampled by 5x5 convolutions; vectors by a
    multilayer perceptron on the feature.

    Channels, widths and layers are the encoder's. A stage is nearest upsampling by two, a convolution (stride 1, same
    padding, bias), RMSNorm over channels and SiLU; the last has a sigmoid instead of norm and SiLU, and is a linear map
    to patches of pixels where the encoder's first stage is one of patches.
    """

    config: EncoderConfig  # of the encoder that is mirrored
    observation: Mapping[str, ArraySpec]
    blocks: int = 8  # of the block-linear map
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, latent: Latent) -> dict[str, Array]:
        """Latents with any leading axes ``[...]`` to float32 predictions by name.

        Images are ``[..., H, W, C]`` in the unit interval, vectors ``[..., n]`` on the symlog scale, n being 1 for a
        scalar.
        """
        images, vectors = split_observation(self.observation)
        lead = latent.deter.shape[:-1]
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(lead) :]), latent)
        outputs: dict[str, Array] = {}
        if images:
            channels = [self.observation[name].shape[2] for name in images]
            decoded = jnp.split(self._images(flat, sum(channels)), np.cumsum(channels[:-1]), axis=-1)
            outputs |= dict(zip(images, decoded, strict=True))
        if vectors:
            sizes = [int(np.prod(self.observation[name].shape)) for name in vectors]
            x = MLP(self.config.layers, self.config.units, self.dtype, name="mlp")(feature(flat))
            x = Linear(sum(sizes), dtype=self.dtype, name="vectors")(x)
            outputs |= dict(zip(vectors, jnp.split(x, np.cumsum(sizes[:-1]), axis=-1), strict=True))
        return {name: x.reshape(*lead, *x.shape[1:]).astype(jnp.float32) for name, x in outputs.items()}

    def _images(self, latent: Latent, channels: int) -> Array:
        c, dtype = self.config, self.dtype
        images, _ = split_observation(self.observation)
        depths = [c.depth * multiplier for multiplier in c.multipliers]
        height, width = (side // c.factor for side in self.observation[images[0]].shape[:2])
        x = self._from_deter(latent.deter, height, width, depths[-1])
        hidden = Block(2 * c.units, dtype, name="stoch_in")(latent.stoch.reshape(latent.stoch.shape[0], -1))
        x = x + Linear(height * width * depths[-1], dtype=dtype, name="stoch_out")(hidden).reshape(x.shape)
        x = nn.silu(RMSNorm(name="norm")(x))
        for i, depth in reversed(list(enumerate(depths[:-1]))):
            x = nn.silu(RMSNorm(name=f"stage{i + 1}_norm")(self._upsampled(x, f"stage{i + 1}", depth)))
        if c.patch is None:
            return nn.sigmoid(self._upsampled(x, "stage0", channels))
        return nn.sigmoid(depth_to_space(Linear(c.patch**2 * channels, dtype=dtype, name="stage0")(x), c.patch))

    def _from_deter(self, deter: Array, height: int, width: int, channels: int) -> Array:
        """``[N, D]`` to ``[N, height, width, channels]``."""
        blocks, size = self.blocks, deter.shape[-1]
        if size % blocks or channels % blocks:
            raise ValueError(
                f"objective.blocks: expected a divisor of rssm.deter {size} and of the encoder's last {channels} "
                f"channels (encoder.depth times its last multiplier), got {blocks}."
            )
        outputs = height * width * channels // blocks
        kernel = self.param("deter_kernel", kernel_init(), (blocks, size // blocks, outputs), jnp.float32)
        bias = self.param("deter_bias", initializers.zeros_init(), (blocks, outputs), jnp.float32)
        x = block_linear(deter.reshape(-1, blocks, size // blocks).astype(self.dtype), kernel.astype(self.dtype))
        return spread_blocks(add_bias(x, bias), height, width)

    def _upsampled(self, x: Array, name: str, channels: int) -> Array:
        side = self.config.kernel
        kernel = self.param(f"{name}_kernel", kernel_init(), (side, side, x.shape[-1], channels), jnp.float32)
        bias = self.param(f"{name}_bias", initializers.zeros_init(), (channels,), jnp.float32)
        return add_bias(conv.upsampled_conv2d(x, kernel.astype(self.dtype)), bias)
