"""Actor and critic losses: values, and which inputs they train."""

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.losses import critic_loss, dynamics_loss, reinforce_loss, symexp_bins, twohot_encode


def arrays(count, shape=(3, 4)):
    return [jax.random.normal(jax.random.key(i), shape) for i in range(count)]


def grads(function, *inputs):
    return [np.asarray(g) for g in jax.grad(lambda *x: function(*x).sum(), tuple(range(len(inputs))))(*inputs)]


def test_reinforce_value_and_gradients():
    log_prob, advantage, entropy, weight = arrays(4)
    loss = reinforce_loss(log_prob, advantage, entropy, weight, 0.1)
    np.testing.assert_allclose(loss, -weight * (advantage * log_prob + 0.1 * entropy), rtol=1e-5, atol=1e-6)
    to_log_prob, to_advantage, to_entropy, to_weight = grads(reinforce_loss, log_prob, advantage, entropy, weight)
    np.testing.assert_allclose(to_log_prob, -weight * advantage, rtol=1e-5)
    np.testing.assert_allclose(to_entropy, -weight * 3e-4, rtol=1e-5)
    assert not to_advantage.any()
    assert not to_weight.any()


def test_reinforce_gradient_estimates_the_policy_gradient():
    """A softmax bandit: averaged over samples, the loss's gradient is minus that of the expected reward."""
    logits, reward = jnp.asarray([0.3, -0.5, 1.0]), jnp.asarray([1.0, 3.0, -2.0])
    actions = jax.random.categorical(jax.random.key(0), logits, shape=(200_000,))

    def loss(logits):
        log_prob = jax.nn.log_softmax(logits)[actions]
        return reinforce_loss(log_prob, reward[actions], jnp.zeros_like(log_prob), jnp.ones_like(log_prob)).mean()

    want = jax.grad(lambda x: jnp.sum(jax.nn.softmax(x) * reward))(logits)
    np.testing.assert_allclose(-jax.grad(loss)(logits), want, atol=0.02)


def test_dynamics_value_and_gradients():
    returns, entropy, weight = arrays(3)
    np.testing.assert_allclose(
        dynamics_loss(returns, entropy, weight, 0.1), -weight * (returns + 0.1 * entropy), rtol=1e-5, atol=1e-6
    )
    to_returns, to_entropy, to_weight = grads(dynamics_loss, returns, entropy, weight)
    np.testing.assert_allclose(to_returns, -weight, rtol=1e-6)
    np.testing.assert_allclose(to_entropy, -weight * 3e-4, rtol=1e-5)
    assert not to_weight.any()


def test_critic_value_and_gradients():
    bins = symexp_bins(15, 5.0)
    logits = jax.random.normal(jax.random.key(9), (3, 4, 15))
    returns, slow_value, weight = arrays(3)
    log_probs = np.asarray(jax.nn.log_softmax(logits), np.float64)
    terms = [-(np.asarray(twohot_encode(x, bins)) * log_probs).sum(-1) for x in (returns, slow_value)]
    loss = critic_loss(logits, returns, slow_value, weight, bins, 0.5)
    np.testing.assert_allclose(loss, np.asarray(weight) * (terms[0] + 0.5 * terms[1]), rtol=1e-4)
    to_logits, *others = grads(lambda *x: critic_loss(*x, bins), logits, returns, slow_value, weight)
    assert to_logits.all()
    assert not any(x.any() for x in others)
