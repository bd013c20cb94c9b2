"""Categorical KL terms against scipy, and their clipping and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats

from ne_dreamer_jax.losses import balanced_kl, categorical_kl, unimix_logits


def logits(seed, shape=(3, 4, 6, 5), scale=2.0):
    return (scale * np.random.default_rng(seed).normal(size=shape)).astype(np.float32)


def mixed(x, mix):
    return (1 - mix) * scipy.special.softmax(x.astype(np.float64), -1) + mix / x.shape[-1]


@pytest.mark.parametrize("mix", [0.0, 0.01, 1.0])
def test_unimix_mixes_probabilities(mix):
    x = logits(0)
    out = unimix_logits(jnp.asarray(x), mix)
    np.testing.assert_allclose(np.exp(out), mixed(x, mix), rtol=1e-5)
    assert out.dtype == jnp.float32


def test_unimix_bounds_the_probabilities_of_extreme_logits():
    out = unimix_logits(jnp.asarray([1e4, 0.0, -1e4, 0.0]))
    np.testing.assert_allclose(np.exp(out), [0.9925, 0.0025, 0.0025, 0.0025], rtol=1e-5)


@pytest.mark.parametrize("mix", [-0.1, 1.5])
def test_a_mix_that_is_no_share_is_refused(mix):
    with pytest.raises(ValueError, match="expected a mix from 0 to 1"):
        unimix_logits(jnp.zeros(3), mix)


def test_categorical_kl_equals_scipy_and_ignores_normalisation():
    p, q = logits(1), logits(2)
    want = scipy.stats.entropy(mixed(p, 0), mixed(q, 0), axis=-1)
    np.testing.assert_allclose(categorical_kl(jnp.asarray(p + 3), jnp.asarray(q - 1)), want, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(categorical_kl(jnp.asarray(p), jnp.asarray(p)), 0, atol=1e-6)


def test_a_class_that_is_masked_adds_nothing_to_the_divergence_nor_to_its_gradients():
    p, q = jnp.asarray([0.3, -0.2, -jnp.inf]), jnp.asarray([-1.0, 0.5, -jnp.inf])
    value, gradients = jax.value_and_grad(categorical_kl, argnums=(0, 1))(p, q)
    want, expected = jax.value_and_grad(categorical_kl, argnums=(0, 1))(p[:2], q[:2])
    np.testing.assert_allclose(value, want, rtol=1e-6)
    for gradient, without in zip(gradients, expected, strict=True):
        np.testing.assert_allclose(gradient, [*without, 0.0], rtol=1e-5, atol=1e-7)
    assert categorical_kl(jnp.zeros(3), q) == jnp.inf
    assert categorical_kl(jnp.asarray([0.0, 0.0, -200.0]), q) == jnp.inf, "however improbable"
    for broken in (jnp.nan, jnp.inf):
        assert jnp.isnan(categorical_kl(jnp.asarray([broken, 0.0, 1.0]), jnp.zeros(3)))
        assert jnp.isnan(categorical_kl(jnp.asarray([broken, 0.0, 1.0]), q))


@pytest.mark.parametrize("unimix", [0.0, 0.01])
def test_balanced_kl_sums_over_latents_and_clips_after_the_sum(unimix):
    posterior, prior = logits(3, scale=0.7), logits(4, scale=0.7)
    each = scipy.stats.entropy(mixed(posterior, unimix), mixed(prior, unimix), axis=-1)
    total = each.sum(-1)
    free = float(np.median(total))  # above every single latent's KL, and between the sums
    assert (each < free).all()
    dynamics, representation = balanced_kl(jnp.asarray(posterior), jnp.asarray(prior), free, unimix)
    assert dynamics.shape == (3, 4)
    np.testing.assert_allclose(dynamics, np.maximum(total, free), rtol=1e-4)
    np.testing.assert_array_equal(dynamics, representation)


def test_each_direction_trains_its_own_side_and_only_above_the_free_nats():
    posterior, prior = jnp.asarray(logits(5, scale=0.7)), jnp.asarray(logits(6, scale=0.7))
    total = np.asarray(balanced_kl(posterior, prior, 0.0)[0])
    free = float(np.median(total))

    def grads(which):
        return jax.grad(lambda q, p: balanced_kl(q, p, free)[which].sum(), argnums=(0, 1))(posterior, prior)

    for which, trained, still in ((0, 1, 0), (1, 0, 1)):
        out = grads(which)
        assert not np.asarray(out[still]).any()
        np.testing.assert_array_equal(np.asarray(out[trained]).any((-1, -2)), total > free)


def test_gradients_equal_the_closed_form():
    """Without mixing: d KL(q||p) / d prior logits = p - q; d / d posterior logits = q (log q/p - KL)."""
    posterior, prior = logits(7, (2, 3, 4)), logits(8, (2, 3, 4))
    q, p = mixed(posterior, 0), mixed(prior, 0)
    kl = scipy.stats.entropy(q, p, axis=-1)[..., None]
    for which, argument, want in ((0, 1, p - q), (1, 0, q * (np.log(q / p) - kl))):
        grad = jax.grad(lambda *x, which=which: balanced_kl(*x, 0.0, 0.0)[which].sum(), argument)(
            jnp.asarray(posterior), jnp.asarray(prior)
        )
        np.testing.assert_allclose(grad, want, rtol=1e-3, atol=1e-5)


def test_mixing_keeps_impossible_events_finite():
    posterior, prior = jnp.asarray([[[500.0, 0.0, 0.0]]]), jnp.asarray([[[0.0, 0.0, 500.0]]])
    dynamics, representation = balanced_kl(posterior, prior)
    assert float(dynamics[0]) == pytest.approx(0.99 * np.log(0.99 * 300 + 1), rel=1e-4)
    grad = jax.grad(lambda q, p: sum(x.sum() for x in balanced_kl(q, p)), argnums=(0, 1))(posterior, prior)
    assert np.isfinite(np.asarray(grad)).all()
    assert representation.dtype == jnp.float32
