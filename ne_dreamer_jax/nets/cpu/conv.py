"""Convolutions and the image encoder for a CPU: matrix products over a few images at a time, with their own gradients.

Everything between the input and the result of a few images stays in the cache, so that elementwise work costs little
beside the products. A 5x5 convolution goes through Winograd's transform (`winograd`); where channels are few, so that
the transforms would cost more than they save, a stage of the encoder computes the 2x2 outputs that it pools together
from their common 6x6 inputs instead (`_Phases`).

The gradients are reverse mode, first order. A stage of the encoder keeps its pooled output before the norm and which of
the four pooled outputs was the maximum; everything else is computed again.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.nets.blocks import NORM_EPSILON
from ne_dreamer_jax.nets.cpu import winograd
from ne_dreamer_jax.nets.pixels import centred
from ne_dreamer_jax.types import Array

_CHUNK_BYTES = 2**21  # what the largest array about a chunk of images may take: a few of them fit a cache of some MB


class Stage(NamedTuple):
    """Parameters of one stage of the image encoder."""

    kernel: Array  # float32 [k, k, C_in, C_out]
    bias: Array  # float32 [C_out]
    scale: Array  # float32 [C_out], of the RMSNorm


def encodes(kernel: Array) -> bool:
    """Whether `encode_images` has a lowering for a stage with this kernel."""
    return kernel.shape[:2] == (5, 5)


class _Lowering(Protocol):
    """A 5x5 convolution followed by a 2x2 max-pool, for a few images ``[n, H, W, C]``."""

    def bytes_per_image(self, shape: tuple[int, ...], kernel: Array) -> int:
        """Size of the largest intermediate, for images of the given ``[N, H, W, C]``."""

    def prepare(self, kernel: Array) -> Array:
        """The kernel as the products need it, once for all images."""

    def prepare_adjoint(self, u: Array, shape: tuple[int, ...]) -> Array:
        """Gradient of the kernel, of the given shape, from that of `prepare`'s result."""

    def forward(self, x: Array, u: Array) -> tuple[Array, Array]:
        """``[n, H, W, C_in]`` to the pooled ``[n, H / 2, W / 2, C_out]`` and which of four was the maximum, uint8."""

    def backward(self, x: Array, u: Array, which: Array, g: Array) -> tuple[Array, Array]:
        """Gradients of x and u from that of the pooled output."""


def _maximum_of_four(y: list[Array]) -> tuple[Array, Array]:
    top = jnp.maximum(jnp.maximum(y[0], y[1]), jnp.maximum(y[2], y[3]))
    which = jnp.where(y[0] == top, 0, jnp.where(y[1] == top, 1, jnp.where(y[2] == top, 2, 3)))
    return top, which.astype(jnp.uint8)


def _where_maximum(which: Array, four: tuple[int, ...], g: Array) -> Array:
    """g at which of four positions was the maximum, zero at the others; ``four`` is the positions' shape, 4 in all."""
    # Compared as floats: LLVM vectorises that, and not the comparison of integers.
    return jnp.where(which.astype(jnp.float32) == jnp.arange(4.0).reshape(four), g, 0.0)


class _Winograd:
    """Output tiles of 4x4 are pooled to 2x2 where they lie, before they are put back into rows."""

    @staticmethod
    def bytes_per_image(shape: tuple[int, ...], kernel: Array) -> int:
        return 4 * 64 * winograd.tiles(shape[1]) * winograd.tiles(shape[2]) * max(kernel.shape[2:])

    prepare = staticmethod(winograd.transform_kernel)

    @staticmethod
    def prepare_adjoint(u: Array, shape: tuple[int, ...]) -> Array:
        return winograd.transform_kernel_adjoint(u)

    @staticmethod
    def forward(x: Array, u: Array) -> tuple[Array, Array]:
        n, H, W, _ = x.shape
        T, S = winograd.tiles(H), winograd.tiles(W)
        y = winograd.transform_output(winograd.product(winograd.transform_input(x.transpose(1, 2, 0, 3)), u))
        y = y.reshape(2, 2, 2, 2, S, T, n, -1)  # row of the pool, row in it, column of the pool, column in it
        top, which = _maximum_of_four([y[:, 0, :, 0], y[:, 0, :, 1], y[:, 1, :, 0], y[:, 1, :, 1]])
        return top.transpose(4, 3, 0, 2, 1, 5).reshape(n, 2 * T, 2 * S, -1)[:, : H // 2, : W // 2], which

    @staticmethod
    def backward(x: Array, u: Array, which: Array, g: Array) -> tuple[Array, Array]:
        n, H, W, _ = x.shape
        T, S = winograd.tiles(H), winograd.tiles(W)
        g = jnp.pad(g, ((0, 0), (0, 2 * T - H // 2), (0, 2 * S - W // 2), (0, 0)))
        g = g.reshape(n, T, 2, S, 2, -1).transpose(2, 4, 3, 1, 0, 5)
        y = _where_maximum(which.reshape(2, 1, 2, 1, -1), (1, 2, 1, 2, 1), g.reshape(2, 1, 2, 1, -1))
        d = winograd.transform_output_adjoint(y.reshape(16, S * T * n, -1))
        x = x.transpose(1, 2, 0, 3)
        dv, du = winograd.product_adjoints(winograd.transform_input(x), u, d)
        return winograd.transform_input_adjoint(dv.reshape(64, -1, n, dv.shape[-1]), H, W).transpose(2, 0, 1, 3), du


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

    @staticmethod
    def bytes_per_image(shape: tuple[int, ...], kernel: Array) -> int:
        return shape[1] * shape[2] * max(36 * kernel.shape[2], 4 * kernel.shape[3])

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
        """``[n, H, W, C]`` to ``[n, H / 2, W / 2, 9 * 4 * C]``: each block with its eight neighbours."""
        n, H, W, C = x.shape
        x = x.reshape(n, H // 2, 2, W // 2, 2 * C).transpose(0, 1, 3, 2, 4).reshape(n, H // 2, W // 2, 4 * C)
        x = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        return jnp.concatenate([x[:, i : i + H // 2, j : j + W // 2] for i in range(3) for j in range(3)], axis=-1)

    @classmethod
    def forward(cls, x: Array, u: Array) -> tuple[Array, Array]:
        patches = cls._patches(x)
        y = (patches.reshape(-1, u.shape[0]) @ u).reshape(*patches.shape[:3], 4, -1)
        return _maximum_of_four([y[..., k, :] for k in range(4)])

    @classmethod
    def backward(cls, x: Array, u: Array, which: Array, g: Array) -> tuple[Array, Array]:
        patches, adjoint = jax.vjp(cls._patches, x)
        y = _where_maximum(jnp.expand_dims(which, 3), (1, 1, 1, 4, 1), jnp.expand_dims(g, 3)).reshape(-1, u.shape[1])
        (dx,) = adjoint((y @ u.T).reshape(patches.shape))
        return dx, patches.reshape(-1, u.shape[0]).T @ y


def _lowering(kernel: Array) -> _Lowering:
    return _Phases if kernel.shape[2] <= 4 else _Winograd


def norm_silu(x: Array, scale: Array) -> Array:
    """RMSNorm over channels and SiLU, ``[N, H, W, C]``."""
    inverse = jax.lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + NORM_EPSILON)
    return jax.nn.silu(x * inverse * scale[None, None, None])


def _norm_silu_backward(x: Array, scale: Array, g: Array) -> tuple[Array, Array]:
    """Gradients of x and scale from that of `norm_silu`'s result."""
    inverse = jax.lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + NORM_EPSILON)
    unit = x * inverse
    scaled = unit * scale[None, None, None]
    gate = jax.nn.sigmoid(scaled)
    g = g * gate * (1.0 + scaled * (1.0 - gate))
    h = g * scale[None, None, None]
    return inverse * (h - unit * jnp.mean(h * unit, axis=-1, keepdims=True)), jnp.sum(g * unit, axis=(0, 1, 2))


def _split(x: Array, bytes_per_image: int) -> Array:
    """``[N, ...]`` to ``[chunks, n, ...]``, padded with zeros by less than the number of chunks."""
    chunks = -(-x.shape[0] // max(1, _CHUNK_BYTES // bytes_per_image))
    n = -(-x.shape[0] // chunks)
    x = jnp.pad(x, ((0, chunks * n - x.shape[0]), *((0, 0),) * (x.ndim - 1)))
    return x.reshape(chunks, n, *x.shape[1:])


def _join(x: Array, count: int) -> Array:
    return x.reshape(-1, *x.shape[2:])[:count]


@jax.custom_vjp
def _stage(x: Array, scale: Array | None, kernel: Array, bias: Array) -> Array:
    """`norm_silu` where there is a scale, 5x5 convolution with bias, and 2x2 max-pool.

    The stage starts where the encoder's definition has the end of the one before, so that what is kept for the gradient
    is one array a stage, its input. uint8 images are normalised and get no gradient.
    """
    return _stage_forward(x, scale, kernel, bias)[0]


def _stage_forward(x: Array, scale: Array | None, kernel: Array, bias: Array) -> tuple[Array, Any]:
    lowering = _lowering(kernel)
    u = lowering.prepare(kernel)

    def body(chunk: Array) -> tuple[Array, Array]:
        chunk = centred(chunk) if scale is None else norm_silu(chunk, scale)
        top, which = lowering.forward(chunk, u)
        return top + bias[None, None, None], which

    top, which = jax.lax.map(body, _split(x, lowering.bytes_per_image(x.shape, kernel)))
    return _join(top, x.shape[0]), (x, scale, kernel, which)


def _stage_backward(residuals: Any, g: Array) -> Any:
    x, scale, kernel, which = residuals
    lowering = _lowering(kernel)
    u = lowering.prepare(kernel)

    def body(total: Any, chunk: tuple[Array, Array, Array]) -> Any:
        x, which, g = chunk
        active = centred(x) if scale is None else norm_silu(x, scale)
        dx, du = lowering.backward(active, u, which, g)
        dscale = None
        if scale is not None:
            dx, dscale = _norm_silu_backward(x, scale, dx)
        gradients = dscale, du, jnp.sum(g, axis=(0, 1, 2))
        return jax.tree.map(jnp.add, total, gradients), None if x.dtype == jnp.uint8 else dx

    zero = jax.tree.map(jnp.zeros_like, (scale, u, jnp.zeros(kernel.shape[-1])))
    size = lowering.bytes_per_image(x.shape, kernel)
    (dscale, du, dbias), dx = jax.lax.scan(body, zero, (_split(x, size), which, _split(g, size)))
    dkernel = lowering.prepare_adjoint(du, kernel.shape)
    return None if dx is None else _join(dx, x.shape[0]), dscale, dkernel, dbias


_stage.defvjp(_stage_forward, _stage_backward)


def encode_images(images: Array, stages: Sequence[Stage]) -> Array:
    """`conv.encode_images` for kernels that `encodes` accepts, float32."""
    x = _stage(images, None, stages[0].kernel, stages[0].bias)
    for before, stage in itertools.pairwise(stages):
        x = _stage(x, before.scale, stage.kernel, stage.bias)
    return norm_silu(x, stages[-1].scale)


def _patches(x: Array, taps: int, before: int) -> Array:
    """``[n, H, W, C]`` to ``[n, H, W, taps * taps * C]``, zero-padded ``before`` rows and columns on the near side."""
    _, H, W, _ = x.shape
    around = (before, taps - 1 - before)
    x = jnp.pad(x, ((0, 0), around, around, (0, 0)))
    return jnp.concatenate([x[:, i : i + H, j : j + W] for i in range(taps) for j in range(taps)], axis=-1)


def _winograd_suits(kernel: Array) -> bool:
    return kernel.shape[:2] == (5, 5) and kernel.shape[2] > 4


def _prepare(kernel: Array) -> Array:
    return winograd.transform_kernel(kernel) if _winograd_suits(kernel) else kernel


def _convolve(x: Array, u: Array, kernel: Array, before: int) -> Array:
    """A few images ``[n, H, W, C_in]`` to ``[n, H, W, C_out]``, with the kernel as from `_prepare` and as it is."""
    n, H, W, _ = x.shape
    C_out = kernel.shape[3]
    if not _winograd_suits(kernel):
        return _patches(x, kernel.shape[0], before) @ u.reshape(-1, C_out)
    T, S = winograd.tiles(H), winograd.tiles(W)
    y = winograd.transform_output(winograd.product(winograd.transform_input(x.transpose(1, 2, 0, 3)), u))
    y = y.reshape(4, 4, S, T, n, C_out).transpose(4, 3, 0, 2, 1, 5)
    return y.reshape(n, 4 * T, 4 * S, C_out)[:, :H, :W]


def _convolve_backward(x: Array, u: Array, kernel: Array, before: int, g: Array) -> tuple[Array, Array]:
    """Gradients of x and of the prepared kernel for a few images."""
    n, H, W, C_in = x.shape
    taps, _, _, C_out = kernel.shape
    if not _winograd_suits(kernel):
        dkernel = _patches(x, taps, before).reshape(-1, taps * taps * C_in).T @ g.reshape(-1, C_out)
        flipped = jnp.flip(u, (0, 1)).swapaxes(2, 3).reshape(-1, C_in)
        return _patches(g, taps, taps - 1 - before) @ flipped, dkernel.reshape(kernel.shape)
    T, S = winograd.tiles(H), winograd.tiles(W)
    g = jnp.pad(g, ((0, 0), (0, 4 * T - H), (0, 4 * S - W), (0, 0)))
    g = g.reshape(n, T, 4, S, 4, C_out).transpose(2, 4, 3, 1, 0, 5).reshape(16, S * T * n, C_out)
    v, d = winograd.transform_input(x.transpose(1, 2, 0, 3)), winograd.transform_output_adjoint(g)
    dv, du = winograd.product_adjoints(v, u, d)
    return winograd.transform_input_adjoint(dv.reshape(64, -1, n, C_in), H, W).transpose(2, 0, 1, 3), du


def _conv2d_bytes(x: Array, kernel: Array) -> int:
    if _winograd_suits(kernel):
        return _Winograd.bytes_per_image(x.shape, kernel)
    return 4 * x.shape[1] * x.shape[2] * kernel.shape[0] ** 2 * max(kernel.shape[2:])


@jax.custom_vjp
def conv2d(x: Array, kernel: Array) -> Array:
    """`conv.conv2d` in float32."""
    u, before = _prepare(kernel), (kernel.shape[0] - 1) // 2
    chunks = _split(x, _conv2d_bytes(x, kernel))
    return _join(jax.lax.map(lambda chunk: _convolve(chunk, u, kernel, before), chunks), x.shape[0])


def _conv2d_forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return conv2d(x, kernel), (x, kernel)


def _conv2d_backward(residuals: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    x, kernel = residuals
    u, before = _prepare(kernel), (kernel.shape[0] - 1) // 2

    def body(total: Array, chunk: tuple[Array, Array]) -> tuple[Array, Array]:
        dx, du = _convolve_backward(chunk[0], u, kernel, before, chunk[1])
        return total + du, dx

    size = _conv2d_bytes(x, kernel)
    du, dx = jax.lax.scan(body, jnp.zeros_like(u), (_split(x, size), _split(g, size)))
    dkernel = winograd.transform_kernel_adjoint(du) if _winograd_suits(kernel) else du
    return _join(dx, x.shape[0]), dkernel


conv2d.defvjp(_conv2d_forward, _conv2d_backward)
