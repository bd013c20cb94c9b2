"""Strict numerics for every test: no silent dtype or rank promotion."""

import gc

import hypothesis
import jax
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# How long an example takes says as much about what else the machine does.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")


@pytest.fixture(scope="module")
def quick_compilation():
    """Compiles with few optimisations: programs that run for milliseconds aren't worth the minutes."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """A module's compiled programs are of no use to the next one, and all of them together take gigabytes."""
    yield
    jax.clear_caches()
    gc.collect()
