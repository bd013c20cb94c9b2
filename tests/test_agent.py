"""The agent as a whole: what it refuses, what one update changes, how it acts, and how many parameters it has."""

import dataclasses
import math
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax import config as configs
from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.dreamer.agent import parameter_counts
from ne_dreamer_jax.agents.dreamer.world_model import WorldModelConfig
from ne_dreamer_jax.agents.optim import OptimizerConfig
from ne_dreamer_jax.replay import ring as replay
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.types import ArraySpec, ContinuousAction, EnvSpec, TimeStep
from tests import tiny
from tests.marks import slow_but
from tests.tiny import assert_same

pytestmark = pytest.mark.usefixtures("quick_compilation")

REPLACE = dataclasses.replace


def shapes(config, spec):
    return jax.eval_shape(make_agent(config, spec).init, jax.random.key(0))


SHARED = {"rssm": 5_979_648, "actor": 791_052, "critic": 853_503, "reward": 721_407, "continue": 656_129}
OWN = {  # method -> the objective's trained parameters, and those of its target
    "ne_dreamer": (2_621_440 + 2_239_232, 0),  # projector and predictor
    "dreamerv3": (1_272_003, 0),  # decoder
    "r2dreamer": (2_621_440, 0),  # projector
    "dreamerpro": (194_752, 253_216),  # prototypes and projections; the teacher
    "dreamer_no_reconstruction": (0, 0),
}


@pytest.mark.parametrize("method", OWN)
def test_parameter_counts_are_those_of_the_authors_code(method):
    """At 12m with 64x64 images and 6 continuous actions; only the chosen objective's own parameters exist."""
    spec = EnvSpec({"image": ArraySpec((64, 64, 3), jnp.uint8)}, ContinuousAction(6))
    state = shapes(configs.with_method(configs.preset("dmc", "12m"), method).agent, spec)
    own, target = OWN[method]
    assert parameter_counts(state.params) == {**SHARED, "encoder": 220_416, "objective": own}
    assert sum(x.size for x in jax.tree.leaves(state.target) if x.dtype == jnp.float32) == target
    assert set(OWN) == set(names.OBJECTIVES)


def test_a_fresh_state_is_float32_and_starts_at_zero():
    state = shapes(tiny.CONFIG, tiny.BOTH)
    kinds = {jnp.dtype(x.dtype) for x in jax.tree.leaves((state.params, state.slow_critic))}
    assert kinds == {jnp.dtype(jnp.float32)}
    assert jax.tree.structure(state.slow_critic) == jax.tree.structure(state.params["critic"])
    assert state.target == {}
    assert state.update.dtype == jnp.int32
    assert state.return_scale.low.shape == ()


# One update.


@pytest.fixture(scope="module")
def update():
    behavior = REPLACE(tiny.CONFIG.behavior, slow_rate=0.25)
    # Without free nats, since below them neither prior nor posterior is trained.
    config = REPLACE(tiny.CONFIG, behavior=behavior, world_model=WorldModelConfig(free_nats=0.0))
    agent = make_agent(config, tiny.BOTH)
    batch = tiny.batch()
    before = jax.device_get(tiny.state(agent)._replace(key=None))
    state, latents, metrics = agent.train_step(tiny.state(agent), batch)
    after = jax.device_get(state._replace(key=None))
    return SimpleNamespace(
        agent=agent, batch=batch, before=before, after=after, state=state, latents=latents, metrics=metrics
    )


def test_an_update_changes_every_parameter(update):
    for path, after in jax.tree.leaves_with_path(update.after.params):
        name, before = jax.tree_util.keystr(path), update.before.params
        for key in path:
            before = before[key.key]
        # Nothing is left out, but for unused positions and the bias of the attention's keys, which no softmax feels.
        assert np.mean(after != before) > 0.3, name
        assert np.isfinite(after).all(), name
        assert after.dtype == np.float32, name
    assert update.after.update == 1


def test_the_slow_critic_follows_at_its_rate(update):
    want = jax.tree.map(
        lambda slow, new: 0.75 * slow + 0.25 * new, update.before.slow_critic, update.after.params["critic"]
    )
    for got, expected in zip(jax.tree.leaves(update.after.slow_critic), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-7)


def test_the_entropys_weight_changes_with_the_updates():
    behavior = REPLACE(tiny.CONFIG.behavior, entropy=0.0, entropy_final=1e4, entropy_updates=10)
    agent, batch = make_agent(REPLACE(tiny.CONFIG, behavior=behavior), tiny.VECTORS), tiny.batch(tiny.VECTORS)
    state = lambda update: tiny.state(agent)._replace(update=jnp.asarray(update, jnp.int32))
    metrics = [agent.train_step(state(update), batch)[2] for update in (0, 5, 10, 20)]
    np.testing.assert_allclose([x["policy/entropy_scale"] for x in metrics], [0, 5e3, 1e4, 1e4])
    first, half, full, later = (float(x["loss/actor"]) for x in metrics)
    assert full < first - 1e3
    np.testing.assert_allclose(half - first, (full - first) / 2, rtol=1e-3)
    assert later == full


def test_profilers_see_an_updates_parts_by_name():
    agent, batch = make_agent(tiny.CONFIG, tiny.VECTORS), tiny.batch(tiny.VECTORS)
    text = agent.train_step.lower(tiny.state(agent), batch).as_text(debug_info=True)
    for part in ("posterior", "predictions", "objective", "behavior", "imagination", "optimizer"):
        assert re.search(rf'"[^"]*\b{part}\b[^"]*/dot_general"', text) or (part == "optimizer" and part in text), part


def test_losses_are_reported_by_name_and_weighed(update):
    metrics, scales = jax.device_get(update.metrics), update.agent.config.loss_scales
    assert all(x.shape == () and x.dtype == np.float32 and np.isfinite(x) for x in metrics.values())
    total = sum(scale * metrics[f"loss/{name}"] for name, scale in scales.items())
    np.testing.assert_allclose(metrics["loss/total"], total, rtol=1e-4)
    assert metrics["gradient_norm"] > 0


def test_the_returned_latents_are_those_of_the_batch_and_fit_replay(update):
    assert update.latents.deter.shape == (2, 5, 32)
    assert update.latents.stoch.shape == (2, 5, 4, 4)
    stoch = np.asarray(update.latents.stoch)
    assert set(np.unique(stoch)) == {0.0, 1.0}
    assert (stoch.sum(-1) == 1).all()


def test_many_updates_compile_once_donate_their_state_and_repeat_to_the_bit(update):
    agent = update.agent

    def three():
        state = tiny.state(agent)
        donated = jax.tree.leaves((state.params, state.optimizer, state.slow_critic))
        for seed in range(3):
            state, latents, metrics = agent.train_step(state, tiny.batch(seed=seed))
        assert all(x.is_deleted() for x in donated)
        return state, latents, metrics

    assert_same(three(), three())
    assert agent.train_step._cache_size() == 1


def test_an_update_draws_anew(update):
    agent = update.agent
    first, _, _ = agent.train_step(tiny.state(agent), update.batch)
    data = jax.random.key_data
    assert np.any(data(first.key) != data(tiny.state(agent).key))
    other = tiny.state(agent)._replace(key=jax.random.key(77))
    assert np.any(agent.train_step(other, update.batch)[1].stoch != update.latents.stoch)


def test_one_call_per_state_no_input_but_the_batch_is_read(update):
    """Where an episode begins, context and previous action are of no consequence."""
    agent, batch = update.agent, update.batch
    assert batch.is_first[0, 0]
    changed = batch._replace(
        prev_action=batch.prev_action.at[0, 0].set(0.123).at[1, 2].set(0.123),
        context=jax.tree.map(lambda x, y: x.at[0].set(y[0]), batch.context, tiny.latent((2,), 5)),
    )
    got = agent.train_step(tiny.state(agent), changed)
    want = agent.train_step(tiny.state(agent), batch)
    assert_same(got, want)


@pytest.fixture(scope="module")
def half(update):
    return make_agent(REPLACE(update.agent.config, compute_dtype="bfloat16"), tiny.BOTH)


def test_bfloat16_products_change_the_losses_little(update, half):
    state, latents, metrics = half.train_step(tiny.state(half), update.batch)
    kinds = {x.dtype for x in jax.tree.leaves((state.params, state.optimizer, latents, metrics))}
    assert kinds <= {jnp.dtype(jnp.float32), jnp.dtype(jnp.int32)}
    for name in ("next_embedding", "reward", "continue", "representation", "critic", "replay_critic"):
        got, want = float(metrics[f"loss/{name}"]), float(update.metrics[f"loss/{name}"])
        assert got != want, name
        np.testing.assert_allclose(got, want, rtol=0.1, err_msg=name)


def test_over_200_updates_bfloat16_learns_what_float32_does(update, half):
    batches = [tiny.batch(seed=seed) for seed in range(8)]
    curves = []
    for agent in (update.agent, half):
        state, losses = tiny.state(agent), []
        for number in range(200):
            state, _, metrics = agent.train_step(state, batches[number % len(batches)])
            losses.append(metrics["loss/total"])
        curves.append(np.asarray(losses))
    exact, rounded = curves
    assert exact[-40:].mean() < 0.9 * exact[:40].mean()  # it learns
    assert (exact != rounded).all()
    assert abs(rounded.mean() / exact.mean() - 1) < 0.01
    np.testing.assert_allclose(rounded[-40:].mean(), exact[-40:].mean(), rtol=0.03)


# Acting.


def timestep(spec, n, seed=0, first=()):
    batch = tiny.batch(spec, (n, 1), seed, [(i, 0) for i in first])
    row = jax.tree.map(lambda x: x[:, 0], batch._replace(context=()))
    return TimeStep(row.obs, row.reward, row.is_first, row.is_last, row.is_terminal)


@pytest.mark.parametrize("spec", [tiny.VECTORS, tiny.DISCRETE], ids=["continuous", "discrete"])
def test_acting(spec):
    agent, n = make_agent(tiny.CONFIG, spec), 64
    params = tiny.params(tiny.networks(spec))
    policy = agent.init_policy(n)
    assert tiny.is_zero(policy)
    step = timestep(spec, n, first=range(n))
    key = jax.random.key(0)
    policy, action = agent.act(params, policy, step, key)
    assert action.shape == (n, *spec.action.shape)
    assert action.dtype == spec.action.dtype
    assert_same(policy.prev_action, action)
    if spec is tiny.VECTORS:
        assert np.abs(action).max() == 1  # clipped
    else:
        assert set(np.unique(action)) == {0, 1, 2}
    # The mode differs, while the latent is sampled in both.
    sampled, other = agent.act(params, agent.init_policy(n), step, key, mode="mode")
    assert_same(sampled.latent, policy.latent)
    assert np.any(other != action)
    # What was carried is forgotten where an episode begins, and only there.
    later = timestep(spec, n, seed=1, first=[0, 5])
    carried, _ = agent.act(params, policy, later, key)
    anew, _ = agent.act(params, agent.init_policy(n), later, key)
    differs = np.any(np.asarray(carried.latent.deter != anew.latent.deter), axis=-1)
    assert not differs[[0, 5]].any()
    assert differs.sum() == n - 2


def test_acting_refuses_an_unknown_mode_and_other_observations():
    agent = make_agent(tiny.CONFIG, tiny.VECTORS)
    params, policy = jax.eval_shape(agent.init, jax.random.key(0)).params, agent.init_policy(2)
    with pytest.raises(ValueError, match="mode: expected 'sample' or 'mode', got 'greedy'"):
        jax.eval_shape(
            lambda p: agent.act(p, policy, timestep(tiny.VECTORS, 2), jax.random.key(0), mode="greedy"), params
        )
    other = EnvSpec({"vector": ArraySpec((4,), jnp.float32)}, tiny.VECTORS.action)
    with pytest.raises(ValueError, match=r"vector: expected float32\[2, 3\], got float32\[2, 4\]"):
        jax.eval_shape(lambda p: agent.act(p, policy, timestep(other, 2), jax.random.key(0)), params)


# What is refused.


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"loss_scales": {**tiny.CONFIG.loss_scales, "rewrd": 1.0}}, "unknown .*'rewrd' .nearest: 'reward'"),
        ({"loss_scales": {"reward": 1.0}}, r"missing \['actor', 'continue'"),
        (
            {"compute_dtype": "float16"},
            r"compute_dtype: expected float32 or bfloat16, got 'float16'",
        ),
        ({"microbatches": 3}, r"agent.microbatches: expected a divisor of agent.batch_size 2 \(1, 2\), got 3"),
        ({"batch_length": 9}, "Sequences of 9 steps, but the predictor has positions for 8"),
        (
            {"objective": REPLACE(tiny.CONFIG.objective, shift=5)},
            "objective.shift: expected less than agent.batch_length 5",
        ),
    ],
)
def test_configs_that_do_not_fit_are_refused_when_the_agent_is_made(change, message):
    with pytest.raises(ValueError, match=message):
        make_agent(REPLACE(tiny.CONFIG, **change), tiny.BOTH)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({"image": ArraySpec((9, 8, 3), jnp.uint8)}, "multiples of 4 = 2..2, got"),
        ({"image": ArraySpec((8, 8, 3), jnp.float32)}, "expected a uint8 image"),
        ({}, "at least one observation"),
    ],
)
def test_environments_that_do_not_fit_are_refused_when_the_agent_is_made(observation, message):
    with pytest.raises(ValueError, match=message):
        make_agent(tiny.CONFIG, EnvSpec(observation, ContinuousAction(2)))


BAD_BATCHES = {
    "obs.vector": (lambda b: b._replace(obs={**b.obs, "vector": b.obs["vector"][..., :2]}), r"float32\[2, 5, 3\]"),
    "obs.image": (lambda b: b._replace(obs={"vector": b.obs["vector"]}), r"uint8\[2, 5, 8, 8, 3\], got nothing"),
    "obs.sound": (lambda b: b._replace(obs={**b.obs, "sound": b.reward}), "nothing"),
    "action": (lambda b: b._replace(action=b.action[..., :1]), r"float32\[2, 5, 2\]"),
    "prev_action": (lambda b: b._replace(prev_action=b.prev_action[:, :4]), r"float32\[2, 5, 2\]"),
    "is_first": (lambda b: b._replace(is_first=b.is_first.astype(jnp.float32)), r"bool\[2, 5\]"),
    "is_terminal": (lambda b: b._replace(is_terminal=b.is_terminal[:1]), r"bool\[2, 5\]"),
    "context.deter": (lambda b: b._replace(context=tiny.latent((3,))), r"float32\[2, 32\]"),
    "index": (lambda b: b._replace(index=b.index[:, 0]), r"int32\[2, 5\]"),
}


@pytest.mark.parametrize("name", BAD_BATCHES)
def test_batches_that_do_not_fit_are_refused(name):
    spoil, expected = BAD_BATCHES[name]
    agent = make_agent(tiny.CONFIG, tiny.BOTH)
    with pytest.raises(ValueError, match=rf"does not fit the agent: .*{name}: expected {expected}"):
        agent.train_step.eval_shape(jax.eval_shape(agent.init, jax.random.key(0)), spoil(tiny.batch()))


def test_a_random_batch_fits():
    config = REPLACE(tiny.CONFIG, batch_size=3)
    agent = make_agent(config, tiny.DISCRETE)
    batch = jax.eval_shape(lambda key: replay.random_batch(tiny.DISCRETE, config, key), jax.random.key(0))
    state = jax.eval_shape(agent.init, jax.random.key(0))
    new, latents, _ = agent.train_step.eval_shape(state, batch)
    assert latents.deter.shape == (3, 5, 32)
    same = jax.tree.map(lambda x, y: (x.shape, x.dtype) == (y.shape, y.dtype), new, state)
    assert all(jax.tree.leaves(same))


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("method", tiny.OBJECTIVES)
def test_the_update_of_every_method_keeps_the_state_as_it_is_made(method, dtype):
    config = REPLACE(tiny.with_method(tiny.OBJECTIVES[method]), compute_dtype=dtype)
    assert config.method == method
    agent = make_agent(config, tiny.BOTH)
    state = jax.eval_shape(agent.init, jax.random.key(0))
    new, _, metrics = agent.train_step.eval_shape(state, jax.eval_shape(tiny.batch))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), new) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert {f"loss/{name}" for name in config.loss_scales} <= set(metrics)


QUICK = ("dreamer_no_reconstruction", "reinforce", 3)
CASES = [(method, gradient, None) for method in tiny.OBJECTIVES for gradient in ("reinforce", "dynamics")]
CASES += [QUICK, ("ne_dreamer", "dynamics", 3)]


@pytest.mark.parametrize("case", slow_but(CASES, QUICK), ids=str)
def test_an_update_in_microbatches_is_the_update(case):
    """Losses, latents and gradients: an optimiser whose steps are a tenth of the gradients, for small ones."""
    method, gradient, last = case
    plain = OptimizerConfig(learning_rate=1.0, eps=10.0, agc=math.inf, warmup=0)
    config = REPLACE(tiny.with_method(tiny.OBJECTIVES[method]), optimizer=plain, batch_size=4)
    config = REPLACE(config, behavior=REPLACE(config.behavior, gradient=gradient, imagine_last=last))
    batch = tiny.batch(tiny.BOTH, (4, 5))

    def updated(count):
        agent = make_agent(REPLACE(config, microbatches=count), tiny.BOTH)
        state = tiny.state(agent)
        before = jax.tree.map(np.asarray, state.params)
        state, latents, metrics = agent.train_step(state, batch)
        assert latents.deter.shape[:2] == (4, 5)
        return jax.tree.map(lambda a, b: 10 * (np.asarray(a) - b), state.params, before), latents, metrics

    want = updated(1)
    for (path, x), y in zip(jax.tree.leaves_with_path(updated(2)), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-4, err_msg=jax.tree_util.keystr(path))


@pytest.mark.slow
@pytest.mark.parametrize("spec", [tiny.BOTH, tiny.DISCRETE], ids=["continuous", "discrete"])
def test_initialisation_makes_what_it_announces(spec):
    """Compiles the whole of it; the other tests fill the shapes with numbers of their own."""
    agent = make_agent(tiny.CONFIG, spec)
    state = agent.init(jax.random.key(0))
    assert jax.tree.map(lambda x: x.shape, state) == jax.tree.map(lambda x: x.shape, shapes(tiny.CONFIG, spec))
    assert_same(state.slow_critic, state.params["critic"])
    for name, zero in (("reward", True), ("critic", True), ("continue", False), ("actor", False)):
        assert tiny.is_zero(state.params[name]["out"]) == zero
    assert tiny.is_zero((state.return_scale, state.update))
    assert_same(agent.init(jax.random.key(0)), state)
    within = jax.jit(lambda key: agent.init(key).params)(jax.random.key(0))  # compiled with other options
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), within, state.params)
    other = agent.init(jax.random.key(1))
    assert np.any(other.params["actor"]["out"]["kernel"] != state.params["actor"]["out"]["kernel"])


def following(spec, key, rows, length):
    """Sequences in which the observation shows the last action, and nothing else of it."""
    keys = jax.random.split(key, 3)
    action = jax.random.uniform(keys[0], (rows, length + 1, spec.action.size), minval=-1.0)
    is_first = jax.random.uniform(keys[1], (rows, length)) < 0.1
    mixing = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3)).astype(np.float32))
    fresh = jax.random.normal(keys[2], (rows, length, 3))
    vector = jnp.where(is_first[..., None], fresh, action[:, :-1] @ mixing)
    flag = jnp.zeros((rows, length), bool)
    latent = jax.tree.map(lambda x: jnp.zeros(x.shape), tiny.latent((rows,)))
    return tiny.batch(spec, (rows, length))._replace(
        obs={"vector": vector},
        action=action[:, 1:],
        prev_action=action[:, :-1],
        is_first=is_first,
        is_last=flag,
        is_terminal=flag,
        reward=jnp.zeros((rows, length)),
        context=latent,
    )


@pytest.mark.slow
def test_the_agent_predicts_what_follows_from_its_action():
    """The whole update, in an environment whose next observation depends on the action alone."""
    reached = {}
    for which in ("current", "previous"):
        config = REPLACE(
            tiny.CONFIG,
            objective=REPLACE(tiny.CONFIG.objective, action=which),
            optimizer=REPLACE(tiny.CONFIG.optimizer, learning_rate=3e-3),
            batch_size=16,
        )
        agent = make_agent(config, tiny.VECTORS)
        state, diagonals = tiny.state(agent), []
        draw = jax.jit(lambda key: following(tiny.VECTORS, key, 16, 5))
        for key in jax.random.split(jax.random.key(0), 600):
            state, _, metrics = agent.train_step(state, draw(key))
            diagonals.append(metrics["next_embedding/diagonal"])
        reached[which] = float(np.mean(diagonals[-50:]))
    assert reached["current"] > 0.7
    assert reached["previous"] < 0.3
