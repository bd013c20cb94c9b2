"""The shared layers against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ne_dreamer_jax.nets.blocks import MLP, Block, Linear, add_bias, kernel_init, rms_norm


@pytest.mark.parametrize(("shape", "fan_in"), [((400, 250), 400), ((5, 5, 16, 250), 400)])
@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_initialisation_is_a_normal_over_the_fan_in_cut_at_two(shape, fan_in, scale):
    x = np.asarray(kernel_init(scale)(jax.random.key(0), shape, jnp.float32), np.float64).ravel()
    before_cut = scale * 1.1368 * np.sqrt(1 / fan_in)
    assert np.abs(x).max() <= 2 * before_cut * 1.001
    assert np.abs(x).max() > 1.98 * before_cut
    np.testing.assert_allclose(x.std(), scale * np.sqrt(1 / fan_in), rtol=0.01)
    assert stats.kstest(x / before_cut, stats.truncnorm(-2, 2).cdf).pvalue > 1e-3


def test_a_scale_of_zero_starts_at_zero():
    assert not np.any(kernel_init(0.0)(jax.random.key(0), (8, 4), jnp.float32))


@pytest.mark.parametrize(("dtype", "rtol"), [(np.float32, 1e-5), (jnp.bfloat16, 1e-2)])
def test_rms_norm(dtype, rtol):
    rng = np.random.default_rng(0)
    x, scale = rng.normal(0, 3, (4, 5, 7)).astype(dtype), rng.normal(1, 0.3, 7).astype(np.float32)
    x[0, 0] = 1e-3  # where the epsilon matters
    got = rms_norm(jnp.asarray(x), jnp.asarray(scale))
    assert got.dtype == dtype
    x = x.astype(np.float64)
    want = x / np.sqrt(np.mean(x**2, -1, keepdims=True) + 1e-4) * scale
    np.testing.assert_allclose(np.asarray(got, np.float64), want, rtol=rtol)


@pytest.mark.parametrize("use_bias", [True, False])
def test_linear_is_the_product_and_the_bias(use_bias):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, 3, 11)).astype(np.float32)
    params = {"kernel": rng.normal(size=(11, 5)).astype(np.float32)}
    if use_bias:
        params["bias"] = rng.normal(size=5).astype(np.float32)
    want = x.astype(np.float64) @ params["kernel"] + params.get("bias", 0.0)
    got = Linear(5, use_bias=use_bias).apply({"params": params}, jnp.asarray(x))
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


def test_in_bfloat16_a_biass_gradient_is_summed_in_float32():
    """The sum is as near as the rounded numbers that are added, however many rows there are."""
    rows = np.random.default_rng(0).normal(1.0, 1.0, (40_000, 2)).astype(jnp.bfloat16)

    def weighted(bias):
        return jnp.sum((add_bias(jnp.zeros(rows.shape, jnp.bfloat16), bias) * rows).astype(jnp.float32))

    gradient = jax.jit(jax.grad(weighted))(jnp.zeros(2))
    assert gradient.dtype == jnp.float32
    np.testing.assert_allclose(gradient, rows.astype(np.float64).sum(0), rtol=1e-5)


def test_a_stack_is_linear_norm_silu_in_turn():
    rng = np.random.default_rng(1)
    stack = MLP(2, 6)
    x = rng.normal(size=(3, 4)).astype(np.float32)
    shapes = jax.eval_shape(stack.init, jax.random.key(0), x)
    params = jax.tree.map(lambda s: rng.normal(0, 0.5, s.shape).astype(np.float32), shapes)["params"]
    want = x.astype(np.float64)
    for block in (params["block0"], params["block1"]):
        want = want @ block["linear"]["kernel"] + block["linear"]["bias"]
        want = want / np.sqrt(np.mean(want**2, -1, keepdims=True) + 1e-4) * block["norm"]["scale"]
        want = want / (1 + np.exp(-want))
    np.testing.assert_allclose(stack.apply({"params": params}, x), want, rtol=1e-4, atol=1e-5)


def test_bfloat16_is_of_the_products_alone():
    x = jnp.asarray(np.random.default_rng(0).normal(size=(3, 64)).astype(np.float32))
    block = Block(8, jnp.bfloat16)
    params = jax.eval_shape(block.init, jax.random.key(0), x)
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype(jnp.float32)}
    assert jax.eval_shape(block.apply, params, x).dtype == jnp.bfloat16
