"""Pixels rearranged and scaled."""

import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.nets import pixels


@pytest.mark.parametrize("side", [2, 3])
def test_each_square_of_pixels_is_one_vector_and_back(side):
    image = np.arange(2 * 6 * 12 * 2, dtype=np.float32).reshape(2, 6, 12, 2)
    squares = np.asarray(pixels.space_to_depth(jnp.asarray(image), side))
    assert squares.shape == (2, 6 // side, 12 // side, side * side * 2)
    for n, row, column in np.ndindex(squares.shape[:3]):
        square = image[n, side * row : side * (row + 1), side * column : side * (column + 1)]
        np.testing.assert_array_equal(squares[n, row, column], square.ravel())
    np.testing.assert_array_equal(pixels.depth_to_space(jnp.asarray(squares), side), image)


def test_squares_that_reach_over_the_edge_are_filled_with_zeros():
    image = np.ones((1, 3, 5, 1), np.uint8)
    squares = np.asarray(pixels.space_to_depth(jnp.asarray(image), 2))
    assert squares.shape == (1, 2, 3, 4)
    assert squares.sum() == image.sum()
    np.testing.assert_array_equal(squares[0, 1, 2], [1, 0, 0, 0])


def test_bytes_are_centred_and_floats_taken_as_they_are():
    got = pixels.centred(jnp.asarray([0, 255], jnp.uint8))
    np.testing.assert_allclose(got, [-0.5, 0.5])
    assert got.dtype == jnp.float32
    given = jnp.asarray([0.25, 7.0], jnp.bfloat16)
    assert pixels.centred(given) is given
