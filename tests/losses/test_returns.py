"""Lambda-returns against plain recursions, and return percentiles against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.losses import lambda_returns, return_scale, update_percentiles


def recursion(reward, value, discount, lam, is_last=None):
    """The docstring's recursion, step by step in float64."""
    reward, value, discount = (np.asarray(x, np.float64) for x in (reward, value, discount))
    out = np.zeros((*reward.shape[:-1], reward.shape[-1] - 1))
    following = value[..., -1]
    for t in reversed(range(out.shape[-1])):
        chain = lam * (1.0 - is_last[..., t + 1]) if is_last is not None else lam
        mixed = (1 - chain) * value[..., t + 1] + chain * following
        following = out[..., t] = reward[..., t + 1] + discount[..., t + 1] * mixed
    return out


def trajectories(seed, shape):
    rng = np.random.default_rng(seed)
    return [x.astype(np.float32) for x in (rng.normal(size=shape), rng.normal(size=shape) * 10, rng.random(shape))]


@pytest.mark.parametrize("steps", [2, 3, 16, 65])
@pytest.mark.parametrize("with_last", [False, True])
def test_equals_the_recursion(steps, with_last):
    compiled = jax.jit(lambda_returns)
    for seed, lam in enumerate([0.0, 0.5, 0.95, 1.0]):
        reward, value, discount = trajectories(seed, (2, 3, steps))
        is_last = np.random.default_rng(seed).random(reward.shape) < 0.2 if with_last else None
        got = compiled(reward, value, discount, jnp.float32(lam), is_last)
        assert got.shape == (2, 3, steps - 1)
        np.testing.assert_allclose(got, recursion(reward, value, discount, lam, is_last), rtol=1e-4, atol=1e-4)


def test_monte_carlo_and_one_step_limits():
    reward, value, discount = trajectories(0, (6,))
    inputs = [jnp.asarray(x) for x in (reward, value, discount)]
    monte_carlo = sum(reward[k] * np.prod(discount[1:k]) for k in range(1, 6)) + np.prod(discount[1:]) * value[5]
    np.testing.assert_allclose(lambda_returns(*inputs, lam=1.0)[0], monte_carlo, rtol=1e-5)
    np.testing.assert_allclose(lambda_returns(*inputs, lam=0.0), reward[1:] + discount[1:] * value[1:], rtol=1e-5)


def test_last_cuts_the_chain_and_terminal_cuts_the_value():
    """Two episodes in one sequence; steps 0 1 2 | 3 4 5, the first one ending at step 2."""
    reward, value, _ = trajectories(1, (6,))
    last = np.asarray([0, 0, 1, 0, 0, 0], bool)
    for terminal in (False, True):
        discount = 0.9 * (1.0 - (last & terminal)).astype(np.float32)
        out = lambda_returns(*map(jnp.asarray, (reward, value, discount)), 0.8, jnp.asarray(last))
        arrival = reward[2] + (0.0 if terminal else 0.9 * value[2])
        np.testing.assert_allclose(out[1], arrival, rtol=1e-5)
        np.testing.assert_allclose(out[0], reward[1] + 0.9 * (0.2 * value[1] + 0.8 * arrival), rtol=1e-5)
        alone = lambda_returns(*(jnp.asarray(x[3:]) for x in (reward, value, discount)), 0.8)
        np.testing.assert_allclose(out[3:], alone, rtol=1e-5)


def test_first_reward_and_discount_are_not_used():
    inputs = [jnp.asarray(x) for x in trajectories(2, (4, 9))]
    grads = jax.grad(lambda *x: lambda_returns(*x).sum(), argnums=(0, 1, 2))(*inputs)
    for grad in grads:
        assert not np.asarray(grad)[:, 0].any()
        assert np.asarray(grad)[:, 1:].all()


def test_gradient_equals_finite_differences():
    inputs = trajectories(3, (2, 7))
    grads = jax.grad(lambda *x: jnp.sum(jnp.square(lambda_returns(*x))), argnums=(0, 1, 2))(*map(jnp.asarray, inputs))
    rng = np.random.default_rng(4)
    directions = [rng.normal(size=x.shape) for x in inputs]
    ahead, behind = (
        (recursion(*(x + s * 1e-6 * d for x, d in zip(inputs, directions, strict=True)), 0.95) ** 2).sum()
        for s in (1, -1)
    )
    along = sum((np.asarray(g) * d).sum() for g, d in zip(grads, directions, strict=True))
    np.testing.assert_allclose(along, (ahead - behind) / 2e-6, rtol=1e-3)


@pytest.mark.parametrize("shapes", [((4, 5), (4, 6), (4, 5)), ((4, 1),) * 3, ((),) * 3])
def test_wrong_shapes_are_refused(shapes):
    with pytest.raises(ValueError, match=r"of one shape|of shape .*H >= 1"):
        lambda_returns(*map(jnp.zeros, shapes))


def test_percentiles_follow_numpy_and_average_from_zero():
    rng = np.random.default_rng(5)
    low = high = jnp.zeros(())
    want = np.zeros(2)
    for _ in range(5):
        returns = rng.normal(size=(30, 7)).astype(np.float32) * 4
        low, high = update_percentiles(low, high, jnp.asarray(returns))
        want = 0.99 * want + 0.01 * np.percentile(returns.astype(np.float64), [5, 95])
    np.testing.assert_allclose([low, high], want, rtol=1e-5)
    assert return_scale(low, high) == 1.0
    np.testing.assert_allclose(return_scale(10 * low, 10 * high), 10 * (want[1] - want[0]), rtol=1e-5)


def test_percentiles_and_decay_can_be_chosen_and_carry_no_gradient():
    returns = jnp.arange(101, dtype=jnp.float32)
    low, high = update_percentiles(jnp.zeros(()), jnp.zeros(()), returns, decay=0.0, percentiles=(10.0, 75.0))
    np.testing.assert_allclose([low, high], [10, 75], rtol=1e-5)
    grad = jax.grad(lambda r: return_scale(*update_percentiles(jnp.zeros(()), jnp.zeros(()), r, 0.0)))(returns)
    assert not np.asarray(grad).any()


def test_the_nearest_percentile_is_one_of_the_returns():
    returns = np.random.default_rng(3).normal(size=(13, 8)).astype(np.float32)
    got = update_percentiles(jnp.zeros(()), jnp.zeros(()), jnp.asarray(returns), 0.0, (5.0, 95.0), "nearest")
    ordered = np.sort(returns.ravel())
    np.testing.assert_array_equal(got, [ordered[round(q * 103)] for q in (0.05, 0.95)])
