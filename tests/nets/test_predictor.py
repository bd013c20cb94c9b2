"""What a prediction may depend on, and the transformer against numpy."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.nets.predictor import Predictor, PredictorConfig, episode_causal_mask
from tests import tiny

pytestmark = pytest.mark.usefixtures("quick_compilation")

CONFIG = PredictorConfig(layers=2, width=8, heads=2, feedforward=16, positions=6)
B, T, F, A, E = 2, 6, 5, 3, 4
RNG = np.random.default_rng(0)
FEATURE, ACTION = (RNG.normal(size=(B, T, n)).astype(np.float32) for n in (F, A))
IS_FIRST = np.zeros((B, T), bool)
IS_FIRST[0, 0] = IS_FIRST[0, 3] = IS_FIRST[1, 2] = True
EPISODE = np.cumsum(IS_FIRST, axis=1)


def make(discrete=False, across=False, dtype=jnp.float32, **changes):
    predictor = Predictor(replace(CONFIG, **changes), E, discrete, across, dtype)
    params = tiny.fill(jax.eval_shape(predictor.init, jax.random.key(0), FEATURE, ACTION, IS_FIRST))["params"]
    return params, jax.jit(lambda params, *args: predictor.apply({"params": params}, *args))


def in_sight(layers, across):
    """Whether the prediction at t [.., T, 1] may see the step s [.., 1, T]."""
    s, t = np.arange(T)[None, None], np.arange(T)[None, :, None]
    if layers == 0:
        return np.broadcast_to(s == t, (B, T, T))
    return (s <= t) & ((EPISODE[:, :, None] == EPISODE[:, None]) | across)


@pytest.mark.parametrize(
    ("layers", "across", "discrete"), [(2, False, False), (2, False, True), (2, True, False), (0, False, False)]
)
def test_a_prediction_sees_the_steps_of_its_episode_up_to_it_and_no_other(layers, across, discrete):
    params, predict = make(discrete, across, layers=layers)
    base = predict(params, FEATURE, ACTION, IS_FIRST)
    assert base.shape == (B, T, E)
    assert base.dtype == jnp.float32
    want = in_sight(layers, across)
    for s in range(T):
        for what in range(2):
            inputs = [FEATURE.copy(), ACTION.copy()]
            inputs[what][:, s] += RNG.normal(size=inputs[what].shape[2:]).astype(np.float32)
            changed = np.any(np.asarray(predict(params, *inputs, IS_FIRST) != base), axis=-1)
            np.testing.assert_array_equal(changed, want[:, :, s])


def test_where_later_episodes_begin_changes_no_earlier_prediction():
    params, predict = make()
    base, first = predict(params, FEATURE, ACTION, IS_FIRST), IS_FIRST.copy()
    first[:, 4:] = ~first[:, 4:]
    changed = np.any(np.asarray(predict(params, FEATURE, ACTION, first) != base), axis=-1)
    assert not changed[:, :4].any()
    assert changed[:, 4:].all()


@pytest.mark.parametrize("across", [False, True])
def test_the_mask_is_causal_within_episodes(across):
    mask = np.asarray(episode_causal_mask(jnp.asarray(IS_FIRST), across_episodes=across))
    assert mask.shape == (B, 2 * T, 2 * T)
    for b in range(B):
        for query in range(2 * T):
            for key in range(2 * T):
                same = across or EPISODE[b, query // 2] == EPISODE[b, key // 2]
                assert mask[b, query, key] == (key <= query and same)


def layer_norm(x, p):
    p = p["norm"]
    return (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5) * p["scale"] + p["bias"]


def linear(x, p):
    return x @ p["kernel"] + p.get("bias", 0.0)


gelu = np.vectorize(lambda x: x * (1 + math.erf(x / math.sqrt(2))) / 2)


def by_hand(p, feature, action, mask, discrete):
    """One row [T, ...], in float64."""
    state = linear(linear(feature, p["projector"]), p["state_in"])
    act = linear(action, p["action_in"])
    if not discrete:
        act = gelu(layer_norm(act, p["action_norm"]))
    x = np.stack([state, act], axis=1).reshape(2 * T, -1) + p["positions"][: 2 * T]
    for i in range(CONFIG.layers):
        layer = p[f"layer{i}"]
        parts = np.split(linear(layer_norm(x, layer["attention_norm"]), layer["qkv"]), 3, axis=-1)
        attended = []
        for q, k, v in zip(*(np.split(part, CONFIG.heads, axis=-1) for part in parts), strict=True):
            weights = np.where(mask, np.exp(q @ k.T / np.sqrt(q.shape[-1])), 0.0)
            attended.append(weights / weights.sum(-1, keepdims=True) @ v)
        x = x + linear(np.concatenate(attended, axis=-1), layer["out"])
        y = gelu(linear(layer_norm(x, layer["feedforward_norm"]), layer["up"]))
        x = x + linear(y, layer["down"])
    x = gelu(linear(layer_norm(x, p["out_norm"]), p["hidden"]))
    return linear(x, p["out"])[1::2]


@pytest.mark.parametrize("discrete", [False, True])
def test_predictions_equal_a_hand_written_transformer(discrete):
    params, predict = make(discrete)
    got = predict(params, FEATURE, ACTION, IS_FIRST)
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), params)
    masks = np.asarray(episode_causal_mask(jnp.asarray(IS_FIRST)))
    for b in range(B):
        want = by_hand(p, FEATURE[b].astype(np.float64), ACTION[b].astype(np.float64), masks[b], discrete)
        np.testing.assert_allclose(got[b], want, rtol=1e-3, atol=1e-4)


def test_without_the_projector_the_functions_are_the_same():
    params, predict = make()
    shorter, predict_without = make(projector=False)
    assert set(params) - set(shorter) == {"projector"}
    product = params["projector"]["kernel"] @ params["state_in"]["kernel"]
    assert product.shape == shorter["state_in"]["kernel"].shape
    merged = {name: tree for name, tree in params.items() if name != "projector"}
    merged["state_in"] = {**merged["state_in"], "kernel": product}
    want = predict(params, FEATURE, ACTION, IS_FIRST)
    np.testing.assert_allclose(predict_without(merged, FEATURE, ACTION, IS_FIRST), want, rtol=1e-4, atol=1e-5)


def test_without_layers_there_is_nothing_of_a_transformer():
    predictor = Predictor(replace(CONFIG, layers=0), E, False)
    params = jax.eval_shape(predictor.init, jax.random.key(0), FEATURE, ACTION, IS_FIRST)["params"]
    assert set(params) == {"projector", "state_in", "action_in", "action_norm", "out_norm", "hidden", "out"}


def test_positions_start_small():
    with jax.disable_jit():
        predictor = Predictor(replace(CONFIG, layers=1, positions=64), E, False)
        params = predictor.init(jax.random.key(0), FEATURE[:1, :1], ACTION[:1, :1], IS_FIRST[:1, :1])["params"]
    assert params["positions"].shape == (128, 8)
    np.testing.assert_allclose(np.asarray(params["positions"]).std(), 0.02, rtol=0.1)


def test_sequences_longer_than_the_positions_are_refused():
    with pytest.raises(ValueError, match="Sequences of 6 steps, but the predictor has positions for 5"):
        make(positions=5)
    make(positions=5, layers=0)  # which has no positions


def test_heads_must_divide_the_width():
    with pytest.raises(ValueError, match="multiple of its heads, got 10 and 4; the nearest above is 12"):
        PredictorConfig(width=10, heads=4)


def test_bfloat16_is_of_the_products_alone():
    predictor = Predictor(CONFIG, E, False, dtype=jnp.bfloat16)
    params = jax.eval_shape(predictor.init, jax.random.key(0), FEATURE, ACTION, IS_FIRST)
    out = jax.eval_shape(predictor.apply, params, FEATURE, ACTION, IS_FIRST)
    assert {x.dtype for x in jax.tree.leaves((params, out))} == {jnp.dtype(jnp.float32)}


@pytest.mark.parametrize("layers", [0, 2])
def test_a_prediction_at_the_states_token_does_not_see_the_action_of_its_step(layers):
    predictor = Predictor(replace(CONFIG, layers=layers), E, discrete=False, at_state=True)
    params = tiny.fill(jax.eval_shape(predictor.init, jax.random.key(0), FEATURE, ACTION, IS_FIRST))
    base = predictor.apply(params, FEATURE, ACTION, IS_FIRST)
    for s in range(T):
        action = ACTION.copy()
        action[:, s] += 1.0
        changed = np.any(np.asarray(predictor.apply(params, FEATURE, action, IS_FIRST) != base), axis=-1)
        later = np.arange(T)[None] > s
        want = later & (EPISODE[:, s, None] == EPISODE) if layers else np.zeros((B, T), bool)
        np.testing.assert_array_equal(changed, want)


def test_a_normalised_discrete_action_is_read_as_a_continuous_one():
    (as_discrete, predict), (as_continuous, same) = (
        make(discrete, discrete_action="normalised") for discrete in (True, False)
    )
    assert jax.tree.structure(as_discrete) == jax.tree.structure(as_continuous)
    onehot = np.eye(A, dtype=np.float32)[RNG.integers(0, A, (B, T))]
    np.testing.assert_array_equal(
        predict(as_discrete, FEATURE, onehot, IS_FIRST), same(as_continuous, FEATURE, onehot, IS_FIRST)
    )


@pytest.mark.parametrize(("init", "deviation"), [("fan_in", 1 / 16), ("xavier", (2 / (256 + 768)) ** 0.5)])
def test_queries_keys_and_values_start_as_asked(init, deviation):
    predictor = Predictor(PredictorConfig(layers=1, positions=6, attention_init=init), E, discrete=False)
    params = predictor.init(jax.random.key(0), FEATURE, ACTION, IS_FIRST)["params"]
    assert np.std(params["layer0"]["qkv"]["kernel"]) == pytest.approx(deviation, rel=0.02)
    assert np.std(params["layer0"]["out"]["kernel"]) == pytest.approx(1 / 16, rel=0.02)
