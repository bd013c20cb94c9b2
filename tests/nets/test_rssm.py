"""The recurrence against numpy, and what each step may depend on."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ne_dreamer_jax.nets.platform import traced_for
from ne_dreamer_jax.nets.rssm import RSSM, RSSMConfig, feature, initial_latent, mask_first, observe, sample_onehot
from ne_dreamer_jax.types import Latent
from tests import tiny
from tests.tiny import assert_same

pytestmark = pytest.mark.usefixtures("quick_compilation")

CONFIG = tiny.CONFIG.rssm
B, T, E, A = 3, 5, 6, 2
RNG = np.random.default_rng(0)
EMBEDDING = RNG.normal(size=(B, T, E)).astype(np.float32)
PREV_ACTION = RNG.uniform(-1, 1, (B, T, A)).astype(np.float32)
IS_FIRST = np.zeros((B, T), bool)
IS_FIRST[0, 0] = IS_FIRST[1, 3] = True
UNIFORM = RNG.uniform(size=(B, T, CONFIG.stoch)).astype(np.float32)


@pytest.fixture(scope="module")
def model():
    rssm = RSSM(CONFIG, E, A)
    step = (initial_latent(CONFIG, (1,)), jnp.zeros((1, E)), jnp.zeros((1, A)))
    params = tiny.fill(jax.eval_shape(rssm.init, jax.random.key(0), *step))["params"]

    @jax.jit
    def run(context, embedding, prev_action, is_first):
        return observe(rssm, params, UNIFORM, context, embedding, prev_action, is_first)

    return SimpleNamespace(rssm=rssm, params=params, run=run)


def in_order(x):
    """Parts of the numpy oracle, float64."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), x)


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def norm_silu(x, scale):
    x = x / np.sqrt(np.mean(x**2, -1, keepdims=True) + 1e-4) * scale
    return x * sigmoid(x)


def block(params, x):
    return norm_silu(x @ params["linear"]["kernel"] + params["linear"]["bias"], params["norm"]["scale"])


def recurrence(p, deter, stoch, action):
    """DreamerV3's block GRU, one row at a time and one block at a time."""
    inputs = np.concatenate(
        [block(p["deter_in"], deter), block(p["stoch_in"], stoch.reshape(-1)), block(p["action_in"], action)]
    )
    size = CONFIG.deter // CONFIG.blocks
    own = np.concatenate([deter[g * size : (g + 1) * size] @ p["state_kernel"][g] for g in range(CONFIG.blocks)])
    x = norm_silu(own + inputs @ p["input_kernel"] + p["hidden_bias"], p["hidden_norm"]["scale"])
    new = []
    for g in range(CONFIG.blocks):
        rows = slice(g * size, (g + 1) * size)
        reset, candidate, update = np.split(x[rows] @ p["gate_kernel"][g] + p["gate_bias"][g], 3)
        candidate = np.tanh(sigmoid(reset) * candidate)
        update = sigmoid(update - 1)
        new.append(update * candidate + (1 - update) * deter[rows])
    return np.concatenate(new)


def test_recurrence_prior_and_posterior_equal_a_hand_written_step(model):
    latent = tiny.latent((B,), 1)
    action = np.asarray([[0.5, -1.0], [3.0, -2.0], [0.0, 0.0]], np.float32)

    def step(module, latent, action, embedding):
        deter = module.recur(latent, module.embed_action(action))
        return deter, module.prior(deter), module.posterior(deter, module.embed_observation(embedding))

    deter, prior, posterior = jax.jit(lambda *args: model.rssm.apply({"params": model.params}, *args, method=step))(
        latent, action, EMBEDDING[:, 0]
    )
    p, before = in_order(model.params), in_order(latent)
    action = action / np.maximum(1, np.abs(action))
    for row in range(B):
        want = recurrence(p, before.deter[row], before.stoch[row], action[row])
        np.testing.assert_allclose(deter[row], want, rtol=1e-4, atol=1e-5)
        logits = block(p["prior_mlp"]["block0"], want) @ p["prior_out"]["kernel"] + p["prior_out"]["bias"]
        np.testing.assert_allclose(prior[row].reshape(-1), logits, rtol=1e-3, atol=1e-4)
        hidden = np.concatenate([want, EMBEDDING[row, 0]]) @ p["posterior_kernel"] + p["posterior_bias"]
        hidden = norm_silu(hidden, p["posterior_norm"]["scale"])
        logits = hidden @ p["posterior_out"]["kernel"] + p["posterior_out"]["bias"]
        np.testing.assert_allclose(posterior[row].reshape(-1), logits, rtol=1e-3, atol=1e-4)


def test_observing_a_sequence_is_observing_step_by_step(model):
    latents, logits = model.run(tiny.latent((B,), 2), EMBEDDING, PREV_ACTION, IS_FIRST)
    assert latents.deter.shape == (B, T, CONFIG.deter)
    assert latents.stoch.shape == logits.shape == (B, T, CONFIG.stoch, CONFIG.classes)
    assert_same(jnp.sum(latents.stoch, -1), np.ones((B, T, CONFIG.stoch), np.float32))

    def step(module, latent, embedding, action, is_first, uniform):
        action = mask_first(action, is_first)
        inputs = module.embed_observation(embedding), module.embed_action(action)
        return module.observe_step(latent, *inputs, is_first, uniform)

    apply = jax.jit(lambda *args: model.rssm.apply({"params": model.params}, *args, method=step))
    latent = tiny.latent((B,), 2)
    for t in range(T):
        latent, step_logits = apply(latent, EMBEDDING[:, t], PREV_ACTION[:, t], IS_FIRST[:, t], UNIFORM[:, t])
        np.testing.assert_allclose(latent.deter, latents.deter[:, t], atol=1e-5)
        np.testing.assert_array_equal(latent.stoch, latents.stoch[:, t])
        np.testing.assert_allclose(step_logits, logits[:, t], atol=1e-4)


def test_nothing_before_the_first_step_of_an_episode_reaches_it(model):
    context = tiny.latent((B,), 2)
    base = model.run(context, EMBEDDING, PREV_ACTION, IS_FIRST)
    other = tiny.latent((B,), 3)
    action, embedding = PREV_ACTION.copy(), EMBEDDING.copy()
    action[0, 0] = action[1, :4] = 9  # of row 1 also the action into the first step
    embedding[1, :3] = 9
    changed = model.run(other, embedding, action, IS_FIRST)
    row = lambda tree, b, steps: jax.tree.map(lambda x: x[b, steps], tree)
    assert_same(row(changed, 0, slice(None)), row(base, 0, slice(None)))
    assert_same(row(changed, 1, slice(3, None)), row(base, 1, slice(3, None)))
    # Where no episode begins, the same changes do matter.
    assert np.any(changed[0].deter[1, :3] != base[0].deter[1, :3], axis=-1).all()
    assert np.any(changed[0].deter[2] != base[0].deter[2], axis=-1).all()


def test_nothing_later_reaches_an_earlier_step(model):
    context = tiny.latent((B,), 2)
    base = model.run(context, EMBEDDING, PREV_ACTION, IS_FIRST)
    embedding, action, first = EMBEDDING.copy(), PREV_ACTION.copy(), IS_FIRST.copy()
    embedding[:, 3:], action[:, 3:], first[:, 3:] = 5, 5, ~first[:, 3:]
    changed = model.run(context, embedding, action, first)
    assert_same(jax.tree.map(lambda x: x[:, :3], changed), jax.tree.map(lambda x: x[:, :3], base))
    assert np.any(changed[0].deter[:, 3] != base[0].deter[:, 3], axis=-1).all()


def test_the_posterior_at_t_sees_the_action_before_t_and_the_embedding_at_t(model):
    context = tiny.latent((B,), 2)
    base, _ = model.run(context, EMBEDDING, PREV_ACTION, IS_FIRST)
    action, embedding = PREV_ACTION.copy(), EMBEDDING.copy()
    action[2, 1] = 9
    assert np.any(model.run(context, EMBEDDING, action, IS_FIRST)[0].deter[2, 1] != base.deter[2, 1])
    embedding[2, 1] = 9
    latents, logits = model.run(context, embedding, PREV_ACTION, IS_FIRST)
    np.testing.assert_array_equal(latents.deter[2, 1], base.deter[2, 1])  # h_t does not see e_t
    assert np.any(logits[2, 1] != model.run(context, EMBEDDING, PREV_ACTION, IS_FIRST)[1][2, 1])


def test_samples_have_the_frequencies_of_their_probabilities():
    logits = np.log(np.asarray([0.5, 0.3, 0.19, 0.01], np.float32))
    uniform = jax.random.uniform(jax.random.key(0), (20_000,))
    sample = np.asarray(sample_onehot(uniform, jnp.broadcast_to(logits, (20_000, 4))))
    assert set(np.unique(sample)) == {0.0, 1.0}
    assert (sample.sum(-1) == 1).all()
    assert stats.chisquare(sample.sum(0), 20_000 * np.exp(logits, dtype=np.float64)).pvalue > 1e-3


def test_samples_at_the_ends_of_the_uniform_number_are_possible_ones():
    logits = jnp.asarray([[-jnp.inf, 0.0, 0.0, -jnp.inf]] * 2)
    sample = sample_onehot(jnp.asarray([0.0, 1 - 2.0**-24]), logits)
    np.testing.assert_array_equal(sample, [[0, 1, 0, 0], [0, 0, 1, 0]])


def test_samples_pass_the_gradient_of_the_probabilities():
    rng = np.random.default_rng(0)
    logits, weight = (jnp.asarray(rng.normal(size=(5, 4)).astype(np.float32)) for _ in range(2))
    uniform = jnp.asarray(rng.uniform(size=5).astype(np.float32))
    straight_through = jax.grad(lambda x: jnp.sum(weight * sample_onehot(uniform, x)))(logits)
    of_probabilities = jax.grad(lambda x: jnp.sum(weight * jax.nn.softmax(x)))(logits)
    np.testing.assert_allclose(straight_through, of_probabilities, atol=1e-6)


def test_latents_are_sampled_from_the_mixture_with_the_uniform():
    rssm = RSSM(RSSMConfig(8, 1, 4, 4, 2, unimix=0.2), E, A)
    logits = jnp.broadcast_to(jnp.asarray([40.0, 0.0, 0.0, 0.0]), (20_000, 1, 4))
    uniform = jax.random.uniform(jax.random.key(0), (20_000, 1))
    sample, _ = rssm.init_with_output(jax.random.key(1), uniform, logits, method=RSSM.sample)
    counts = np.asarray(sample).sum((0, 1))
    assert stats.chisquare(counts, 20_000 * np.asarray([0.85, 0.05, 0.05, 0.05])).pvalue > 1e-3


def test_a_feature_is_the_flat_sample_and_then_the_deterministic_state():
    latent = tiny.latent((2, 3))
    got = feature(latent)
    assert got.shape == (2, 3, CONFIG.feature)
    np.testing.assert_array_equal(got[..., :16], np.asarray(latent.stoch).reshape(2, 3, 16))
    np.testing.assert_array_equal(got[..., 16:], latent.deter)


def test_initial_latents_are_zero():
    assert tiny.is_zero(initial_latent(CONFIG, (3, 2)))
    assert initial_latent(CONFIG, (3, 2)).stoch.shape == (3, 2, 4, 4)


def test_block_linear_kernels_start_with_the_fan_in_of_all_blocks():
    config = RSSMConfig(deter=64, stoch=2, classes=2, hidden=32, blocks=4, prior_layers=0)
    rssm = RSSM(config, 8, A)

    def kernels(module):
        return module.state_kernel, module.input_kernel, module.gate_kernel

    def init():
        return rssm.init_with_output(jax.random.key(0), method=kernels)[0]

    state, inputs, gates = (np.asarray(x) for x in init())
    for kernel, fan_in in ((state, 4 * (16 + 96)), (inputs, 4 * (16 + 96)), (gates, 4 * 16)):
        np.testing.assert_allclose(kernel.std(), fan_in**-0.5, rtol=0.06)
        assert np.abs(kernel).max() <= 2 * 1.1369 * fan_in**-0.5


def test_blocks_must_divide_the_state():
    with pytest.raises(ValueError, match=r"rssm.deter must be a multiple of rssm.blocks, got 30 and 8.* 24"):
        RSSMConfig(deter=30, blocks=8)


def test_bfloat16_products_keep_float32_latents():
    rssm = RSSM(CONFIG, E, A, jnp.bfloat16)
    shapes = jax.eval_shape(
        rssm.init, jax.random.key(0), initial_latent(CONFIG, (1,)), jnp.zeros((1, E)), jnp.zeros((1, A))
    )
    run = lambda p: observe(rssm, p, UNIFORM, tiny.latent((B,)), EMBEDDING, PREV_ACTION, IS_FIRST)
    out = jax.eval_shape(run, shapes["params"])
    assert {x.dtype for x in jax.tree.leaves((shapes, out))} == {jnp.dtype(jnp.float32)}
    assert isinstance(out[0], Latent)


@pytest.mark.parametrize("platform", ["cpu", "cuda"])
def test_of_each_observed_step_products_are_kept_for_the_gradient(platform):
    """Beside what a step returns; the blocks' products are several on a CPU and one elsewhere."""
    nets = tiny.networks(tiny.VECTORS)
    params = tiny.params(nets)["rssm"]
    uniform = jnp.full((2, 5, nets.rssm.config.stoch), 0.5)
    embedding, action = jnp.ones((2, 5, nets.embedding)), jnp.ones((2, 5, 2))
    first = jnp.zeros((2, 5), bool)

    def loss(params):
        latent, logits = observe(nets.rssm, params, uniform, tiny.latent((2,)), embedding, action, first)
        return jnp.sum(latent.deter) + jnp.sum(logits**2)

    with traced_for(platform):
        program = jax.make_jaxpr(jax.grad(loss))(params)
    scans = [equation for equation in program.eqns if equation.primitive.name == "scan"]
    (forward,) = [scan for scan in scans if not scan.params["reverse"]]
    returned = len(jax.tree.leaves((tiny.latent((2,)), 0)))  # and the carry is kept besides
    kept = len(forward.outvars) - forward.params["num_carry"] - returned
    blocks = nets.rssm.config.blocks if platform == "cpu" else 1
    products = 5 + 2 * blocks
    assert 0 < kept <= products + 3, [str(x.aval) for x in forward.outvars]
