"""The posterior along sequences, and what the model's losses are computed from and train."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.agents.dreamer import world_model
from ne_dreamer_jax.agents.dreamer.world_model import WorldModelConfig
from ne_dreamer_jax.losses import balanced_kl, symexp_bins, twohot_loss
from ne_dreamer_jax.nets.rssm import RSSM
from ne_dreamer_jax.types import PolicyState, TimeStep
from tests import tiny
from tests.tiny import assert_same

pytestmark = pytest.mark.usefixtures("quick_compilation")

KEY = jax.random.key(5)
DISCOUNT = 0.9


@pytest.fixture(scope="module", params=["continuous", "discrete"])
def model(request):
    spec = {"continuous": tiny.VECTORS, "discrete": tiny.DISCRETE}[request.param]
    nets = tiny.networks(spec)
    batch = tiny.batch(spec)
    rollout = jax.jit(lambda params, batch: world_model.posterior_rollout(nets, params, KEY, batch))
    params = tiny.params(nets)
    return SimpleNamespace(nets=nets, params=params, batch=batch, rollout=rollout, out=rollout(params, batch))


def test_a_rollout_holds_actions_as_the_models_see_them(model):
    rollout, logits = model.out
    batch = model.batch
    for got, raw in ((rollout.action, batch.action), (rollout.prev_action, batch.prev_action)):
        if model.nets.spec is tiny.DISCRETE:
            want = np.eye(3, dtype=np.float32)[np.asarray(raw)]
        else:
            assert np.abs(raw).max() > 1
            want = np.clip(raw, -1, 1)
        if got is rollout.prev_action:
            want = np.where(np.asarray(batch.is_first)[..., None], 0, want)
        np.testing.assert_array_equal(got, want)
    assert rollout.embedding.shape == (2, 5, model.nets.embedding)
    assert rollout.feature.shape == (2, 5, model.nets.feature)
    assert logits.shape == (2, 5, 4, 4)
    assert_same(rollout.batch, batch)


def test_acting_takes_the_same_step_as_learning(model):
    batch = jax.tree.map(lambda x: x[:, :1], model.batch._replace(context=()))._replace(context=model.batch.context)
    want = model.rollout(model.params, batch)[0].latent
    policy = PolicyState(batch.context, batch.prev_action[:, 0])
    row = jax.tree.map(lambda x: x[:, 0], batch._replace(context=()))
    timestep = TimeStep(row.obs, row.reward, row.is_first, row.is_last, row.is_terminal)
    got = jax.jit(lambda params: world_model.posterior_step(model.nets, params, KEY, policy, timestep))(model.params)
    np.testing.assert_allclose(got.deter, want.deter[:, 0], atol=1e-5)
    np.testing.assert_array_equal(got.stoch, want.stoch[:, 0])


def test_binary_cross_entropy_equals_its_definition():
    logit = np.asarray([-30.0, -2.0, 0.0, 3.0, 30.0], np.float32)
    for target in (0.0, 0.3, 0.997, 1.0):
        p = 1 / (1 + np.exp(-logit.astype(np.float64)))
        want = -(target * np.log(p) + (1 - target) * np.log1p(-p + 1e-300))
        got = world_model.binary_cross_entropy(jnp.asarray(logit), jnp.full(5, target))
        np.testing.assert_allclose(got[:4], want[:4], rtol=1e-5)
        assert np.isfinite(got).all()


@pytest.fixture(scope="module")
def losses(model):
    """(params, batch) -> losses, metrics, and the gradient of every loss for the parameters."""
    nets, config = model.nets, WorldModelConfig(free_nats=0.01, kl_unimix=0.1)

    def compute(params, batch):
        rollout, posterior = world_model.posterior_rollout(nets, params, KEY, batch)
        return world_model.prediction_losses(nets, config, params, rollout, posterior, DISCOUNT)

    @jax.jit
    def run(params, batch):
        values, metrics = compute(params, batch)
        return values, metrics, jax.jacrev(lambda p: compute(p, batch)[0])(params)

    return run


def test_losses_are_means_of_what_the_heads_say_of_each_step(model, losses):
    batch = model.batch
    values, metrics, _ = losses(model.params, batch)
    rollout, posterior = model.out
    assert tuple(sorted(values)) == tuple(sorted(world_model.LOSSES))

    prior = model.nets.rssm.apply({"params": model.params["rssm"]}, rollout.latent.deter, method=RSSM.prior)
    dynamics, representation = balanced_kl(posterior, prior, 0.01, 0.1)
    np.testing.assert_allclose(values["dynamics"], dynamics.mean(), rtol=1e-4)
    np.testing.assert_allclose(values["representation"], representation.mean(), rtol=1e-4)
    np.testing.assert_allclose(metrics["kl"], balanced_kl(posterior, prior, 0.0, 0.1)[0].mean(), rtol=1e-4)

    logits = model.nets.apply("reward", model.params, rollout.feature)
    want = twohot_loss(logits, batch.reward, symexp_bins(15)).mean()  # the reward ON ARRIVAL at the step
    np.testing.assert_allclose(values["reward"], want, rtol=1e-4)

    logit = np.asarray(model.nets.apply("continue", model.params, rollout.feature)[..., 0], np.float64)
    target = np.where(batch.is_terminal, 0.0, DISCOUNT)
    want = np.mean(np.logaddexp(0, logit) - target * logit)
    np.testing.assert_allclose(values["continue"], want, rtol=1e-4)
    assert np.asarray(batch.is_terminal).any()


def test_every_loss_trains_its_own_part_and_the_representation(model, losses):
    gradients = losses(model.params, model.batch)[2]
    trained = {name: {part for part, g in tree.items() if not tiny.is_zero(g)} for name, tree in gradients.items()}
    assert trained == {
        "dynamics": {"encoder", "rssm"},  # the encoder by way of earlier samples
        "representation": {"encoder", "rssm"},
        "reward": {"encoder", "rssm", "reward"},
        "continue": {"encoder", "rssm", "continue"},
    }


def test_the_two_sides_of_the_kl_train_prior_and_posterior(model, losses):
    gradients = losses(model.params, model.batch)[2]
    # The layers behind a step's own logits: the other side is a constant to each loss.
    assert tiny.is_zero(gradients["representation"]["rssm"]["prior_out"])
    assert not tiny.is_zero(gradients["dynamics"]["rssm"]["prior_out"])
    assert not tiny.is_zero(gradients["representation"]["rssm"]["posterior_out"])


def test_nothing_of_another_episode_reaches_a_step(model):
    base, _ = model.out  # the second row begins an episode at its step 2
    batch = model.batch
    changed = batch._replace(
        obs={name: x.at[1, :2].set(jnp.ones_like(x[1, :2])) for name, x in batch.obs.items()},
        prev_action=batch.prev_action.at[1, :3].set(jnp.zeros_like(batch.prev_action[1, :3])),
        context=tiny.latent((2,), 9),
    )
    other, _ = model.rollout(model.params, changed)
    assert np.any(other.feature[1, :2] != base.feature[1, :2])
    for name in ("feature", "embedding", "prev_action"):
        np.testing.assert_array_equal(getattr(other, name)[1, 2:], getattr(base, name)[1, 2:])
    assert_same(jax.tree.map(lambda x: x[1, 2:], other.latent), jax.tree.map(lambda x: x[1, 2:], base.latent))
