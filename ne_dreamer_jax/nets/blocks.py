"""Layers that every network shares: linear maps, RMSNorm and the Linear-RMSNorm-SiLU stack of DreamerV3.

Parameters are float32; ``dtype`` is what the matrix products are computed in (bfloat16 on accelerators). Norms
are computed in float32.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.linen import initializers

from ne_dreamer_jax.nets.platform import on_cpu
from ne_dreamer_jax.types import Array

NORM_EPSILON = 1e-4


def kernel_init(scale: float = 1.0) -> initializers.Initializer:
    """Truncated normal over the fan in, standard deviation ``scale * 1.1368 * sqrt(1 / fan_in)``, cut at two of them.

    The factor makes the standard deviation after the cut ``scale * sqrt(1 / fan_in)`` (DreamerV3).
    """
    if scale == 0:
        return initializers.zeros_init()
    return initializers.variance_scaling(scale**2, "fan_in", "truncated_normal")


def rms_norm(x: Array, scale: Array) -> Array:
    """RMSNorm over the last axis in float32, returned in the dtype of ``x [..., C]``; ``scale [C]``."""
    x32 = x.astype(jnp.float32)
    inverse = jax.lax.rsqrt(jnp.mean(jnp.square(x32), axis=-1, keepdims=True) + NORM_EPSILON)
    return (x32 * inverse * jnp.expand_dims(scale, range(x.ndim - 1))).astype(x.dtype)


def per_block(function: Callable[..., Array], activations: Sequence[Array], params: Sequence[Array]) -> Array:
    """A function applied to each of G blocks with its own parameters, ``[N, G, O]``.

    Args:
      function: of a block's share ``[N, ...]`` of each activation and of each parameter, to ``[N, O]``.
      activations: ``[N, G, ...]`` each.
      params: ``[G, ...]`` each.

    On a CPU block by block: XLA's batched product transposes its operands there, and its loops over a slice of three
    axes are not vectorised.
    """
    if on_cpu():
        shares = [*(_unstack(x, 1) for x in activations), *(_unstack(x, 0) for x in params)]
        return jnp.stack([function(*block) for block in zip(*shares, strict=True)], axis=1)
    axes = (*(1 for _ in activations), *(0 for _ in params))
    return jax.vmap(function, in_axes=axes, out_axes=1)(*activations, *params)


def block_linear(x: Array, kernel: Array) -> Array:
    """A linear map for each of G blocks: ``x [N, G, I]`` and ``kernel [G, I, O]`` to ``[N, G, O]``."""
    return per_block(jnp.matmul, (x,), (kernel,))


def _unstack(x: Array, axis: int) -> list[Array]:
    """The slices along an axis. The gradient joins theirs, where that of indexing adds each to zeros."""
    parts = jax.lax.split(x, (1,) * x.shape[axis], axis)
    return [jax.lax.squeeze(part, (axis,)) for part in parts]


def add_bias(x: Array, bias: Array) -> Array:
    """x plus a float32 bias of its last axes, added in float32, as then the bias' gradient is summed; in x's dtype."""
    return (x.astype(bias.dtype) + jnp.expand_dims(bias, range(x.ndim - bias.ndim))).astype(x.dtype)


class Linear(nn.Module):
    """Affine map ``[..., I]`` to ``[..., units]``."""

    units: int
    use_bias: bool = True
    kernel_init: initializers.Initializer = kernel_init()
    dtype: Any = jnp.float32
    bias_init: initializers.Initializer = initializers.zeros_init()

    @nn.compact
    def __call__(self, x: Array) -> Array:
        kernel = self.param("kernel", self.kernel_init, (x.shape[-1], self.units), jnp.float32)
        product = x.astype(self.dtype) @ kernel.astype(self.dtype)
        if not self.use_bias:
            return product
        return add_bias(product, self.param("bias", self.bias_init, (self.units,), jnp.float32))


class RMSNorm(nn.Module):
    """`rms_norm` with a learned scale."""

    @nn.compact
    def __call__(self, x: Array) -> Array:
        return rms_norm(x, self.param("scale", initializers.ones_init(), (x.shape[-1],), jnp.float32))


class Block(nn.Module):
    """Linear, RMSNorm, SiLU: ``[..., I]`` to ``[..., units]``."""

    units: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array) -> Array:
        return nn.silu(RMSNorm(name="norm")(Linear(self.units, dtype=self.dtype, name="linear")(x)))


class MLP(nn.Module):
    """``layers`` blocks of ``units``."""

    layers: int
    units: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for i in range(self.layers):
            x = Block(self.units, self.dtype, name=f"block{i}")(x)
        return x
