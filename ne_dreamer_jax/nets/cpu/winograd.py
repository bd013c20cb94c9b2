"""Winograd's minimal filtering F(4x4, 5x5) as plain matrix products, with the adjoint of every step.

A 5x5 convolution (stride 1, SAME) is computed on tiles of 4x4 outputs. Each tile reads an 8x8 window of the input; in
the transformed domain the convolution of a window with a kernel is 64 independent products instead of 400, so a layer
becomes 64 matrix products of ``[tiles, C_in]`` with ``[C_in, C_out]``, 6.25 times less arithmetic:

    y = A^T [ (G k G^T) * (B^T x B) ] A        (Winograd 1980; Lavin and Gray 2016, eq. 8)

The interpolation points are 0, 1, -1, 2, -2, 1/2, -1/2 and infinity; in float32 the result is within about 1e-5 of a
direct convolution, relative to the largest output.

Arrays hold a few images at a time as ``[H, W, n, C]``: with the images next to the channels, every transform is one
large matrix product along H or W and every rearrangement moves long contiguous runs. Tile rows are counted by t
(T = ceil(H / 4)), tile columns by s (S = ceil(W / 4)), positions in a window by a, b (8 each), outputs in a tile by
i, j (4 each). Sides need not be multiples of 4: the matrices hold the zero padding, and outputs past the edge are the
caller's to drop.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array

TILE = 4  # outputs along a side of a tile
TAPS = 5  # side of the kernel
WINDOW = TILE + TAPS - 1  # inputs that a tile reads along a side
_POINTS = np.array([0.0, 1.0, -1.0, 2.0, -2.0, 0.5, -0.5])  # and infinity


def _matrices() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``A^T`` [4, 8], ``G`` [8, 5] and ``B^T`` [8, 8] by Toom-Cook interpolation at the points, float64."""
    powers = lambda count: np.vander(_POINTS, count, increasing=True)
    out, kernel, data = np.zeros((TILE, WINDOW)), np.zeros((WINDOW, TAPS)), np.zeros((WINDOW, WINDOW))
    out[:, :-1], out[-1, -1] = powers(TILE).T, 1.0
    for row, point in enumerate(_POINTS):
        others = np.delete(_POINTS, row)
        kernel[row] = powers(TAPS)[row] / np.prod(point - others)
        data[row, : len(others) + 1] = np.poly(others)[::-1]
    kernel[-1, -1] = 1.0
    data[-1] = np.poly(_POINTS)[::-1]
    return out, kernel, data


_OUT, _KERNEL, _DATA = _matrices()
_OUT_2D = np.kron(_OUT, _OUT).astype(np.float32)  # [(i, j), (a, b)]
_KERNEL_F32 = _KERNEL.astype(np.float32)


def tiles(side: int) -> int:
    """Tiles along a side."""
    return -(-side // TILE)


@functools.cache
def _window_matrix(side: int) -> np.ndarray:
    """``[8 * T, side]``: B^T applied to every window along one zero-padded side, rows ordered (a, t)."""
    before = (TAPS - 1) // 2
    padded = np.zeros((WINDOW, tiles(side), TILE * tiles(side) + WINDOW), np.float32)
    for t in range(tiles(side)):
        padded[:, t, TILE * t : TILE * t + WINDOW] = _DATA
    return padded[:, :, before : before + side].reshape(-1, side)


def _over_rows(matrix: np.ndarray) -> np.ndarray:
    """A copy of the matrix for every a: XLA transposes operands of a product whose batch axis one side lacks."""
    return np.broadcast_to(matrix, (WINDOW, *matrix.shape))


def transform_kernel(kernel: Array) -> Array:
    """``G k G^T``: ``[5, 5, C_in, C_out]`` to ``[64, C_in, C_out]``."""
    u = jnp.einsum("ai,bj,ijco->abco", _KERNEL_F32, _KERNEL_F32, kernel)
    return u.reshape(WINDOW**2, *kernel.shape[2:])


def transform_kernel_adjoint(u: Array) -> Array:
    """Gradient of the kernel from that of its transform: ``[64, C_in, C_out]`` to ``[5, 5, C_in, C_out]``."""
    u = u.reshape(WINDOW, WINDOW, *u.shape[1:])
    return jnp.einsum("ai,bj,abco->ijco", _KERNEL_F32, _KERNEL_F32, u)


def transform_input(x: Array) -> Array:
    """``B^T x B`` of every window: ``[H, W, n, C]`` to ``[64, S * T * n, C]``."""
    H, W, n, C = x.shape
    T, S = tiles(H), tiles(W)
    rows = jnp.matmul(_window_matrix(H), x.reshape(H, W * n * C)).reshape(WINDOW, T, W, n * C)
    rows = rows.transpose(0, 2, 1, 3).reshape(WINDOW, W, T * n * C)
    return jnp.matmul(_over_rows(_window_matrix(W)), rows).reshape(WINDOW**2, S * T * n, C)


def transform_input_adjoint(v: Array, H: int, W: int) -> Array:
    """Gradient of the input ``[H, W, n, C]`` from that of its transform, ``[64, S * T, n, C]``."""
    _, _, n, C = v.shape
    T, S = tiles(H), tiles(W)
    rows = jnp.matmul(_over_rows(_window_matrix(W).T), v.reshape(WINDOW, WINDOW * S, T * n * C))
    rows = rows.reshape(WINDOW, W, T, n * C).transpose(0, 2, 1, 3).reshape(WINDOW * T, W * n * C)
    return jnp.matmul(_window_matrix(H).T, rows).reshape(H, W, n, C)


def transform_output(m: Array) -> Array:
    """``A^T m A``: ``[64, P, C_out]`` to ``[16, P, C_out]``, the outputs (i, j) of each of the P tiles."""
    return jnp.matmul(_OUT_2D, m.reshape(WINDOW**2, -1)).reshape(TILE**2, *m.shape[1:])


def transform_output_adjoint(g: Array) -> Array:
    """Gradient in the transformed domain from that of the tiles' outputs: ``[16, P, C_out]`` to ``[64, P, C_out]``."""
    return jnp.matmul(_OUT_2D.T, g.reshape(TILE**2, -1)).reshape(WINDOW**2, *g.shape[1:])


def product(v: Array, u: Array) -> Array:
    """The 64 products: ``[64, P, C_in]`` by ``[64, C_in, C_out]`` to ``[64, P, C_out]``."""
    return jnp.einsum("kpc,kco->kpo", v, u)


def product_adjoints(v: Array, u: Array, d: Array) -> tuple[Array, Array]:
    """Gradients of `product` for v and u, given that of its result, d ``[64, P, C_out]``."""
    return jnp.einsum("kpo,kco->kpc", d, u), jnp.einsum("kpc,kpo->kco", v, d)
