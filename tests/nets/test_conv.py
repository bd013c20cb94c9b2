"""The CPU lowerings equal XLA's convolution, values and gradients."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.nets import conv
from ne_dreamer_jax.nets.conv import Stage


def _lax_conv(x, kernel):
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def _normal(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def _with_gradients(f, g, *args):
    """The value of f and its gradients for the cotangent g, in one compiled function."""

    @jax.jit
    def run(g, *args):
        y, vjp = jax.vjp(f, *args)
        return y, vjp(g)

    return run(g, *args)


def _assert_close(actual, expected, tolerance=3e-5):
    """Equal to within a share of the largest entry, leaf by leaf."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, e in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (e.shape, e.dtype)
        np.testing.assert_allclose(a, e, rtol=0, atol=tolerance * float(np.abs(e).max()))


@pytest.mark.parametrize(
    ("shape", "taps", "out"),
    [
        ((9, 8, 8, 6), 5, 7),  # chunks that don't divide the images
        ((2, 6, 10, 5), 5, 8),  # sides that are no multiples of a tile
        ((1, 3, 2, 5), 5, 5),  # sides smaller than the kernel
        ((17, 8, 8, 3), 5, 4),  # too few channels for Winograd
        ((3, 7, 5, 6), 3, 4),
        ((3, 7, 5, 6), 1, 4),
        ((2, 6, 5, 4), 4, 3),
    ],
)
def test_conv2d_equals_lax(shape, taps, out):
    x, kernel, g = _normal(0, *shape), _normal(1, taps, taps, shape[-1], out), _normal(2, *shape[:3], out)
    _assert_close(_with_gradients(conv.conv2d, g, x, kernel), _with_gradients(_lax_conv, g, x, kernel))


def _stages(channels, taps=5):
    return [
        Stage(
            _normal(10 + i, taps, taps, c_in, c_out) / (taps * c_in**0.5),
            0.3 * _normal(20 + i, c_out),
            1.0 + 0.3 * _normal(30 + i, c_out),
        )
        for i, (c_in, c_out) in enumerate(itertools.pairwise(channels))
    ]


def _reference(images, stages):
    """The encoder from its definition, float64 where enabled."""
    x = images
    for stage in stages:
        x = _lax_conv(x, stage.kernel) + stage.bias[None, None, None]
        x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 2, 2, 1), (1, 2, 2, 1), "VALID")
        x = x / jnp.sqrt(jnp.mean(x**2, axis=-1, keepdims=True) + 1e-4) * stage.scale[None, None, None]
        x = x * jax.nn.sigmoid(x)
    return x


@pytest.mark.parametrize(
    ("shape", "channels"),
    [
        ((9, 16, 16, 3), (3, 8, 12, 16)),
        ((1, 32, 16, 3), (3, 6, 8, 10, 12)),
        ((2, 12, 20, 9), (9, 5, 7)),  # a first stage by Winograd, sides that are no multiples of a tile
        ((2, 4, 4, 1), (1, 4)),
    ],
)
def test_encoder_equals_its_definition(shape, channels):
    stages, images = _stages(channels), _normal(0, *shape)
    factor = 2 ** len(stages)
    g = _normal(2, shape[0], shape[1] // factor, shape[2] // factor, channels[-1])
    _assert_close(
        _with_gradients(conv.encode_images, g, images, stages), _with_gradients(_reference, g, images, stages)
    )
