"""What the next-embedding objective is computed from, what it trains, and that it learns what can be predicted."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ne_dreamer_jax.losses import cosine_alignment, next_embedding_loss, vicreg
from ne_dreamer_jax.nets.predictor import Predictor, PredictorConfig
from ne_dreamer_jax.objectives import Model, NextEmbedding
from ne_dreamer_jax.types import ArraySpec, Batch, ContinuousAction, EnvSpec, Rollout
from tests import tiny

pytestmark = pytest.mark.usefixtures("quick_compilation")

A, E, F = 3, 4, 5
SPEC = EnvSpec({"vector": ArraySpec((E,), jnp.float32)}, ContinuousAction(A))
CONFIG = NextEmbedding(PredictorConfig(layers=1, width=16, heads=2, feedforward=16, positions=8))


def model(length):
    """A world model of these sizes; its networks are none of the objective's business."""
    return Model(SimpleNamespace(spec=SPEC, feature=F, embedding=E, dtype=jnp.float32), length, None)


def rollout_of(feature, embedding, action, prev_action, is_first):
    """A rollout with what the objective may read; the rest is absent, and so can't be read."""
    batch = Batch(None, None, None, None, is_first, None, None, None, None)
    return Rollout(batch, embedding, None, feature, action, prev_action)


def noise(seed=0, rows=3, length=6):
    rng = np.random.default_rng(seed)
    feature, embedding, action, prev_action = (
        jnp.asarray(rng.normal(size=(rows, length, n)).astype(np.float32)) for n in (F, E, A, A)
    )
    return rollout_of(feature, embedding, action, prev_action, jnp.asarray(rng.uniform(size=(rows, length)) < 0.2))


def make(**changes):
    config = replace(CONFIG, **changes)
    objective = config.build(model(6))
    params = {"objective": tiny.fill(jax.eval_shape(objective.init, jax.random.key(0)))}
    return config, objective, params


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"shift": 0},
        {"shift": 2, "redundancy": 0.1},
        {"masked": False, "across_episodes": True, "action": "previous"},
    ],
    ids=["default", "no shift", "two steps", "released code"],
)
def test_the_loss_is_of_the_predictor_and_the_settings(changes):
    config, objective, params = make(**changes)
    rollout = noise()
    is_first = rollout.batch.is_first
    losses, metrics = jax.jit(objective.loss)(params, {}, jax.random.key(0), rollout)
    assert tuple(losses) == tuple(config.losses) == ("next_embedding",)
    predictor = Predictor(config.predictor, E, False, config.across_episodes)
    action = rollout.prev_action if changes.get("action") == "previous" else rollout.action
    predicted = predictor.apply({"params": params["objective"]}, rollout.feature, action, is_first)
    want, details = next_embedding_loss(
        predicted, rollout.embedding, is_first, config.redundancy, config.shift, config.masked
    )
    np.testing.assert_allclose(losses["next_embedding"], want, rtol=1e-5)
    assert set(metrics) == {f"next_embedding/{name}" for name in details}


@pytest.mark.parametrize("alignment", ["barlow_twins", "cosine", "vicreg"])
def test_steps_further_ahead_have_outputs_of_their_own_and_weigh_less(alignment):
    config, objective, params = make(steps=3, step_discount=0.5, alignment=alignment)
    rollout = noise()
    losses, metrics = jax.jit(objective.loss)(params, {}, jax.random.key(0), rollout)
    assert params["objective"]["out"]["kernel"].shape == (16, 3 * E)
    predictor = Predictor(config.predictor, E, False, False, jnp.float32, 3)
    predicted = predictor.apply(
        {"params": params["objective"]}, rollout.feature, rollout.action, rollout.batch.is_first
    )
    align = {"barlow_twins": None, "cosine": cosine_alignment, "vicreg": vicreg}[alignment]
    each = [
        next_embedding_loss(
            predicted[..., k * E : (k + 1) * E], rollout.embedding, rollout.batch.is_first, shift=1 + k, align=align
        )
        for k in range(3)
    ]
    want = sum(weight * value for weight, (value, _) in zip((4 / 7, 2 / 7, 1 / 7), each, strict=True))
    np.testing.assert_allclose(losses["next_embedding"], want, rtol=1e-4)
    assert each[0][1]["pairs"] > each[2][1]["pairs"]
    for prefix, (_, details) in zip(("", "2_", "3_"), each, strict=True):
        np.testing.assert_array_equal(metrics[f"next_embedding/{prefix}pairs"], details["pairs"])


def test_there_are_no_target_parameters():
    _, objective, params = make()
    assert objective.init_target(params) == {}
    assert objective.after_update(params, {}, jnp.ones((), jnp.int32)) == {}


def test_gradients_reach_the_features_and_the_predictor_but_not_the_target():
    _, objective, params = make()
    rollout = noise()

    def loss(params, feature, embedding):
        changed = rollout._replace(feature=feature, embedding=embedding)
        return objective.loss(params, {}, jax.random.key(0), changed)[0]["next_embedding"]

    of_params, of_feature, of_embedding = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(
        params, rollout.feature, rollout.embedding
    )
    assert not np.any(of_embedding)
    # The last step predicts what lies beyond the batch.
    assert not np.any(of_feature[:, -1])
    assert np.any(of_feature[:, :-1])
    for path, gradient in jax.tree.leaves_with_path(of_params):
        assert np.any(gradient), jax.tree_util.keystr(path)


def toy(key, rows, length):
    """An environment whose next observation depends on the action alone, seen through features that say nothing."""
    keys = jax.random.split(key, 4)
    feature = jax.random.normal(keys[0], (rows, length, F))
    action = jax.random.uniform(keys[1], (rows, length + 1, A), minval=-1.0)  # of the steps -1, 0, 1, ...
    is_first = jax.random.uniform(keys[2], (rows, length)) < 0.1
    mixing = jnp.asarray(np.random.default_rng(0).normal(size=(A, E)).astype(np.float32))
    embedding = jnp.tanh(action[:, :-1] @ mixing)
    fresh = jax.random.normal(keys[3], embedding.shape)  # the first observation of an episode follows from nothing
    embedding = jnp.where(is_first[..., None], fresh, embedding)
    prev_action = jnp.where(is_first[..., None], 0.0, action[:, :-1])
    return rollout_of(feature, embedding, action[:, 1:], prev_action, is_first)


def diagonal_after_training(config, updates=250):
    """Mean correlation of prediction and target on new data."""
    objective = config.build(model(8))
    params = {"objective": tiny.fill(jax.eval_shape(objective.init, jax.random.key(0)))}
    optimizer = optax.adam(5e-3)

    def loss(params, key):
        losses, metrics = objective.loss(params, {}, key, toy(key, 16, 8))
        return losses["next_embedding"], metrics

    def step(carry, key):
        params, state = carry
        gradient, metrics = jax.grad(loss, has_aux=True)(params, key)
        with jax.numpy_dtype_promotion("standard"):
            updates, state = optimizer.update(gradient, state)
        return (optax.apply_updates(params, updates), state), metrics["next_embedding/diagonal"]

    keys = jax.random.split(jax.random.key(1), updates)
    # Every batch is new, so the correlation within the last ones is that on unseen data.
    _, diagonal = jax.jit(lambda params, keys: jax.lax.scan(step, (params, optimizer.init(params)), keys))(params, keys)
    return float(jnp.mean(diagonal[-20:]))


def test_what_follows_from_the_action_is_learned_from_it_and_not_from_the_one_before():
    assert diagonal_after_training(CONFIG) > 0.85
    assert diagonal_after_training(replace(CONFIG, action="previous")) < 0.25


@pytest.mark.parametrize(
    ("changes", "length", "message"),
    [
        ({"shift": 2, "steps": 5}, 6, "objective.steps: expected at most agent.batch_length 6 .* 2, got 5"),
        ({"shift": 6}, 6, "objective.shift: expected less than agent.batch_length 6, got 6"),
        ({}, 9, "Sequences of 9 steps, but the predictor has positions for 8"),
    ],
)
def test_settings_that_do_not_fit_the_sequences_are_refused(changes, length, message):
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **changes).build(model(length))
