"""Convolutions and the image encoder for a CPU: matrix products over a few images at a time, with their own gradients.

Everything between a chunk of images and its result stays in the cache, so that elementwise work costs little beside the
products. Inside a chunk of n images arrays are ``[H, W, n, C]``. A 5x5 convolution goes through Winograd's transform
(`winograd`); where channels are few, so that the transforms would cost more than they save, a stage of the encoder
computes the 2x2 outputs that it pools together from their common 6x6 inputs instead (`_Phases`).

The gradients are reverse mode, first order. A stage keeps its pooled output before the norm and which of the four
outputs was the maximum; everything else is computed again.
"""

from __future__ import annotations

import functools
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.nets import winograd
from ne_dreamer_jax.nets.blocks import NORM_EPSILON
from ne_dreamer_jax.types import Array

_CHUNK = 8  # images


def encodes(kernel: Array) -> bool:
    """Whether `encode_images` has a lowering for a stage with this kernel."""
    return kernel.shape[:2] == (5, 5)


class _Lowering(Protocol):
    """A 5x5 convolution followed by a 2x2 max-pool, on ``[H, W, n, C]``."""

    def prepare(self, kernel: Array) -> Array:
        """The kernel as the products need it, once for all chunks."""

    def prepare_adjoint(self, u: Array, shape: tuple[int, ...]) -> Array:
        """Gradient of the kernel, of the given shape, from that of `prepare`'s result."""

    def forward(self, x: Array, u: Array) -> tuple[Array, Array]:
        """``[H, W, n, C_in]`` to the pooled ``[H / 2, W / 2, n, C_out]`` and which of four was the maximum, uint8."""

    def backward(self, x: Array, u: Array, which: Array, g: Array) -> tuple[Array, Array]:
        """Gradients of x and u from that of the pooled output."""


def _maximum_of_four(y: list[Array]) -> tuple[Array, Array]:
    top = jnp.maximum(jnp.maximum(y[0], y[1]), jnp.maximum(y[2], y[3]))
    which = jnp.where(y[0] == top, 0, jnp.where(y[1] == top, 1, jnp.where(y[2] == top, 2, 3)))
    return top, which.astype(jnp.uint8)


class _Winograd:
    """Output tiles of 4x4 are pooled to 2x2 where they lie, before they are put back into rows."""

    @staticmethod
    def prepare(kernel: Array) -> Array:
        return winograd.transform_kernel(kernel)

    @staticmethod
    def prepare_adjoint(u: Array, shape: tuple[int, ...]) -> Array:
        return winograd.transform_kernel_adjoint(u)

    @staticmethod
    def forward(x: Array, u: Array) -> tuple[Array, Array]:
        H, W, n, _ = x.shape
        T, S = winograd.tiles(H), winograd.tiles(W)
        y = winograd.transform_output(winograd.product(winograd.transform_input(x), u))
        y = y.reshape(2, 2, 2, 2, S, T, n, -1)  # row of the pool, row in it, column of the pool, column in it
        pooled = _maximum_of_four([y[:, 0, :, 0], y[:, 0, :, 1], y[:, 1, :, 0], y[:, 1, :, 1]])
        return jax.tree.map(
            lambda z: z.transpose(3, 0, 2, 1, 4, 5).reshape(2 * T, 2 * S, n, -1)[: H // 2, : W // 2], pooled
        )

    @staticmethod
    def backward(x: Array, u: Array, which: Array, g: Array) -> tuple[Array, Array]:
        H, W, n, _ = x.shape
        T, S = winograd.tiles(H), winograd.tiles(W)

        def to_tiles(z: Array) -> Array:
            z = jnp.pad(z, ((0, 2 * T - H // 2), (0, 2 * S - W // 2), (0, 0), (0, 0)))
            return z.reshape(T, 2, S, 2, n, -1).transpose(1, 3, 2, 0, 4, 5)

        g, which = to_tiles(g), to_tiles(which)
        y = jnp.stack([jnp.where(which == k, g, 0.0) for k in range(4)])
        y = y.reshape(2, 2, 2, 2, S * T * n, -1).transpose(2, 0, 3, 1, 4, 5)
        d = winograd.transform_output_adjoint(y.reshape(16, S * T * n, -1))
        dv, du = winograd.product_adjoints(winograd.transform_input(x), u, d)
        return winograd.transform_input_adjoint(dv, x.shape), du


def _phase_table() -> np.ndarray:
    """``[3, 2, 2, 5]``: the tap that takes the input at phase p of block b - 1 to the output at phase q of block 0."""
    table = np.zeros((3, 2, 2, 5), np.float32)
    for block, p, q in np.ndindex(3, 2, 2):
        tap = 2 * (block - 1) + p - q + 2
        if 0 <= tap < 5:
            table[block, p, q, tap] = 1.0
    return table


class _Phases:
    """The convolution as one of 3x3 between blocks of 2x2 pixels: 1.44 times the arithmetic, in well-shaped products.

    A block of outputs is what the pool takes the maximum of.
    """

    table = _phase_table()

    @classmethod
    def prepare(cls, kernel: Array) -> Array:
        u = jnp.einsum("bpqi,defj,ijco->bdpecqfo", cls.table, cls.table, kernel)
        return u.reshape(36 * kernel.shape[2], 4 * kernel.shape[3])

    @classmethod
    def prepare_adjoint(cls, u: Array, shape: tuple[int, ...]) -> Array:
        u = u.reshape(3, 3, 2, 2, shape[2], 2, 2, shape[3])
        return jnp.einsum("bpqi,defj,bdpecqfo->ijco", cls.table, cls.table, u)

    @staticmethod
    def _patches(x: Array) -> Array:
        """``[H, W, n, C]`` to ``[H / 2, W / 2, n, 9 * 4 * C]``: each block with its eight neighbours."""
        H, W, n, C = x.shape
        x = x.reshape(H // 2, 2, W // 2, 2, n, C).transpose(0, 2, 4, 1, 3, 5).reshape(H // 2, W // 2, n, 4 * C)
        x = jnp.pad(x, ((1, 1), (1, 1), (0, 0), (0, 0)))
        return jnp.concatenate([x[i : i + H // 2, j : j + W // 2] for i in range(3) for j in range(3)], axis=-1)

    @classmethod
    def forward(cls, x: Array, u: Array) -> tuple[Array, Array]:
        patches = cls._patches(x)
        y = (patches.reshape(-1, u.shape[0]) @ u).reshape(*patches.shape[:3], 4, -1)
        return _maximum_of_four([y[..., k, :] for k in range(4)])

    @classmethod
    def backward(cls, x: Array, u: Array, which: Array, g: Array) -> tuple[Array, Array]:
        patches, adjoint = jax.vjp(cls._patches, x)
        y = jnp.stack([jnp.where(which == k, g, 0.0) for k in range(4)], axis=3).reshape(-1, u.shape[1])
        (dx,) = adjoint((y @ u.T).reshape(patches.shape))
        return dx, patches.reshape(-1, u.shape[0]).T @ y


def _lowering(kernel: Array) -> _Lowering:
    return _Phases if kernel.shape[2] <= 4 else _Winograd


def _norm_silu(x: Array, scale: Array) -> Array:
    """RMSNorm over channels and SiLU, ``[..., C]``."""
    inverse = jax.lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + NORM_EPSILON)
    return jax.nn.silu(x * inverse * scale[None, None, None])


def _norm_silu_backward(x: Array, scale: Array, g: Array) -> tuple[Array, Array]:
    """Gradients of x and scale from that of `_norm_silu`'s result."""
    inverse = jax.lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + NORM_EPSILON)
    unit = x * inverse
    scaled = unit * scale[None, None, None]
    gate = jax.nn.sigmoid(scaled)
    g = g * gate * (1.0 + scaled * (1.0 - gate))
    h = g * scale[None, None, None]
    return inverse * (h - unit * jnp.mean(h * unit, axis=-1, keepdims=True)), jnp.sum(g * unit, axis=(0, 1, 2))


def _chunk_images(images: Array) -> Array:
    """``[n, H, W, C]``, uint8 or float, to normalised ``[H, W, n, C]``."""
    images = images.transpose(1, 2, 0, 3)
    return images.astype(jnp.float32) / 255.0 - 0.5 if images.dtype == jnp.uint8 else images


def _encode_chunk(images: Array, prepared: list[tuple[Array, Array, Array]], lowerings: list[_Lowering]) -> Any:
    x, kept = _chunk_images(images), []
    for lowering, (u, bias, scale) in zip(lowerings, prepared, strict=True):
        pooled, which = lowering.forward(x, u)
        pooled = pooled + bias[None, None, None]
        kept.append((pooled, which))
        x = _norm_silu(pooled, scale)
    return x.transpose(2, 0, 1, 3), kept


def _encode_chunk_backward(
    images: Array, prepared: list[tuple[Array, Array, Array]], lowerings: list[_Lowering], kept: Any, g: Array
) -> Any:
    g, gradients = g.transpose(1, 2, 0, 3), []
    for i in reversed(range(len(prepared))):
        u, _, scale = prepared[i]
        pooled, which = kept[i]
        x = _norm_silu(kept[i - 1][0], prepared[i - 1][2]) if i else _chunk_images(images)
        g, dscale = _norm_silu_backward(pooled, scale, g)
        dbias = jnp.sum(g, axis=(0, 1, 2))
        g, du = lowerings[i].backward(x, u, which, g)
        gradients.append((du, dbias, dscale))
    return g.transpose(2, 0, 1, 3), gradients[::-1]


def _prepare(stages: Any) -> tuple[list[tuple[Array, Array, Array]], list[_Lowering]]:
    lowerings = [_lowering(kernel) for kernel, _, _ in stages]
    return [(way.prepare(k), bias, scale) for way, (k, bias, scale) in zip(lowerings, stages, strict=True)], lowerings


def _split(x: Array) -> Array:
    """``[N, ...]`` to ``[chunks, n, ...]``, padded with zeros by less than the number of chunks."""
    chunks = -(-x.shape[0] // _CHUNK)
    n = -(-x.shape[0] // chunks)
    x = jnp.pad(x, ((0, chunks * n - x.shape[0]), *((0, 0),) * (x.ndim - 1)))
    return x.reshape(chunks, n, *x.shape[1:])


def _join(x: Array, count: int) -> Array:
    return x.reshape(-1, *x.shape[2:])[:count]


@jax.custom_vjp
def encode_images(images: Array, stages: Any) -> Array:
    """`conv.encode_images` for kernels that `encodes` accepts, float32; uint8 images get no gradient."""
    return _encode_forward(images, stages)[0]


def _encode_forward(images: Array, stages: Any) -> tuple[Array, Any]:
    prepared, lowerings = _prepare(stages)
    y, kept = jax.lax.map(lambda chunk: _encode_chunk(chunk, prepared, lowerings), _split(images))
    return _join(y, images.shape[0]), (images, stages, kept)


def _encode_backward(residuals: Any, g: Array) -> Any:
    images, stages, kept = residuals
    prepared, lowerings = _prepare(stages)

    def body(total: Any, chunk: Any) -> Any:
        dx, gradients = _encode_chunk_backward(chunk[0], prepared, lowerings, chunk[1], chunk[2])
        return jax.tree.map(jnp.add, total, gradients), None if images.dtype == jnp.uint8 else dx

    zero = jax.tree.map(jnp.zeros_like, prepared)
    gradients, dimages = jax.lax.scan(body, zero, (_split(images), kept, _split(g)))
    dstages = tuple(
        type(stage)(way.prepare_adjoint(du, stage[0].shape), dbias, dscale)
        for way, stage, (du, dbias, dscale) in zip(lowerings, stages, gradients, strict=True)
    )
    return None if dimages is None else _join(dimages, images.shape[0]), dstages


encode_images.defvjp(_encode_forward, _encode_backward)


def _patches(x: Array, taps: int, before: int) -> Array:
    """``[n, H, W, C]`` to ``[n, H, W, taps * taps * C]``, zero-padded by ``before`` rows and columns on the near side."""
    _, H, W, _ = x.shape
    around = (before, taps - 1 - before)
    x = jnp.pad(x, ((0, 0), around, around, (0, 0)))
    return jnp.concatenate([x[:, i : i + H, j : j + W] for i in range(taps) for j in range(taps)], axis=-1)


def _flip(kernel: Array) -> Array:
    return jnp.flip(kernel, (0, 1)).swapaxes(2, 3)


def _winograd_suits(kernel: Array) -> bool:
    return kernel.shape[:2] == (5, 5) and kernel.shape[2] > 4


def _convolve(x: Array, kernel: Array, before: int) -> Array:
    """One chunk ``[n, H, W, C_in]`` to ``[n, H, W, C_out]``."""
    taps, _, _, C_out = kernel.shape
    n, H, W, _ = x.shape
    if not _winograd_suits(kernel):
        return _patches(x, taps, before) @ kernel.reshape(-1, C_out)
    T, S = winograd.tiles(H), winograd.tiles(W)
    v = winograd.transform_input(x.transpose(1, 2, 0, 3))
    y = winograd.transform_output(winograd.product(v, winograd.transform_kernel(kernel)))
    y = y.reshape(4, 4, S, T, n, C_out).transpose(4, 3, 0, 2, 1, 5)
    return y.reshape(n, 4 * T, 4 * S, C_out)[:, :H, :W]


def _convolve_backward(x: Array, kernel: Array, before: int, g: Array) -> tuple[Array, Array]:
    """One chunk's gradients of x and of the kernel."""
    taps, _, C_in, C_out = kernel.shape
    n, H, W, _ = x.shape
    if not _winograd_suits(kernel):
        dkernel = _patches(x, taps, before).reshape(-1, taps * taps * C_in).T @ g.reshape(-1, C_out)
        return _convolve(g, _flip(kernel), taps - 1 - before), dkernel.reshape(kernel.shape)
    T, S = winograd.tiles(H), winograd.tiles(W)
    g = jnp.pad(g, ((0, 0), (0, 4 * T - H), (0, 4 * S - W), (0, 0)))
    g = g.reshape(n, T, 4, S, 4, C_out).transpose(2, 4, 3, 1, 0, 5).reshape(16, S * T * n, C_out)
    v = winograd.transform_input(x.transpose(1, 2, 0, 3))
    dv, du = winograd.product_adjoints(v, winograd.transform_kernel(kernel), winograd.transform_output_adjoint(g))
    dx = winograd.transform_input_adjoint(dv, (H, W, n, C_in)).transpose(2, 0, 1, 3)
    return dx, winograd.transform_kernel_adjoint(du)


@jax.custom_vjp
def conv2d(x: Array, kernel: Array) -> Array:
    """`conv.conv2d` in float32."""
    before = (kernel.shape[0] - 1) // 2
    return _join(jax.lax.map(lambda chunk: _convolve(chunk, kernel, before), _split(x)), x.shape[0])


def _conv2d_forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return conv2d(x, kernel), (x, kernel)


def _conv2d_backward(residuals: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    x, kernel = residuals
    before = (kernel.shape[0] - 1) // 2

    def body(total: Array, chunk: tuple[Array, Array]) -> tuple[Array, Array]:
        dx, dkernel = _convolve_backward(chunk[0], kernel, before, chunk[1])
        return total + dkernel, dx

    dkernel, dx = jax.lax.scan(body, jnp.zeros_like(kernel), (_split(x), _split(g)))
    return _join(dx, x.shape[0]), dkernel


conv2d.defvjp(_conv2d_forward, _conv2d_backward)
