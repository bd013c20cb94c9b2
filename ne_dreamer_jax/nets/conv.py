"""Convolutions of the image encoder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.nets.blocks import rms_norm
from ne_dreamer_jax.types import Array


class Stage(NamedTuple):
    """Parameters of one stage."""

    kernel: Array  # float32 [k, k, C_in, C_out]
    bias: Array  # float32 [C_out]
    scale: Array  # float32 [C_out], of the RMSNorm


def encode_images(images: Array, stages: Sequence[Stage], dtype: Any = jnp.float32) -> Array:
    """uint8 ``[N, H, W, C]`` through all stages to ``[N, H / 2**n, W / 2**n, C_out]``."""
    x = (images.astype(jnp.float32) / 255 - 0.5).astype(dtype)
    for stage in stages:
        x = jax.lax.conv_general_dilated(
            x, stage.kernel.astype(dtype), (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        x = x + stage.bias.astype(dtype)[None, None, None]
        n, h, w, c = x.shape
        x = jnp.max(x.reshape(n, h // 2, 2, w // 2, 2, c), axis=(2, 4))
        x = jax.nn.silu(rms_norm(x, stage.scale))
    return x
