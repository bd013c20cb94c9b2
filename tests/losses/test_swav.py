"""Assignments to prototypes: what Sinkhorn's algorithm balances, and what the cross-entropy wants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.losses import assignment_loss, sinkhorn


def scores(seed=0, shape=(12, 5)):
    return jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32))


def by_scaling(q, iterations):
    """The textbook algorithm on the matrix itself, in double precision."""
    q = np.exp(np.asarray(q, np.float64))
    samples, prototypes = q.shape
    for _ in range(iterations):
        q = q / q.sum(0, keepdims=True) * samples / prototypes
        q = q / q.sum(1, keepdims=True)
    return q


@pytest.mark.parametrize("iterations", [1, 3])
def test_assignments_are_those_of_alternate_scaling(iterations):
    got = sinkhorn(scores(), 0.2, iterations)
    np.testing.assert_allclose(got, by_scaling(scores() / 0.2, iterations), rtol=1e-4)
    np.testing.assert_allclose(got.sum(1), np.ones(12), rtol=1e-5)


def test_iterations_balance_the_prototypes_whatever_they_are_given():
    lopsided = scores() + jnp.asarray([2.0, 0, 0, 0, 0])[None]  # everything prefers the first
    got = sinkhorn(lopsided, 0.5, 50)
    np.testing.assert_allclose(got.sum(0), np.full(5, 12 / 5), rtol=1e-3)


def test_small_epsilons_do_not_overflow():
    assert np.isfinite(sinkhorn(scores(), 1e-3, 3)).all()


def test_the_loss_is_least_where_predictions_are_the_assignments():
    assignment = sinkhorn(scores(1), 0.5)
    at = lambda x: assignment_loss(x, assignment, 0.1)
    exact = 0.1 * jnp.log(assignment)
    entropy = -np.sum(assignment * np.log(assignment), axis=1)
    np.testing.assert_allclose(at(exact), entropy, rtol=1e-4)
    assert (np.asarray(at(exact + 0.1 * scores(2))) > entropy).all()


def test_no_gradient_reaches_the_assignments():
    def loss(x):
        return jnp.sum(assignment_loss(jnp.ones((12, 5)), sinkhorn(x)))

    assert not np.any(jax.grad(loss)(scores()))
    assert not np.any(jax.grad(lambda q: jnp.sum(assignment_loss(scores(), q)))(scores(1)))


def test_shapes_that_differ_are_refused():
    with pytest.raises(ValueError, match="expected scores and assignments of one shape"):
        assignment_loss(scores(), scores(shape=(5, 5)))
