"""Products are counted as by hand."""

import jax
import jax.numpy as jnp

from benchmarks.arithmetic import product_flops


def test_products_are_counted_in_scans_gradients_and_branches():
    a, b = jnp.ones((3, 4)), jnp.ones((4, 5))
    product = 2 * 3 * 4 * 5
    assert product_flops(jnp.matmul, a, b) == product
    assert product_flops(jax.grad(lambda a, b: jnp.square(a @ b).sum(), (0, 1)), a, b) == 3 * product
    square = jnp.ones((4, 4))
    scan = lambda x: jax.lax.scan(lambda carry, _: (carry @ square, None), x, length=7)[0]
    assert product_flops(jax.jit(scan), a) == 7 * 2 * 3 * 4 * 4
    branch = lambda a: jax.lax.cond(a[0, 0] > 0, lambda a: a @ square @ square, lambda a: a @ square, a)
    assert product_flops(branch, a) == 2 * 2 * 3 * 4 * 4
    batched = jax.vmap(jnp.matmul, (0, None))
    assert product_flops(batched, jnp.ones((6, 3, 4)), b) == 6 * product


def test_a_convolution_counts_its_kernel_once_for_each_output():
    images, kernel = jnp.ones((2, 8, 8, 3)), jnp.ones((5, 5, 3, 7))
    convolve = lambda x, k: jax.lax.conv_general_dilated(
        x, k, (2, 2), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    assert product_flops(convolve, images, kernel) == 2 * (2 * 4 * 4 * 7) * (5 * 5 * 3)
