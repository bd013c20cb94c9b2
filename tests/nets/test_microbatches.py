"""A batch that goes through a function in parts: the same results and gradients, with less kept for them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.nets.microbatches import in_microbatches

pytestmark = pytest.mark.usefixtures("quick_compilation")

RNG = np.random.default_rng(0)
KERNEL = jnp.asarray(RNG.normal(size=(3, 4)), jnp.float32)
ROWS, OTHERS = (jnp.asarray(RNG.normal(size=(6, 5, 3)), jnp.float32) for _ in range(2))


def function(kernel):
    """Of rows [n, 5, 3] and others [5, n, 3]: [n, 5, 4], and a dict of [5, n]."""

    def call(rows, others):
        return jnp.tanh(rows @ kernel), {"product": jnp.sum(jnp.swapaxes(rows, 0, 1) * others, axis=-1)}

    return call


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_results_and_gradients_are_those_of_the_whole(count):
    others = jnp.swapaxes(OTHERS, 0, 1)

    def total(kernel, rows, count):
        out, named = in_microbatches(function(kernel), count, (0, 1), (0, 1))(rows, others)
        return jnp.sum(out**2) + jnp.sum(named["product"] ** 3), (out, named)

    (_, want), gradients = jax.value_and_grad(total, (0, 1), has_aux=True)(KERNEL, ROWS, 1)
    (_, got), in_parts = jax.jit(jax.value_and_grad(total, (0, 1), has_aux=True), static_argnums=2)(KERNEL, ROWS, count)
    for a, b in zip(jax.tree.leaves((got, in_parts)), jax.tree.leaves((want, gradients)), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-5)


def test_a_part_takes_every_nth_row():
    """So that each device of a mesh has its share of every part."""
    seen = in_microbatches(lambda x: jnp.broadcast_to(jnp.max(x), x.shape), 2)(jnp.arange(6.0))
    np.testing.assert_array_equal(seen, [4, 5, 4, 5, 4, 5])


def test_less_is_kept_for_the_gradient():
    """Of a deep function the activations of a part, not of the batch."""
    kernels, rows = jnp.ones((20, 64, 64)), jnp.ones((64, 40, 64))

    def deep(rows):
        for kernel in kernels:
            rows = jnp.tanh(rows @ kernel)
        return rows

    def temporary(count):
        loss = lambda rows: jnp.sum(in_microbatches(deep, count)(rows) ** 2)
        return jax.jit(jax.grad(loss)).lower(rows).compile().memory_analysis().temp_size_in_bytes

    assert temporary(8) < 0.4 * temporary(1)


def test_rows_that_parts_do_not_divide_are_refused():
    with pytest.raises(ValueError, match="expected rows that 4 microbatches divide, got 6"):
        in_microbatches(function(KERNEL), 4, (0, 1), (0, 1))(ROWS, jnp.swapaxes(OTHERS, 0, 1))
