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


@pytest.mark.parametrize("taps", [5, 3, 4, 1])
@pytest.mark.parametrize("shape", [(3, 4, 4, 6), (2, 3, 5, 4)])
def test_convolution_after_upsampling_equals_its_definition(shape, taps):
    N, H, W, C = shape
    x, kernel, g = _normal(0, *shape), _normal(1, taps, taps, C, 3), _normal(2, N, 2 * H, 2 * W, 3)
    definition = lambda x, kernel: _lax_conv(jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2), kernel)
    _assert_close(_with_gradients(conv.upsampled_conv2d, g, x, kernel), _with_gradients(definition, g, x, kernel))


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


def test_uint8_images_are_centred_and_kernels_get_their_gradients():
    images = np.random.default_rng(0).integers(0, 256, (3, 8, 8, 3), np.uint8)
    stages, g = _stages((3, 4, 6)), _normal(2, 3, 2, 2, 6)
    actual = _with_gradients(lambda stages: conv.encode_images(jnp.asarray(images), stages), g, stages)
    centred = jnp.asarray(images.astype(np.float32) / 255 - 0.5)
    _assert_close(actual, _with_gradients(lambda stages: _reference(centred, stages), g, stages))


@pytest.mark.parametrize("side", [2, 4])
def test_patches_equal_a_strided_convolution(side):
    stage, images = _stages((3, 5), side)[0], _normal(0, 3, 8, 12, 3)

    def reference(images, stage):
        strides = (side, side)
        x = jax.lax.conv_general_dilated(
            images, stage.kernel, strides, "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        x = x + stage.bias[None, None, None]
        x = x * jax.lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + 1e-4) * stage.scale[None, None, None]
        return jax.nn.silu(x)

    g = _normal(2, 3, 8 // side, 12 // side, 5)
    _assert_close(_with_gradients(conv.embed_patches, g, images, stage), _with_gradients(reference, g, images, stage))
    pixels = jnp.asarray(np.random.default_rng(0).integers(0, 256, (3, 8, 12, 3), np.uint8))
    centred = pixels.astype(jnp.float32) / 255 - 0.5
    _assert_close(conv.embed_patches(pixels, stage), reference(centred, stage))
    assert conv.embed_patches(pixels, stage, jnp.bfloat16).dtype == jnp.bfloat16


@pytest.mark.parametrize(("taps", "dtype", "tolerance"), [(3, jnp.float32, 3e-5), (5, jnp.bfloat16, 5e-2)])
def test_encoder_without_a_lowering_of_its_own_is_xlas(taps, dtype, tolerance):
    stages, images = _stages((3, 4, 6), taps), _normal(0, 2, 8, 8, 3)
    y = conv.encode_images(images, stages, dtype)
    assert y.dtype == dtype
    _assert_close(y.astype(jnp.float32), _reference(images, stages), tolerance)


def test_on_a_cpu_bfloat16_is_computed_in_float32():
    """XLA's convolutions of bfloat16 take twenty times as long in a loop there."""
    x, kernel = (_normal(0, 2, 6, 6, 5) / 8).astype(jnp.bfloat16), _normal(1, 5, 5, 5, 6).astype(jnp.bfloat16)
    weight = _normal(2, 2, 6, 6, 6)

    def loss(x, kernel):
        y = conv.conv2d(x, kernel)
        return jnp.sum(y.astype(jnp.float32) * weight), y

    (_, y), gradients = jax.value_and_grad(loss, (0, 1), has_aux=True)(x, kernel)
    single = x.astype(jnp.float32), kernel.astype(jnp.float32)
    (_, want), wanted = jax.value_and_grad(loss, (0, 1), has_aux=True)(*single)
    for got, exact in zip((y, *gradients), (want, *wanted), strict=True):
        assert got.dtype == jnp.bfloat16
        np.testing.assert_allclose(got.astype(jnp.float32), exact, rtol=2**-7, atol=0.1)
    program = str(jax.make_jaxpr(jax.grad(lambda x, kernel: loss(x, kernel)[0], (0, 1)))(x, kernel))
    assert "conv_general_dilated" not in program


def test_bfloat16_convolution():
    x, kernel = (_normal(0, 2, 6, 6, 5) / 8).astype(jnp.bfloat16), _normal(1, 5, 5, 5, 6).astype(jnp.bfloat16)
    y = conv.conv2d(x, kernel)
    assert y.dtype == jnp.bfloat16
    _assert_close(y.astype(jnp.float32), _lax_conv(x.astype(jnp.float32), kernel.astype(jnp.float32)), 1e-2)


def test_gradient_steps_in_a_loop_over_several_seeds_equal_single_ones():
    images = _normal(0, 5, 8, 8, 3)
    gradient = jax.grad(lambda stages: jnp.mean(conv.encode_images(images, stages) ** 2))

    def step(stages):
        return jax.tree.map(lambda p, g: p - 0.1 * g, stages, gradient(stages))

    seeds = [_stages((3, 4, 6)), [stage._replace(kernel=-stage.kernel) for stage in _stages((3, 4, 6))]]
    together = jax.jit(jax.vmap(lambda stages: jax.lax.fori_loop(0, 2, lambda _, s: step(s), stages)))
    single = jax.jit(step)
    expected = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(single(single(stages)) for stages in seeds))
    _assert_close(together(jax.tree.map(lambda *leaves: jnp.stack(leaves), *seeds)), expected)


def test_messages_say_what_was_expected():
    with pytest.raises(ValueError, match=r"Expected x \[N, H, W, C_in\].*got float32 \[1, 4, 4, 3\]"):
        conv.conv2d(jnp.zeros((1, 4, 4, 3)), jnp.zeros((5, 5, 4, 2)))
    with pytest.raises(ValueError, match=r"multiples of 4.*\[1, 6, 8, 3\]"):
        conv.encode_images(jnp.zeros((1, 6, 8, 3)), _stages((3, 4, 6)))
    stage = _stages((3, 4), 4)[0]
    with pytest.raises(ValueError, match=r"multiples of 4, the kernel's, got \[1, 6, 8, 3\] and \[4, 4, 3, 4\]"):
        conv.embed_patches(jnp.zeros((1, 6, 8, 3)), stage)
    for images, kernel in (((1, 8, 8, 2), (4, 4, 3, 4)), ((1, 8, 8, 3), (4, 3, 3, 4)), ((1, 8, 8, 3), (3, 4))):
        with pytest.raises(ValueError, match=r"images \[N, H, W, C\] and a kernel \[p, p, C, C_out\], got"):
            conv.embed_patches(jnp.zeros(images), stage._replace(kernel=jnp.zeros(kernel)))
