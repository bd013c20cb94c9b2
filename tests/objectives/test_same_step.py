"""R2-Dreamer's objective: which step is aligned to which, what it trains, and what it has not."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.losses import barlow_twins
from ne_dreamer_jax.objectives import Model, SameStep
from ne_dreamer_jax.types import Rollout
from tests import tiny

pytestmark = pytest.mark.usefixtures("quick_compilation")

E, F = 4, 5
MODEL = Model(SimpleNamespace(spec=None, feature=F, embedding=E, dtype=jnp.float32), 6, None)


def make(redundancy=5e-4):
    objective = SameStep(redundancy).build(MODEL)
    return objective, {"objective": tiny.fill(jax.eval_shape(objective.init, jax.random.key(0)))}


def rollout_of(feature, embedding):
    """A rollout with what the objective may read: neither actions nor where episodes begin."""
    return Rollout(None, embedding, None, feature, None, None)


def noise(seed=0, shape=(3, 6)):
    rng = np.random.default_rng(seed)
    return tuple(jnp.asarray(rng.normal(size=(*shape, n)).astype(np.float32)) for n in (F, E))


def test_the_loss_is_barlow_twins_of_a_linear_map_over_all_steps():
    objective, params = make(0.1)
    feature, embedding = noise()
    losses, metrics = objective.loss(params, {}, jax.random.key(0), rollout_of(feature, embedding))
    assert tuple(losses) == tuple(SameStep().losses) == ("same_step",)
    kernel = params["objective"]["projector"]["kernel"]
    assert jax.tree.map(jnp.shape, params) == {"objective": {"projector": {"kernel": (F, E)}}}
    want, details = barlow_twins((feature @ kernel).reshape(-1, E), embedding.reshape(-1, E), None, 0.1)
    np.testing.assert_allclose(losses["same_step"], want, rtol=1e-5)
    assert details["pairs"] == metrics["same_step/pairs"] == 3 * 6


def test_a_state_is_aligned_to_the_embedding_of_its_own_step():
    """Where the embedding is a linear map of the state of the same step the loss vanishes; a step off, it doesn't."""
    objective, params = make(0.0)
    feature, _ = noise(shape=(40, 6))
    embedding = feature @ params["objective"]["projector"]["kernel"]

    def loss(embedding):
        return float(objective.loss(params, {}, jax.random.key(0), rollout_of(feature, embedding))[0]["same_step"])

    assert loss(embedding) < 1e-6
    for offset in (1, -1):
        assert loss(jnp.roll(embedding, offset, axis=1)) > 0.5 * E


def test_gradients_reach_every_state_and_the_projector_but_not_the_embedding():
    objective, params = make()

    def loss(params, feature, embedding):
        return objective.loss(params, {}, jax.random.key(0), rollout_of(feature, embedding))[0]["same_step"]

    of_params, of_feature, of_embedding = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(params, *noise())
    assert not np.any(of_embedding)
    assert np.all(np.any(of_feature, axis=-1))
    assert np.all(of_params["objective"]["projector"]["kernel"])


def test_there_are_no_target_parameters():
    objective, params = make()
    assert objective.init_target(params) == {}
    assert objective.after_update(params, {}, jnp.ones((), jnp.int32)) == {}
