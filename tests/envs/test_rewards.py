"""tolerance against dm_control's."""

import hypothesis
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
from dm_control.utils import rewards as oracle

from ne_dreamer_jax.envs.dmc.rewards import tolerance

finite = st.floats(-20, 20, width=32, allow_subnormal=False)  # XLA counts subnormal numbers as zero


@pytest.mark.parametrize("sigmoid", ["gaussian", "linear", "quadratic"])
@hypothesis.settings(deadline=None, max_examples=100)
@hypothesis.given(
    x=st.lists(finite, min_size=1, max_size=8),
    ends=st.tuples(finite, finite).map(sorted),
    half_open=st.booleans(),
    margin=st.one_of(st.just(0.0), st.floats(0.05, 10)),
    value=st.floats(0.01, 0.95),
)
def test_tolerance_equals_dm_controls(sigmoid, x, ends, half_open, margin, value):
    x = np.array(x, np.float32)
    bounds = (ends[0], np.inf) if half_open else tuple(ends)
    ours = tolerance(jnp.asarray(x), bounds, margin, sigmoid, value)
    theirs = oracle.tolerance(x.astype(np.float64), bounds, margin, sigmoid, value)
    assert ours.dtype == jnp.float32
    np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_tolerance_includes_the_ends_of_the_interval():
    np.testing.assert_array_equal(tolerance(jnp.array([0.995, 1.0, 1.0001, 0.994]), (0.995, 1.0)), [1, 1, 0, 0])


def test_linear_tolerance_may_reach_zero_at_the_margin():
    value = tolerance(jnp.array([0.0, -5.0, -10.0, -30.0]), (0.0, jnp.inf), 10.0, "linear", 0.0)
    np.testing.assert_allclose(value, [1.0, 0.5, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"bounds": (1.0, 0.0)}, "in that order"),
        ({"margin": -1.0}, "margin >= 0"),
        ({"sigmoid": "cubic"}, "gaussian.*linear.*quadratic.*got 'cubic'"),
        ({"margin": 1.0, "value_at_margin": 0.0}, "value_at_margin"),
        ({"margin": 1.0, "value_at_margin": 1.0}, "value_at_margin"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        tolerance(jnp.zeros(()), **arguments)
