"""Policies against scipy, and actions on their way between models and environments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ne_dreamer_jax.nets import heads
from ne_dreamer_jax.nets.heads import (
    BoundedNormal,
    Categorical,
    HeadsConfig,
    decode_action,
    encode_action,
    model_action,
    policy,
)
from ne_dreamer_jax.types import ContinuousAction, DiscreteAction

CONTINUOUS, DISCRETE = ContinuousAction(3), DiscreteAction(4)
RNG = np.random.default_rng(0)


def test_a_continuous_policy_is_a_bounded_normal():
    outputs = RNG.normal(0, 3, (5, 6)).astype(np.float32)
    got = policy(HeadsConfig(min_std=0.2, max_std=0.9), CONTINUOUS, jnp.asarray(outputs))
    assert isinstance(got, BoundedNormal)
    mean, std = np.split(outputs.astype(np.float64), 2, axis=-1)
    np.testing.assert_allclose(got.mean, np.tanh(mean), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(got.std, 0.2 + 0.7 / (1 + np.exp(-(std + 2))), rtol=1e-5)
    np.testing.assert_array_equal(got.mode(), got.mean)


def test_bounded_normal_equals_scipy():
    mean, std = RNG.uniform(-1, 1, (5, 3)).astype(np.float32), RNG.uniform(0.1, 1, (5, 3)).astype(np.float32)
    action = RNG.normal(0, 2, (5, 3)).astype(np.float32)
    got, want = BoundedNormal(jnp.asarray(mean), jnp.asarray(std)), stats.norm(mean.astype(np.float64), std)
    np.testing.assert_allclose(got.log_prob(jnp.asarray(action)), want.logpdf(action).sum(-1), rtol=1e-5)
    np.testing.assert_allclose(got.entropy(), want.entropy().sum(-1), rtol=1e-5, atol=1e-6)


def test_bounded_normal_samples_are_raw_and_reparametrised():
    mean, std = jnp.asarray([0.9, -0.5]), jnp.asarray([1.0, 0.2])
    wide = BoundedNormal(*(jnp.broadcast_to(x, (4_000, 2)) for x in (mean, std)))
    sample = np.asarray(wide.sample(jax.random.key(0)))
    assert sample.max() > 1.5
    for i in range(2):
        assert stats.kstest(sample[:, i], stats.norm(mean[i], std[i]).cdf).pvalue > 1e-3
    key = jax.random.key(1)
    noise = jax.random.normal(key, (2,))
    of_mean, of_std = jax.jacobian(lambda m, s: BoundedNormal(m, s).sample(key), argnums=(0, 1))(mean, std)
    np.testing.assert_allclose(of_mean, np.eye(2))
    np.testing.assert_allclose(of_std, np.diag(noise), rtol=1e-6)


def test_a_discrete_policy_is_mixed_with_the_uniform_and_equals_scipy():
    outputs = RNG.normal(0, 5, (6, 4)).astype(np.float32)
    got = policy(HeadsConfig(unimix=0.2), DISCRETE, jnp.asarray(outputs))
    assert isinstance(got, Categorical)
    probs = np.exp(outputs.astype(np.float64))
    probs = 0.8 * probs / probs.sum(-1, keepdims=True) + 0.05
    one_hot = np.eye(4, dtype=np.float32)
    for i in range(4):
        np.testing.assert_allclose(got.log_prob(jnp.tile(one_hot[i], (6, 1))), np.log(probs[:, i]), rtol=1e-4)
    np.testing.assert_allclose(got.entropy(), stats.entropy(probs, axis=-1), rtol=1e-4)
    np.testing.assert_array_equal(got.mode(), one_hot[probs.argmax(-1)])


def test_discrete_samples_follow_their_probabilities():
    probs = np.asarray([0.1, 0.2, 0.3, 0.4])
    logits = jnp.broadcast_to(jnp.asarray(np.log(probs).astype(np.float32)), (20_000, 4))
    sample = np.asarray(Categorical(logits).sample(jax.random.key(0)))
    assert stats.chisquare(sample.sum(0), 20_000 * probs).pvalue > 1e-3


def test_actions_survive_the_way_to_the_models_and_back():
    discrete = jnp.asarray([[0, 3], [2, 1]], jnp.int32)
    np.testing.assert_array_equal(decode_action(DISCRETE, encode_action(DISCRETE, discrete)), discrete)
    assert decode_action(DISCRETE, encode_action(DISCRETE, discrete)).dtype == jnp.int32
    np.testing.assert_array_equal(encode_action(DISCRETE, discrete), np.eye(4)[discrete])
    continuous = jnp.asarray(RNG.uniform(-1, 1, (2, 5, 3)).astype(np.float32))
    np.testing.assert_array_equal(decode_action(CONTINUOUS, encode_action(CONTINUOUS, continuous)), continuous)


@pytest.mark.parametrize("convert", [encode_action, decode_action, model_action])
def test_clipping_can_be_left_out(convert):
    raw = jnp.asarray([[-1.7, 0.3, 2.0]])
    np.testing.assert_array_equal(convert(CONTINUOUS, raw, clip=False), raw)
    assert np.abs(convert(CONTINUOUS, raw)).max() == 1


@pytest.mark.parametrize("convert", [encode_action, decode_action, model_action])
def test_actions_are_clipped_wherever_they_pass(convert):
    raw = jnp.asarray([[-4.3, 0.3, 1.7], [1.0, -1.0, 7.1]])
    np.testing.assert_array_equal(convert(CONTINUOUS, raw), np.clip(raw, -1, 1))


@pytest.mark.parametrize(("action", "size"), [(CONTINUOUS, 3), (DISCRETE, 4)])
def test_what_the_models_see_passes_gradients_unchanged(action, size):
    raw = jnp.linspace(-3.0, 3.0, size)
    np.testing.assert_array_equal(jax.jacobian(lambda x: model_action(action, x))(raw), np.eye(size))


def test_log_probabilities_are_of_the_raw_sample():
    # Clipped first, all samples beyond a bound would have one density.
    normal = BoundedNormal(jnp.asarray([0.9]), jnp.asarray([1.0]))
    assert normal.log_prob(jnp.asarray([1.5])) != normal.log_prob(jnp.asarray([2.5]))


@pytest.mark.parametrize(
    ("head", "layers", "outputs"),
    [
        (heads.reward_head(HeadsConfig(units=8, bins=15), jnp.float32), 1, 15),
        (heads.continue_head(HeadsConfig(units=8, continue_layers=2), jnp.float32), 2, 1),
        (heads.critic_head(HeadsConfig(units=8, bins=15), jnp.float32), 3, 15),
        (heads.actor_head(HeadsConfig(units=8), CONTINUOUS, jnp.float32), 3, 6),
        (heads.actor_head(HeadsConfig(units=8), DISCRETE, jnp.bfloat16), 3, 4),
    ],
)
def test_heads_have_their_layers_and_outputs(head, layers, outputs):
    y, params = jax.eval_shape(lambda: head.init_with_output(jax.random.key(0), jnp.zeros((2, 3, 5))))
    assert y.shape == (2, 3, outputs)
    assert y.dtype == jnp.float32
    assert len(params["params"]["mlp"]) == layers


@pytest.mark.parametrize(
    ("head", "scale"),
    [
        (heads.reward_head(HeadsConfig(units=64), jnp.float32), 0.0),
        (heads.critic_head(HeadsConfig(units=64), jnp.float32), 0.0),
        (heads.continue_head(HeadsConfig(units=64), jnp.float32), 1.0),
        (heads.actor_head(HeadsConfig(units=64), ContinuousAction(32), jnp.float32), 0.01),
    ],
)
def test_the_last_layers_start_at_their_scale(head, scale):
    with jax.disable_jit():
        params = head.init(jax.random.key(3), jnp.zeros((1, 5)))["params"]
    std = np.asarray(params["out"]["kernel"]).std()
    np.testing.assert_allclose(std, scale / 8, rtol=0.25)
    assert not np.any(params["out"]["bias"])
