"""The optimiser against hand-written float64 steps."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ne_dreamer_jax.agents import optim
from ne_dreamer_jax.agents.optim import OptimizerConfig, clip_per_tensor, make
from ne_dreamer_jax.nets.rssm import PARTS_OF_ONE_TENSOR
from tests import tiny

PLAIN = {"agc": math.inf, "warmup": 0, "learning_rate": 0.01}


def run(config, params, gradients):
    """Parameters after each of the gradients."""
    optimizer = make(config)

    @jax.jit
    def step(params, state, gradient):
        updates, state = optimizer.update(gradient, state, params)
        return optax.apply_updates(params, updates), state

    state, out = optimizer.init(params), []
    for gradient in gradients:
        params, state = step(params, state, gradient)
        out.append(params)
    return out


@pytest.mark.parametrize("name", ["adam", "laprop", "laprop_weighted"])
def test_the_actor_has_a_rate_of_its_own(name):
    rng = np.random.default_rng(0)
    params = {part: jnp.asarray(rng.normal(size=3), jnp.float32) for part in ("actor", "critic")}
    gradients = [jax.tree.map(lambda x: jnp.asarray(rng.normal(size=3), jnp.float32), params) for _ in range(3)]
    alike, slower = (run(OptimizerConfig(name, actor_rate_factor=r, **PLAIN), params, gradients) for r in (1.0, 0.25))
    for one, other in zip(alike, slower, strict=True):
        np.testing.assert_array_equal(other["critic"], one["critic"])
        np.testing.assert_allclose(other["actor"] - params["actor"], (one["actor"] - params["actor"]) / 4, rtol=1e-3)


def by_hand(name, params, gradients, lr=0.01, b1=0.9, b2=0.999, eps=1e-20, warmup=1):
    m = v = np.zeros_like(params, np.float64)
    counted = 0.0
    params, out, full = params.astype(np.float64), [], lr
    for t, g in enumerate(np.asarray(gradients, np.float64), 1):
        lr = full * min(1, t / warmup)
        v = b2 * v + (1 - b2) * g**2
        root = np.sqrt(v / (1 - b2**t)) + eps
        if name == "adam":
            m = b1 * m + (1 - b1) * g
            update = m / (1 - b1**t) / root
        elif name == "laprop":
            m = b1 * m + (1 - b1) * g / root
            update = m / (1 - b1**t)
        else:
            m = b1 * m + (1 - b1) * lr * g / root
            counted = b1 * counted + (1 - b1) * lr
            update = m / counted
        params = params - lr * update
        out.append(params)
    return out


@pytest.mark.parametrize("name", ["adam", "laprop"])
def test_equals_hand_written_steps(name):
    rng = np.random.default_rng(0)
    params = rng.normal(size=(3, 4)).astype(np.float32)
    # Scales that change from step to step tell the two rules apart.
    gradients = (rng.normal(size=(8, 3, 4)) * 10.0 ** rng.uniform(-3, 3, size=(8, 1, 1))).astype(np.float32)
    got = run(OptimizerConfig(name, **PLAIN), jnp.asarray(params), [jnp.asarray(g) for g in gradients])
    np.testing.assert_allclose(got, by_hand(name, params, gradients), rtol=1e-4, atol=1e-6)
    other = by_hand("laprop" if name == "adam" else "adam", params, gradients)
    assert np.abs(np.asarray(got[-1]) - other[-1]).max() > 1e-3


@pytest.mark.parametrize("warmup", [0, 5])
def test_a_momentum_weighted_by_the_learning_rate_differs_while_that_rises(warmup):
    rng = np.random.default_rng(0)
    params, gradients = rng.normal(size=5).astype(np.float32), rng.normal(size=(8, 5)).astype(np.float32)
    config = {**PLAIN, "warmup": warmup}
    got, other = (
        run(OptimizerConfig(name, **config), jnp.asarray(params), [jnp.asarray(g) for g in gradients])
        for name in ("laprop_weighted", "laprop")
    )
    np.testing.assert_allclose(got, by_hand("laprop_weighted", params, gradients, warmup=max(warmup, 1)), rtol=1e-5)
    largest = np.abs(np.asarray(got) - np.asarray(other)).max()
    assert largest > 1e-3 if warmup else largest < 1e-6


@pytest.mark.parametrize("name", ["adam", "laprop", "laprop_weighted"])
def test_zero_and_tiny_gradients_give_no_nan(name):
    params = jnp.ones(4)
    zero, *rest = run(
        OptimizerConfig(name, **PLAIN), params, [jnp.zeros(4), jnp.asarray([0.0, 1e-30, 1e-12, 1.0]), jnp.zeros(4)]
    )
    np.testing.assert_array_equal(zero, params)
    for out in rest:
        assert np.isfinite(out).all()
        assert out[0] == 1.0
        assert np.abs(np.asarray(out) - 1.0).max() < 1.0


def test_clipping_is_per_tensor_and_relative_to_its_norm():
    rng = np.random.default_rng(1)
    params = {"large": rng.normal(size=(5, 6)) * 100, "small": rng.normal(size=(5, 6)), "zero": np.zeros(7)}
    gradients = {"large": rng.normal(size=(5, 6)), "small": rng.normal(size=(5, 6)) * 9, "zero": rng.normal(size=7)}
    transform = clip_per_tensor(0.3, 1e-3)
    f32 = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)
    got, _ = transform.update(f32(gradients), transform.init(params), f32(params))
    for name, gradient in gradients.items():
        limit = 0.3 * max(1e-3, np.linalg.norm(params[name]))
        np.testing.assert_allclose(got[name], gradient * min(1, limit / np.linalg.norm(gradient)), rtol=1e-5)
    np.testing.assert_array_equal(got["large"], f32(gradients)["large"])


def test_parts_of_one_tensor_are_clipped_by_the_norm_of_the_whole():
    rng = np.random.default_rng(2)
    gate, own, inputs, gradient = rng.normal(size=(4, 3, 5)).astype(np.float32)
    tree = lambda a, b, c: {"rssm": {"gate_kernel": a, "state_kernel": b, "input_kernel": c}}
    params, gradients = tree(gate, own, inputs), tree(9 * gradient, 9 * gradient, -9 * gradient)
    transform = clip_per_tensor(0.3, 1e-3, optim.whole_tensor)
    got, _ = transform.update(jax.tree.map(jnp.asarray, gradients), transform.init(params), params)
    joined = clip_per_tensor(0.3, 1e-3)
    kernel, grads = (
        np.concatenate([t["rssm"][n] for n in ("state_kernel", "input_kernel")]) for t in (params, gradients)
    )
    want, _ = joined.update(jnp.asarray(grads), joined.init(kernel), kernel)
    parts = np.concatenate([got["rssm"][n] for n in ("state_kernel", "input_kernel")])
    np.testing.assert_allclose(parts, want, rtol=1e-5)
    alone, _ = joined.update(jnp.asarray(9 * gradient), joined.init(gate), gate)
    np.testing.assert_allclose(got["rssm"]["gate_kernel"], alone, rtol=1e-5)


def test_the_names_of_parts_are_those_of_the_recurrence():
    params = tiny.networks(tiny.VECTORS).init(jax.random.key(0))["rssm"]
    assert set(PARTS_OF_ONE_TENSOR) < set(params)


def test_clipping_comes_before_the_moments():
    """A spike that is clipped first leaves a second moment that forgets it."""
    params, gradients = jnp.ones(4), [jnp.full(4, 1e6), *([jnp.full(4, 1e-1)] * 3)]
    clipped = [np.full(4, 0.3), *([np.full(4, 1e-1)] * 3)]  # |params| = 2, limit 0.6, over 4 equal components
    got = run(OptimizerConfig(agc=0.3, warmup=0, learning_rate=1e-3), params, gradients)
    np.testing.assert_allclose(got, by_hand("adam", np.ones(4), clipped, lr=1e-3), atol=2e-6)


def test_zero_gradient_of_a_zero_tensor_is_not_nan():
    transform = clip_per_tensor(0.3, 1e-3)
    got, _ = transform.update(jnp.zeros(3), transform.init(jnp.zeros(3)), jnp.zeros(3))
    np.testing.assert_array_equal(got, 0.0)


@pytest.mark.parametrize("warmup", [0, 1, 4])
def test_warmup_is_linear_and_then_over(warmup):
    config = OptimizerConfig(agc=math.inf, warmup=warmup, learning_rate=0.5)
    got = np.stack(run(config, jnp.zeros(()), [jnp.ones(())] * 7))
    steps = -np.diff(np.concatenate([[0.0], got]))  # a constant gradient makes every Adam update 1
    np.testing.assert_allclose(steps, 0.5 * np.minimum(1, np.arange(1, 8) / max(warmup, 1)), rtol=1e-4)


@pytest.mark.parametrize("name", ["adam", "laprop", "laprop_weighted"])
def test_state_keeps_its_types_under_scan(name):
    params = {"w": jnp.ones((2, 3)), "b": jnp.zeros(3)}
    optimizer = make(OptimizerConfig(name))

    def step(carry, _):
        params, state = carry
        updates, state = optimizer.update(jax.tree.map(jnp.ones_like, params), state, params)
        return (optax.apply_updates(params, updates), state), None

    (params, state), _ = jax.jit(lambda c: jax.lax.scan(step, c, length=3))((params, optimizer.init(params)))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((params, state)))


def test_update_without_parameters_is_refused():
    optimizer = make(OptimizerConfig())
    with pytest.raises(ValueError, match="params"):
        optimizer.update(jnp.ones(3), optimizer.init(jnp.ones(3)))


def test_clipping_takes_trees_of_any_dtype_and_none_at_all():
    transform = clip_per_tensor(0.3, 1e-3)
    params = {"half": jnp.ones((2, 2), jnp.bfloat16), "whole": jnp.ones(())}
    gradients = {"half": jnp.full((2, 2), 4.0, jnp.bfloat16), "whole": jnp.full((), 0.1)}
    got, _ = transform.update(gradients, transform.init(params), params)
    assert got["half"].dtype == jnp.bfloat16
    np.testing.assert_allclose(got["half"].astype(jnp.float32), 0.3, rtol=1e-2)
    np.testing.assert_allclose(got["whole"], 0.1, rtol=1e-6)
    assert transform.update({}, transform.init({}), {})[0] == {}
