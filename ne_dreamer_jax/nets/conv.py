"""Convolutions, lowered by platform.

On accelerators these are `lax.conv_general_dilated` and plain compositions around it. XLA's own convolutions are slow
on a CPU, their gradients most of all and in bfloat16 inside of loops (twenty times float32's). There the work goes to
`cpu.conv`: the same functions and gradients as matrix products over a few images at a time, in float32 whatever the
dtype. (Patches are one matrix product as they are, see `embed_patches`.)

On a mesh of CPU devices each takes its share of the images: the loop over chunks of a global array would otherwise run
whole on every device.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.nets.blocks import add_bias, rms_norm
from ne_dreamer_jax.nets.cpu import conv as cpu_conv
from ne_dreamer_jax.nets.cpu.conv import Stage as Stage
from ne_dreamer_jax.nets.pixels import centred, space_to_depth
from ne_dreamer_jax.nets.platform import on_cpu
from ne_dreamer_jax.system import parallel
from ne_dreamer_jax.types import Array


def conv2d(x: Array, kernel: Array) -> Array:
    """Convolution of stride 1 with SAME zero padding: x ``[N, H, W, C_in]``, kernel ``[k, k, C_in, C_out]``.

    Returns ``[N, H, W, C_out]`` in the dtype of ``x``, which is also that of the kernel. Differentiable once by reverse
    mode on a CPU, without limit elsewhere. Raises ValueError for shapes or dtypes that don't fit.
    """
    if x.ndim != 4 or kernel.ndim != 4 or x.shape[-1] != kernel.shape[2] or x.dtype != kernel.dtype:
        raise ValueError(
            f"Expected x [N, H, W, C_in] and kernel [k, k, C_in, C_out] of one dtype, got {x.dtype} {list(x.shape)} "
            f"and {kernel.dtype} {list(kernel.shape)}."
        )
    if on_cpu():
        convolve = parallel.per_shard(cpu_conv.conv2d, (parallel.SPLIT, parallel.WHOLE), parallel.SPLIT)
        return convolve(x.astype(jnp.float32), kernel.astype(jnp.float32)).astype(x.dtype)
    return lax_conv2d(x, kernel)


def lax_conv2d(x: Array, kernel: Array) -> Array:
    """`conv2d` as XLA has it."""
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


@functools.cache
def _phases(taps: int) -> np.ndarray:
    """``[2, m, taps]``: which taps of a kernel's side fall on the same input, for even and for odd outputs.

    The m inputs are those around the one below the output, as a kernel of side m with SAME padding has them.
    """
    before = (taps - 1) // 2
    first, last = -before // 2, (taps - before) // 2
    table = np.zeros((2, last - first + 1, taps), np.float32)
    for phase, tap in np.ndindex(2, taps):
        table[phase, (phase + tap - before) // 2 - first, tap] = 1.0
    return table


def upsampled_conv2d(x: Array, kernel: Array) -> Array:
    """`conv2d` of x after nearest upsampling by two: ``[N, H, W, C_in]`` to ``[N, 2 * H, 2 * W, C_out]``.

    Taps of the kernel ``[k, k, C_in, C_out]`` that fall on the same pixel of x are summed first: the four outputs above
    a pixel are one convolution of x with 4 * C_out channels. For 5x5 that is 3x3, 36 products where the definition has
    100. Raises ValueError as `conv2d`.
    """
    N, H, W, _ = x.shape
    table, C_out = _phases(kernel.shape[0]), kernel.shape[3]
    weights = kernel.astype(jnp.float32)
    u = jnp.einsum("pai,qbj,ijco->abcpqo", table, table, weights, precision=jax.lax.Precision.HIGHEST)
    y = conv2d(x, u.reshape(table.shape[1], table.shape[1], kernel.shape[2], 4 * C_out).astype(kernel.dtype))
    return y.reshape(N, H, W, 2, 2, C_out).transpose(0, 1, 3, 2, 4, 5).reshape(N, 2 * H, 2 * W, C_out)


def encode_images(images: Array, stages: Sequence[Stage], dtype: Any = jnp.float32) -> Array:
    """The image encoder: ``[N, H, W, C]`` to ``[N, H / 2**n, W / 2**n, C_out]`` of ``dtype`` through n stages.

    uint8 images become ``image / 255 - 0.5``; images of a floating dtype are taken as they are, and can be
    differentiated for. A stage is a convolution (stride 1, SAME, bias), a 2x2 max-pool, an RMSNorm over channels in
    float32 and SiLU; products are computed in ``dtype``, on a CPU in float32. The gradient of a maximum that several
    outputs share goes to the first of them on a CPU, and is divided among them elsewhere. Raises ValueError where the
    sides can't be halved once a stage.
    """
    factor = 2 ** len(stages)
    if images.ndim != 4 or any(side % factor for side in images.shape[1:3]):
        raise ValueError(
            f"Expected images [N, H, W, C] with H and W multiples of {factor}, for {len(stages)} stages that halve "
            f"them, got {list(images.shape)}. Resize the images or use fewer stages."
        )
    if on_cpu() and all(cpu_conv.encodes(stage.kernel) for stage in stages):
        encode = parallel.per_shard(cpu_conv.encode_images, (parallel.SPLIT, parallel.WHOLE), parallel.SPLIT)
        pixels = images if images.dtype == jnp.uint8 else images.astype(jnp.float32)
        return encode(pixels, stages).astype(dtype)
    return lax_encode_images(images, stages, dtype)


def embed_patches(images: Array, stage: Stage, dtype: Any = jnp.float32) -> Array:
    """Each p x p patch of pixels to a vector: ``[N, H, W, C]`` to ``[N, H / p, W / p, C_out]`` of ``dtype``.

    A convolution of stride p with the stage's kernel ``[p, p, C, C_out]`` and bias, an RMSNorm over channels in float32
    and SiLU: one matrix product, in ``dtype`` on every platform. Images as `encode_images` takes them. Raises
    ValueError for images and kernels that don't fit, and where p does not divide the sides.
    """
    kernel, shapes = stage.kernel, f"got {list(images.shape)} and {list(stage.kernel.shape)}"
    p = kernel.shape[0]
    if images.ndim != 4 or kernel.ndim != 4 or kernel.shape[1:3] != (p, images.shape[-1]):
        raise ValueError(f"Expected images [N, H, W, C] and a kernel [p, p, C, C_out], {shapes}.")
    if any(side % p for side in images.shape[1:3]):
        raise ValueError(f"Expected images whose sides are multiples of {p}, the kernel's, {shapes}.")
    x = space_to_depth(centred(images).astype(dtype), p)
    x = add_bias(x @ kernel.reshape(-1, kernel.shape[-1]).astype(dtype), stage.bias)
    return jax.nn.silu(rms_norm(x, stage.scale))


def lax_encode_images(images: Array, stages: Sequence[Stage], dtype: Any = jnp.float32) -> Array:
    """`encode_images` as a composition of XLA's own operations."""
    x = centred(images).astype(dtype)
    for stage in stages:
        x = _pool(add_bias(lax_conv2d(x, stage.kernel.astype(dtype)), stage.bias))
        x = jax.nn.silu(rms_norm(x, stage.scale))
    return x


def _pool(x: Array) -> Array:
    """2x2 max-pool of ``[N, H, W, C]`` as pairwise maxima, whose gradient is elementwise."""
    x = jnp.maximum(x[:, ::2], x[:, 1::2])
    return jnp.maximum(x[:, :, ::2], x[:, :, 1::2])
