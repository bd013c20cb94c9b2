"""Imagination, and the actor's and critic's losses against a float64 oracle."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ne_dreamer_jax.agents.dreamer import behavior, world_model
from ne_dreamer_jax.agents.dreamer.behavior import BehaviorConfig
from ne_dreamer_jax.losses import lambda_returns, return_scale, symexp_bins, twohot_mean, update_percentiles
from ne_dreamer_jax.nets.heads import policy
from ne_dreamer_jax.nets.rssm import RSSM
from ne_dreamer_jax.types import Latent, ReturnScale
from tests import tiny

pytestmark = pytest.mark.usefixtures("quick_compilation")

KEY = jax.random.key(3)
CONFIG = BehaviorConfig(horizon=3, discount=0.9, lam=0.8, entropy=0.1, slow_scale=0.5, return_decay=0.5)
H, B, T = 3, 2, 5
NOW = jnp.zeros((), jnp.int32)
"""The first update."""
OLD_SCALE = ReturnScale(jnp.asarray(-1.0), jnp.asarray(4.0))


def make(spec, config):
    nets = tiny.networks(spec)
    params, slow = tiny.params(nets), tiny.params(nets, seed=1)["critic"]
    batch = tiny.batch(spec)

    def compute(params, slow, batch, key):
        rollout, _ = world_model.posterior_rollout(nets, params, jax.random.key(0), batch)
        out = behavior.actor_critic_losses(nets, config, params, slow, OLD_SCALE, key, rollout, NOW)
        return out[0], (out, rollout)

    return SimpleNamespace(nets=nets, params=params, slow=slow, batch=batch, compute=compute)


def frozen_trajectory(nets, params, rollout, key):
    """Every replayed state, what is imagined from it, and all features [H + 1, M, F]."""
    start = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout.latent)
    noise = behavior.imagination_noise(nets, key, start.deter.shape[0], H)
    imagined = behavior.imagine(nets, params, noise, start)
    return start, imagined, jnp.concatenate([imagined.seen, imagined.last[None]])


@pytest.fixture(scope="module")
def reinforce():
    """Losses of the score-function actor, their gradients, and what the oracle below needs."""
    model = make(tiny.VECTORS, CONFIG)
    nets = model.nets

    @jax.jit
    def run(params, slow, batch):
        gradients, (out, rollout) = jax.jacrev(lambda p: model.compute(p, slow, batch, KEY), has_aux=True)(params)
        start, trajectory, features = frozen_trajectory(nets, params, rollout, KEY)
        heads = {name: nets.apply(name, params, features) for name in ("actor", "critic", "reward", "continue")}
        heads["slow"] = nets.apply("critic", {"critic": slow}, features)
        replayed = {"critic": nets.apply("critic", params, rollout.feature)}
        replayed["slow"] = nets.apply("critic", {"critic": slow}, rollout.feature)
        rssm = lambda latent, action: nets.rssm.apply(
            {"params": params["rssm"]}, latent, action, method=lambda m, x, a: m.recur(x, m.embed_action(a))
        )
        follows = rssm(start, jnp.clip(trajectory.action[0], -1, 1))
        return gradients, out, rollout, start, trajectory, features, heads, replayed, follows

    names = ("gradients", "out", "rollout", "start", "trajectory", "features", "heads", "replayed", "follows")
    return SimpleNamespace(**dict(zip(names, run(model.params, model.slow, model.batch), strict=True)), **vars(model))


def test_imagination_starts_at_the_replayed_states_and_follows_clipped_actions(reinforce):
    trajectory, features, nets = reinforce.trajectory, reinforce.features, reinforce.nets
    assert features.shape == (H + 1, B * T, nets.feature)
    assert trajectory.action.shape == (H, B * T, 2)
    start = np.asarray(reinforce.rollout.feature).reshape(B * T, -1)
    np.testing.assert_array_equal(features[0], start)
    assert np.abs(trajectory.action).max() > 1  # raw
    np.testing.assert_allclose(features[1][:, 16:], reinforce.follows, atol=1e-5)
    stoch = np.asarray(features[..., :16]).reshape(H + 1, B * T, 4, 4)
    np.testing.assert_array_equal(stoch.sum(-1), 1)


def mean_of(logits):
    """Mean of the two-hot distribution, float64."""
    logits = np.asarray(logits, np.float64)
    p = np.exp(logits - logits.max(-1, keepdims=True))
    return (p / p.sum(-1, keepdims=True)) @ np.asarray(symexp_bins(15), np.float64)


def two_hot(logits, target):
    """Cross-entropy with the two-hot distribution of a number, one at a time."""
    bins = np.asarray(symexp_bins(15), np.float64)
    logits = np.asarray(logits, np.float64)
    log_p = logits - np.logaddexp.reduce(logits, axis=-1)[..., None]
    out = np.empty(target.shape)
    for i in np.ndindex(target.shape):
        k = min(np.searchsorted(bins, target[i], side="right") - 1, len(bins) - 2)
        upper = (target[i] - bins[k]) / (bins[k + 1] - bins[k])
        out[i] = -(1 - upper) * log_p[i][k] - upper * log_p[i][k + 1]
    return out


@pytest.fixture(scope="module")
def oracle(reinforce):
    """Time first, as they were imagined."""
    heads = reinforce.heads
    reward, value, slow = mean_of(heads["reward"]), mean_of(heads["critic"]), mean_of(heads["slow"])
    go_on = CONFIG.discount / (1 + np.exp(-np.asarray(heads["continue"][..., 0], np.float64)))
    returns = [value[H]]
    for t in reversed(range(H)):
        returns.insert(0, reward[t + 1] + go_on[t + 1] * ((1 - 0.8) * value[t + 1] + 0.8 * returns[0]))
    returns = np.stack(returns[:H])  # the last is reward[H] + go_on[H] * value[H]
    weight = np.cumprod(go_on, axis=0)[:H]
    low, high = (0.5 * float(old) + 0.5 * np.percentile(returns, q) for old, q in zip(OLD_SCALE, (5, 95), strict=True))
    return SimpleNamespace(value=value, slow=slow, returns=returns, weight=weight, low=low, high=high)


def test_return_scale_is_a_moving_range_of_percentiles(reinforce, oracle):
    scale = reinforce.out[1]
    np.testing.assert_allclose(scale, (oracle.low, oracle.high), rtol=1e-3)
    assert oracle.high - oracle.low > 1
    np.testing.assert_allclose(reinforce.out[2]["imagined/return_scale"], oracle.high - oracle.low, rtol=1e-3)


def test_actor_loss_equals_the_oracle(reinforce, oracle):
    outputs, raw = (np.asarray(x, np.float64) for x in (reinforce.heads["actor"][:H], reinforce.trajectory.action))
    mean, std = np.split(outputs, 2, axis=-1)
    normal = stats.norm(np.tanh(mean), 0.1 + 0.9 / (1 + np.exp(-(std + 2))))
    advantage = (oracle.returns - oracle.value[:H]) / max(1, oracle.high - oracle.low)
    want = -oracle.weight * (advantage * normal.logpdf(raw).sum(-1) + 0.1 * normal.entropy().sum(-1))
    np.testing.assert_allclose(reinforce.out[0]["actor"], want.mean(), rtol=1e-3)


def test_critic_loss_equals_the_oracle(reinforce, oracle):
    logits = reinforce.heads["critic"][:H]
    want = oracle.weight * (two_hot(logits, oracle.returns) + 0.5 * two_hot(logits, oracle.slow[:H]))
    np.testing.assert_allclose(reinforce.out[0]["critic"], want.mean(), rtol=1e-3)


def test_replayed_critic_loss_equals_the_oracle(reinforce, oracle):
    batch = reinforce.batch
    reward, last, terminal = (np.asarray(x, np.float64) for x in (batch.reward, batch.is_last, batch.is_terminal))
    bootstrap = oracle.returns[0].reshape(B, T)
    returns = bootstrap.copy()
    for t in reversed(range(T - 1)):
        lam = 0.8 * (1 - last[:, t + 1]) if t < T - 2 else 0.0
        ahead = (1 - lam) * bootstrap[:, t + 1] + lam * returns[:, t + 1]
        returns[:, t] = reward[:, t + 1] + 0.9 * (1 - terminal[:, t + 1]) * ahead
    logits, slow = reinforce.replayed["critic"][:, :-1], mean_of(reinforce.replayed["slow"])[:, :-1]
    want = (1 - last[:, :-1]) * (two_hot(logits, returns[:, :-1]) + 0.5 * two_hot(logits, slow))
    assert last[:, :-1].any()
    np.testing.assert_allclose(reinforce.out[0]["replay_critic"], want.mean(), rtol=1e-3)


def trained(gradients):
    return {name: {part for part, g in tree.items() if not tiny.is_zero(g)} for name, tree in gradients.items()}


WHAT_TRAINS_WHAT = {"actor": {"actor"}, "critic": {"critic"}, "replay_critic": {"critic", "encoder", "rssm"}}


def test_imagined_losses_train_actor_and_critic_alone_and_the_replayed_one_the_model_too(reinforce):
    assert tuple(reinforce.out[0]) == behavior.LOSSES
    assert trained(reinforce.gradients) == WHAT_TRAINS_WHAT


@pytest.mark.parametrize("spec", [tiny.VECTORS, tiny.DISCRETE], ids=["continuous", "discrete"])
def test_the_score_functions_gradient_is_that_of_one_batched_actor_on_frozen_trajectories(spec):
    model = make(spec, CONFIG)
    nets = model.nets

    @jax.jit
    def run(params):
        def actor_loss(params):
            losses, (_, rollout) = model.compute(params, model.slow, model.batch, KEY)
            return losses["actor"], rollout

        gradient, rollout = jax.grad(actor_loss, has_aux=True)(params)
        _, trajectory, features = frozen_trajectory(nets, params, rollout, KEY)
        time_last = lambda x: jnp.swapaxes(x, 0, 1)
        bins = symexp_bins(15)
        mean = lambda head: time_last(twohot_mean(nets.apply(head, params, features), bins))
        go_on = CONFIG.discount * time_last(jax.nn.sigmoid(nets.apply("continue", params, features)[..., 0]))
        returns = lambda_returns(mean("reward"), mean("critic"), go_on, CONFIG.lam)
        low, high = update_percentiles(*OLD_SCALE, returns, CONFIG.return_decay, CONFIG.return_percentiles)
        advantage = (returns - mean("critic")[:, :-1]) / return_scale(low, high)
        weight = jnp.cumprod(go_on, axis=1)[:, :-1]

        def loss(actor):
            outputs = nets.apply("actor", {"actor": actor}, features[:-1])
            distribution = policy(nets.heads, spec.action, outputs)
            log_prob = time_last(distribution.log_prob(trajectory.action))
            return jnp.mean(-weight * (advantage * log_prob + CONFIG.entropy * time_last(distribution.entropy())))

        outputs = nets.apply("actor", params, features[:-1])
        return gradient["actor"], jax.grad(loss)(params["actor"]), trajectory.policy, outputs

    got, want, outputs, expected = run(model.params)
    np.testing.assert_allclose(outputs, expected, rtol=1e-4, atol=1e-5)
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-4 * np.abs(y).max())


@pytest.mark.parametrize("spec", [tiny.VECTORS, tiny.DISCRETE], ids=["continuous", "discrete"])
def test_the_dynamics_gradient_comes_through_the_world_model(spec):
    # Without entropy the policy is trained by nothing but the returns that its actions lead to.
    model = make(spec, replace(CONFIG, gradient="dynamics", entropy=0.0))

    @jax.jit
    def run(params, reward_head):
        params = {**params, "reward": reward_head}
        return jax.jacrev(lambda p: model.compute(p, model.slow, model.batch, KEY)[0])(params)

    gradients = run(model.params, model.params["reward"])
    assert trained(gradients) == WHAT_TRAINS_WHAT
    # What the model says of rewards changes it.
    other = run(model.params, tiny.fill(model.params["reward"], seed=4))
    assert not np.allclose(*(g["actor"]["actor"]["out"]["kernel"] for g in (gradients, other)))


@pytest.mark.parametrize("gradient", ["reinforce", "dynamics"])
def test_the_penalty_on_means_draws_them_towards_zero_at_their_own_state(gradient):
    penalty = 0.1
    config = replace(CONFIG, gradient=gradient, mean_penalty=penalty)
    model, without = make(tiny.VECTORS, config), make(tiny.VECTORS, replace(config, mean_penalty=0.0))
    nets = model.nets

    @jax.jit
    def run(params):
        gradients = lambda made: jax.grad(lambda p: made.compute(p, made.slow, made.batch, KEY)[0]["actor"])(params)
        _, (_, rollout) = model.compute(params, model.slow, model.batch, KEY)
        _, _, features = frozen_trajectory(nets, params, rollout, KEY)
        go_on = CONFIG.discount * jax.nn.sigmoid(nets.apply("continue", params, features)[..., 0])

        def loss(actor):
            mean, _ = jnp.split(nets.apply("actor", {"actor": actor}, features[:-1]), 2, axis=-1)
            return penalty * jnp.mean(jnp.cumprod(go_on, axis=0)[:-1, :, None] * jnp.square(mean)) * mean.shape[-1]

        return jax.tree.map(jnp.subtract, gradients(model), gradients(without)), jax.grad(loss)(params["actor"])

    got, want = run(model.params)
    assert set(trained({"actor": got})["actor"]) == {"actor"}
    for x, y in zip(jax.tree.leaves(got["actor"]), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-2, atol=1e-3 * np.abs(y).max())


def test_a_discrete_policy_has_no_means_to_penalise():
    model, without = (make(tiny.DISCRETE, replace(CONFIG, mean_penalty=x)) for x in (1.0, 0.0))
    losses = [jax.jit(lambda m=m: m.compute(m.params, m.slow, m.batch, KEY)[1][0][0])() for m in (model, without)]
    assert losses[0] == losses[1]


def test_the_entropys_gradient_stops_at_its_own_state():
    """Also where the actor is trained through the world model: more entropy later is no reason for an action now."""
    scale = 0.1
    config = replace(CONFIG, gradient="dynamics", entropy=scale)
    model = make(tiny.VECTORS, config)
    without = make(tiny.VECTORS, replace(config, entropy=0.0))
    nets = model.nets

    @jax.jit
    def run(params):
        actor = lambda made: jax.grad(lambda p: made.compute(p, made.slow, made.batch, KEY)[0]["actor"])(params)[
            "actor"
        ]
        _, (_, rollout) = model.compute(params, model.slow, model.batch, KEY)
        _, _, features = frozen_trajectory(nets, params, rollout, KEY)
        go_on = CONFIG.discount * jax.nn.sigmoid(nets.apply("continue", params, features)[..., 0])

        def loss(actor):
            distribution = policy(nets.heads, tiny.VECTORS.action, nets.apply("actor", {"actor": actor}, features[:-1]))
            return jnp.mean(-jnp.cumprod(go_on, axis=0)[:-1] * scale * distribution.entropy())

        return jax.tree.map(jnp.subtract, actor(model), actor(without)), jax.grad(loss)(params["actor"])

    got, want = run(model.params)
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-2, atol=1e-3 * np.abs(y).max())


def test_returns_are_normalised_by_no_less_than_the_floor():
    model = make(tiny.VECTORS, replace(CONFIG, return_floor=1e12))
    metrics = jax.jit(lambda: model.compute(model.params, model.slow, model.batch, KEY)[1][0][2])()
    assert metrics["imagined/return_scale"] == jnp.float32(1e12)


def test_the_discount_is_in_the_head_or_multiplied_outside():
    """Both say gamma times the probability of going on, once each head has learned what it is trained towards."""
    inside, outside = replace(CONFIG, discount_in_head=True), CONFIG
    assert (behavior.head_discount(inside), behavior.head_discount(outside)) == (0.9, 1.0)
    for probability in (0.0, 0.3, 0.999):
        learned = jnp.array([[0.9 * probability], [probability]], jnp.float32)
        logits = jnp.log(learned) - jnp.log1p(-learned)
        for config, logit in zip((inside, outside), logits, strict=True):
            np.testing.assert_allclose(behavior.expected_discount(config, logit), 0.9 * probability, rtol=1e-5)


def test_imagined_returns_are_smaller_where_the_same_head_leaves_the_discount_outside():
    rewards = {}
    for flag in (True, False):
        model = make(tiny.VECTORS, replace(CONFIG, discount_in_head=flag))
        out = jax.jit(lambda model=model: model.compute(model.params, model.slow, model.batch, KEY)[1])()
        rewards[flag] = out[0][0]["critic"]
    assert not np.allclose(rewards[True], rewards[False])


def test_percentiles_are_in_order():
    with pytest.raises(ValueError, match=r"return_percentiles: expected the first below the second, got 95.0 and 5.0"):
        BehaviorConfig(return_percentiles=(95.0, 5.0))


def test_imagined_latents_are_samples_of_the_prior():
    nets = tiny.networks(tiny.VECTORS)
    params = tiny.params(nets)
    start = jax.tree.map(lambda x: jnp.tile(x, (4_000,) + (1,) * (x.ndim - 1)), tiny.latent((1,)))

    @jax.jit
    def step(params, start):
        uniform = jax.random.uniform(KEY, (4_000, 4))
        latent = nets.rssm.apply(
            {"params": params["rssm"]}, start, jnp.zeros((4_000, 2)), uniform, method=RSSM.imagine_step
        )
        return latent, nets.rssm.apply({"params": params["rssm"]}, latent.deter[:1], method=RSSM.prior)

    latent, logits = step(params, start)
    assert isinstance(latent, Latent)
    probs = np.exp(np.asarray(logits[0], np.float64))
    probs = 0.99 * probs / probs.sum(-1, keepdims=True) + 0.01 / 4
    for s in range(4):
        assert stats.chisquare(np.asarray(latent.stoch[:, s]).sum(0), 4_000 * probs[s]).pvalue > 1e-3


@pytest.mark.parametrize("last", [2, T + 1])
def test_behaviour_of_the_last_steps_is_that_of_a_rollout_cut_to_them(last):
    model, kept = make(tiny.VECTORS, CONFIG), min(last, T)
    rollout, _ = world_model.posterior_rollout(model.nets, model.params, jax.random.key(0), model.batch)
    short = jax.tree.map(lambda x: x[:, T - kept :], rollout._replace(batch=rollout.batch._replace(context=None)))

    def losses(config, rollout):
        return jax.jit(
            lambda params: behavior.actor_critic_losses(
                model.nets, config, params, model.slow, OLD_SCALE, KEY, rollout, NOW
            )
        )(model.params)

    got, want = losses(replace(CONFIG, imagine_last=last), rollout), losses(CONFIG, short)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-6, atol=1e-7), got, want)
    if kept < T:
        assert float(got[0]["critic"]) != pytest.approx(float(losses(CONFIG, rollout)[0]["critic"]), rel=1e-3)


def test_the_last_steps_are_the_newest():
    rollout, _ = world_model.posterior_rollout(
        tiny.networks(tiny.VECTORS), tiny.params(tiny.networks(tiny.VECTORS)), KEY, tiny.batch(tiny.VECTORS)
    )
    two = behavior.Replayed.of(rollout, 2)
    np.testing.assert_array_equal(two.latent.deter, rollout.latent.deter[:, [T - 2, T - 1]])
    np.testing.assert_array_equal(two.reward, rollout.batch.reward[:, [T - 2, T - 1]])
