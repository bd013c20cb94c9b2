"""A function that runs once compiles with little optimisation where it is a program, and as any other within one."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.system import compilation

KEY = jax.random.key(0)


@pytest.fixture
def made(monkeypatch):
    """The compiled options of each `jax.jit` that was called, and a function to run once."""
    called = []

    def recording(function, *, compiler_options=None):
        jitted = jit(function, compiler_options=compiler_options)

        @functools.wraps(function)
        def call(*args, **options):
            called.append(compiler_options)
            return jitted(*args, **options)

        return call

    jit = jax.jit
    with monkeypatch.context() as patch:
        patch.setattr(jax, "jit", recording)
        draw = compilation.jit_to_run_once(lambda key, scale=1.0: scale * jax.random.normal(key, (3,)))
    return draw, called


def test_alone_it_is_little_optimised(made):
    draw, called = made
    np.testing.assert_allclose(draw(KEY, scale=2.0), 2 * np.asarray(jax.random.normal(KEY, (3,))), rtol=1e-6)
    assert called == [compilation.LITTLE_OPTIMISED]


@pytest.mark.parametrize(
    "within",
    [
        lambda draw: jax.jit(lambda key: draw(key))(KEY),
        lambda draw: jax.jit(lambda x: x + draw(KEY))(jnp.zeros(3)),
        lambda draw: jax.lax.scan(lambda carry, _: (carry + draw(KEY), None), jnp.zeros(3), length=1)[0],
        lambda draw: jax.vmap(draw)(KEY[None])[0],
        lambda draw: jax.grad(lambda scale: jnp.sum(draw(KEY, scale=scale)))(1.0) * jnp.ones(3),
        lambda draw: jax.eval_shape(lambda: draw(KEY)),
    ],
    ids=["jit", "key closed over", "scan", "vmap", "grad", "eval_shape"],
)
def test_in_another_program_it_is_a_plain_jit(made, within):
    draw, called = made
    assert within(draw).shape == (3,)
    assert set(called) == {None}


def test_constants_are_computed_at_once_also_within_another_program():
    """By one program: each operation by itself would compile for itself."""

    def traced(x):
        value = compilation.computed_now(lambda: jnp.arange(3.0) * 2)
        assert isinstance(x, jax.core.Tracer)
        assert not isinstance(value, jax.core.Tracer)
        return x + value

    np.testing.assert_array_equal(jax.jit(traced)(jnp.ones(3)), [1, 3, 5])
