"""Cosine alignment and VICReg over masked sets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.losses import cosine_alignment, vicreg

E = 4
BOTH = pytest.mark.parametrize("loss", [cosine_alignment, vicreg])


def sets(seed=0, shape=(3, 7)):
    rng = np.random.default_rng(seed)
    p, q = (jnp.asarray(rng.normal(size=(*shape, E)).astype(np.float32)) for _ in range(2))
    return p, q, jnp.asarray(rng.uniform(size=shape) < 0.7)


def test_the_cosine_loss_is_the_squared_distance_of_unit_vectors():
    p, q, mask = (np.asarray(x) for x in sets())
    unit = lambda x: x / np.linalg.norm(x, axis=-1, keepdims=True)
    want = np.square(unit(p) - unit(q)).sum(-1)[mask].mean()
    np.testing.assert_allclose(cosine_alignment(*sets())[0], want, rtol=1e-5)
    np.testing.assert_allclose(cosine_alignment(3 * p, p / 2)[0], 0.0, atol=1e-5)  # length is of no consequence


def test_vicreg_is_its_three_terms():
    p, q, mask = (np.asarray(x, np.float64) if x.dtype != bool else np.asarray(x) for x in sets())
    p, q = 0.4 * p[mask], q[mask]
    covariance = np.cov(p.T)
    own = np.diag(covariance)
    terms = [
        np.square(p - q).mean(),
        np.maximum(0, 1 - np.sqrt(own + 1e-4)).mean(),
        (np.square(covariance).sum() - np.square(own).sum()) / E,
    ]
    assert min(terms) > 0
    prediction, target, masked = sets()
    got, metrics = vicreg(0.4 * prediction, target, masked, 2.0, 3.0, 5.0)
    np.testing.assert_allclose(got, np.dot([2, 3, 5], terms), rtol=1e-4)
    np.testing.assert_allclose([metrics[n] for n in ("invariance", "variance", "covariance")], terms, rtol=1e-4)


def test_vicreg_is_worse_for_what_has_collapsed():
    p, _, _ = sets()
    collapsed = jnp.zeros_like(p)
    assert vicreg(collapsed, collapsed)[0] > vicreg(2 * p, 2 * p)[0]


@BOTH
def test_pairs_outside_the_set_count_for_nothing(loss):
    p, q, mask = sets()
    spoilt = jnp.where(mask[..., None], p, 1e4)
    value = lambda p: loss(p, q, mask)[0]
    np.testing.assert_allclose(value(spoilt), value(p), rtol=1e-6)
    gradient = jax.grad(value)(spoilt)
    assert not np.any(gradient[~mask])
    assert np.all(np.any(gradient[mask], axis=-1))
    assert loss(p, q, mask)[1]["pairs"] == float(mask.sum())
    np.testing.assert_allclose(loss(p, q)[0], loss(p, q, jnp.ones((3, 7), bool))[0])


@BOTH
def test_an_empty_set_gives_nothing(loss):
    p, q, mask = sets()
    value, gradient = jax.value_and_grad(lambda p: loss(p, q, jnp.zeros_like(mask))[0])(p)
    assert value == 0
    assert not np.any(gradient)


@BOTH
def test_shapes_that_do_not_agree_are_refused(loss):
    p, q, mask = sets()
    with pytest.raises(ValueError, match="of one shape"):
        loss(p, q[:2])
    with pytest.raises(ValueError, match="expected a mask of shape"):
        loss(p, q, mask[:2])
