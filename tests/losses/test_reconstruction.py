"""Squared errors of observations."""

import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.losses import image_loss, symexp, vector_loss


def test_an_image_is_compared_in_the_unit_interval():
    image = jnp.asarray(np.random.default_rng(0).integers(0, 256, (2, 3, 4, 5, 3)), jnp.uint8)
    exact = image.astype(jnp.float32) / 255
    np.testing.assert_allclose(image_loss(exact, image), np.zeros((2, 3)), atol=1e-10)
    np.testing.assert_allclose(image_loss(exact + 0.5, image), np.full((2, 3), 0.25 * 4 * 5 * 3), rtol=1e-5)


def test_a_vector_is_compared_on_the_symlog_scale():
    scale = jnp.asarray(np.random.default_rng(0).normal(0, 3, (2, 4)).astype(np.float32))
    np.testing.assert_allclose(vector_loss(scale, symexp(scale)), np.zeros(2), atol=1e-10)
    np.testing.assert_allclose(vector_loss(scale + 0.5, symexp(scale)), np.full(2, 0.25 * 4), rtol=1e-4)


def test_shapes_and_types_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="uint8 image of one shape"):
        image_loss(jnp.zeros((4, 4, 3)), jnp.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="uint8 image of one shape"):
        image_loss(jnp.zeros((4, 4, 1)), jnp.zeros((4, 4, 3), jnp.uint8))
    with pytest.raises(ValueError, match="a vector of one shape"):
        vector_loss(jnp.zeros((2, 3)), jnp.zeros((3,)))
