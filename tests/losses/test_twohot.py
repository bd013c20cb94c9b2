"""Symexp two-hot regression."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ne_dreamer_jax.losses import symexp, symexp_bins, symlog, twohot_encode, twohot_loss, twohot_mean

BINS = np.asarray(symexp_bins())


def oracle(x, bins):
    """Two-hot weights by linear interpolation of the one-hot rows, in float64."""
    eye = np.eye(len(bins))
    bins = bins.astype(np.float64)
    return np.stack([np.interp(x, bins, row) for row in eye], -1)


def test_symlog_and_symexp_are_inverse_and_odd():
    x = jnp.asarray([-1e6, -3.0, -1e-4, 0.0, 1e-4, 3.0, 1e6])
    np.testing.assert_allclose(symexp(symlog(x)), x, rtol=1e-5)
    np.testing.assert_array_equal(symlog(-x), -symlog(x))
    np.testing.assert_allclose(symlog(x), np.sign(x) * np.log1p(np.abs(np.asarray(x, np.float64))), rtol=1e-6)


@pytest.mark.parametrize("function", [symlog, symexp])
def test_symlog_and_symexp_have_slope_one_at_zero_and_compute_in_float32(function):
    np.testing.assert_allclose(jax.vmap(jax.grad(function))(jnp.asarray([0.0, -0.0, 1e-6, -1e-6])), 1.0, rtol=1e-5)
    for dtype in (jnp.bfloat16, jnp.float16):
        np.testing.assert_array_equal(function(jnp.asarray(12, dtype)), function(jnp.float32(12)))
        assert function(jnp.zeros(2, dtype)).dtype == jnp.float32


@pytest.mark.parametrize("count", [2, 40, 41, 255])
def test_bins_are_antisymmetric_increasing_and_symexp_spaced(count):
    bins = np.asarray(symexp_bins(count))
    np.testing.assert_array_equal(bins, -bins[::-1])
    assert (np.diff(bins) > 0).all()
    grid = np.linspace(-20, 20, count)
    np.testing.assert_allclose(bins, np.sign(grid) * np.expm1(np.abs(grid)), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("options", [{"count": 1}, {"limit": 0.0}])
def test_senseless_bins_are_refused(options):
    with pytest.raises(ValueError, match="at least two bins"):
        symexp_bins(**options)


@settings(deadline=None, max_examples=200)
@given(st.floats(-1e9, 1e9, width=32) | st.floats(-3, 3, width=32) | st.sampled_from([float(b) for b in BINS]))
def test_encoding_has_two_neighbours_unit_mass_and_mean_x(x):
    weights = np.asarray(twohot_encode(jnp.asarray(x, jnp.float32), jnp.asarray(BINS)), np.float64)
    where = np.flatnonzero(weights)
    assert len(where) == 1 or (len(where) == 2 and where[1] == where[0] + 1)
    assert weights.sum() == pytest.approx(1, abs=1e-6)
    inside = np.clip(np.float64(x), BINS[0], BINS[-1])
    assert weights @ BINS.astype(np.float64) == pytest.approx(inside, rel=1e-5, abs=1e-6)


def test_encoding_equals_interpolation():
    x = np.concatenate([np.random.default_rng(0).normal(size=200) * 10, BINS, [1e12, -1e12]]).astype(np.float32)
    got = twohot_encode(jnp.asarray(x.reshape(1, -1)), jnp.asarray(BINS))[0]
    np.testing.assert_allclose(got, oracle(x, BINS), atol=2e-5)


def test_encoding_of_bins_at_any_spacing():
    bins = jnp.asarray([-1.0, 0.5, 4.0])
    got = twohot_encode(jnp.asarray([-2.0, -1.0, 0.125, 0.5, 3.3, 9.0]), bins)
    np.testing.assert_allclose(
        got, [[1, 0, 0], [1, 0, 0], [0.25, 0.75, 0], [0, 1, 0], [0, 0.2, 0.8], [0, 0, 1]], atol=1e-6
    )


@pytest.mark.parametrize("count", [40, 255])
def test_mean_of_equal_logits_is_exactly_zero_and_mirrored_logits_mirror_it(count):
    bins = symexp_bins(count)
    mean = jax.jit(twohot_mean)
    np.testing.assert_array_equal(mean(jnp.zeros((7, 3, count)), bins), 0.0)
    logits = jax.random.normal(jax.random.key(0), (50, count))
    np.testing.assert_allclose(mean(logits, bins), -mean(logits[:, ::-1], bins), rtol=1e-5)


def test_mean_is_the_expectation():
    logits = np.random.default_rng(1).normal(size=(20, 255))
    logits[:, 90:165] += 30  # the mass lies within about +-400
    probs = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    np.testing.assert_allclose(
        twohot_mean(jnp.asarray(logits, jnp.float32), jnp.asarray(BINS)),
        probs @ BINS.astype(np.float64),
        rtol=1e-3,
        atol=1e-3,
    )
    asymmetric = jnp.asarray([-1.0, 0.5, 4.0])
    np.testing.assert_allclose(twohot_mean(jnp.log(jnp.asarray([0.2, 0.3, 0.5])), asymmetric), 1.95, rtol=1e-5)


def test_loss_is_the_cross_entropy_and_its_gradient_softmax_minus_weights():
    rng = np.random.default_rng(2)
    logits, target = rng.normal(size=(4, 5, 255)).astype(np.float32), (rng.normal(size=(4, 5)) * 30).astype(np.float32)
    probs = np.exp(logits.astype(np.float64))
    probs /= probs.sum(-1, keepdims=True)
    weights = oracle(target.ravel(), BINS).reshape(probs.shape)
    loss = twohot_loss(jnp.asarray(logits), jnp.asarray(target), jnp.asarray(BINS))
    np.testing.assert_allclose(loss, -(weights * np.log(probs)).sum(-1), rtol=1e-5)
    to_logits, to_target = jax.grad(lambda *x: twohot_loss(*x, jnp.asarray(BINS)).sum(), argnums=(0, 1))(
        jnp.asarray(logits), jnp.asarray(target)
    )
    np.testing.assert_allclose(to_logits, probs - weights, atol=2e-5)
    assert not np.asarray(to_target).any()


def test_minimising_the_loss_recovers_the_target():
    target = jnp.asarray([-120.0, 0.0, 0.3, 5000.0])
    logits = jnp.log(twohot_encode(target, symexp_bins()) + 1e-20)
    np.testing.assert_allclose(twohot_mean(logits, symexp_bins()), target, rtol=1e-4, atol=1e-4)


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="expected logits of shape"):
        twohot_loss(jnp.zeros((3, 255)), jnp.zeros((4,)), symexp_bins())
