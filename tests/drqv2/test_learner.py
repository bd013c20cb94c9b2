"""DrQ-v2's networks, its exploration and its update."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.agents.drqv2.config import DIFFICULTY, NOISE_STEPS, for_task
from ne_dreamer_jax.agents.drqv2.learner import critic_loss, noise, sample
from ne_dreamer_jax.agents.drqv2.networks import Networks, stride_two
from ne_dreamer_jax.agents.drqv2.transitions import n_step
from ne_dreamer_jax.envs import registry
from ne_dreamer_jax.nets.pixels import space_to_depth
from ne_dreamer_jax.types import ArraySpec, ContinuousAction, DiscreteAction, EnvSpec, TimeStep
from tests.drqv2 import small
from tests.tiny import assert_same

pytestmark = pytest.mark.usefixtures("quick_compilation")


def test_the_defaults_are_the_published_ones():
    c = DrQv2Config()
    assert (c.frame_stack, c.n_step, c.discount, c.batch_size, c.channels) == (3, 3, 0.99, 256, 32)
    assert (c.features, c.units, c.learning_rate, c.target_rate, c.shift) == (50, 1024, 1e-4, 0.01, 4)
    assert (c.noise_first, c.noise_last, c.noise_clip, c.random_steps, c.steps_per_update) == (1.0, 0.1, 0.3, 2000, 2)
    assert NOISE_STEPS == {"easy": 100_000, "medium": 500_000, "hard": 2_000_000}
    assert set(DIFFICULTY) == {name for name in registry.names() if name.startswith("dmc/")}
    assert for_task("dmc/cartpole_swingup").noise_steps == 100_000
    assert for_task("dmc/cheetah_run") == dataclasses.replace(c, noise_steps=500_000)
    assert for_task("dmc/walker_walk") == dataclasses.replace(c, n_step=1, batch_size=512)
    assert for_task("another").noise_steps == 500_000


@pytest.mark.parametrize("difficulty", NOISE_STEPS)
def test_the_noise_falls_linearly_and_stays(difficulty):
    steps = NOISE_STEPS[difficulty]
    config = DrQv2Config(noise_steps=steps)
    at = [0, steps // 4, steps // 2, steps, 3 * steps]
    got = [float(noise(config, jnp.asarray(step, jnp.int32))) for step in at]
    np.testing.assert_allclose(got, [1.0, 0.775, 0.55, 0.1, 0.1], rtol=1e-6)


def test_samples_have_the_noise_clipped_and_pass_gradients_beyond_the_bounds():
    mean = jnp.asarray([[0.95, 0.0]])
    draw = lambda key, std, clip: sample(key, mean, std, clip)[0]
    keys = jax.random.split(jax.random.key(0), 2000)
    clipped = jax.vmap(lambda key: draw(key, jnp.asarray(0.5), 0.3))(keys)
    assert float(jnp.max(jnp.abs(clipped[:, 1]))) == pytest.approx(0.3)
    assert float(jnp.max(clipped)) < 1.0
    free = jax.vmap(lambda key: draw(key, jnp.asarray(0.2), jnp.inf))(keys)
    assert float(jnp.std(free[:, 1])) == pytest.approx(0.2, rel=0.1)
    gradient = jax.jacobian(lambda m: sample(keys[0], m, jnp.asarray(9.0), jnp.inf))(mean)
    np.testing.assert_array_equal(gradient.reshape(2, 2), np.eye(2))


@pytest.mark.parametrize("side", [16, 17])
def test_a_convolution_of_stride_two_is_one_on_blocks(side):
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.normal(size=(2, side, side + 3, 3)).astype(np.float32))
    kernel = jnp.asarray(rng.normal(size=(3, 3, 3, 4)).astype(np.float32))
    numbers = ("NHWC", "HWIO", "NHWC")
    want = jax.lax.conv_general_dilated(x, kernel, (2, 2), "VALID", dimension_numbers=numbers)
    got = jax.lax.conv_general_dilated(
        space_to_depth(x, 2), stride_two(kernel), (1, 1), "VALID", dimension_numbers=numbers
    )
    np.testing.assert_allclose(got, want, atol=1e-4)


def test_the_encoder_is_four_plain_convolutions_on_stacked_channels():
    nets = Networks.build(small.CONFIG, small.BOTH)
    params = nets.init(jax.random.split(jax.random.key(0), 3))["encoder"]
    params = {name: x + 0.1 if "bias" in name else x for name, x in params.items()}
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, 3, 16, 17, 3)).astype(np.uint8)
    vectors = rng.normal(size=(2, 3, 3)).astype(np.float32)
    x = jnp.asarray(np.concatenate([images[:, i] for i in range(3)], axis=-1).astype(np.float32)) / 255.0 - 0.5
    for i in range(4):
        stride = (1, 1) if i else (2, 2)
        numbers = ("NHWC", "HWIO", "NHWC")
        kernel, bias = params[f"conv{i}_kernel"], params[f"conv{i}_bias"]
        x = jax.lax.conv_general_dilated(x, kernel, stride, "VALID", dimension_numbers=numbers)
        x = jax.nn.relu(x + bias[None, None, None])
        columns = np.asarray(kernel).reshape(-1, kernel.shape[-1])
        np.testing.assert_allclose(columns.T @ columns, 2 * np.eye(columns.shape[1]), atol=1e-5)
    want = np.concatenate([vectors.reshape(2, -1), np.asarray(x).reshape(2, -1)], axis=1)
    got = nets.encode(params, {"image": jnp.asarray(images), "vector": jnp.asarray(vectors)})
    np.testing.assert_allclose(got, want, atol=1e-5)


def test_the_published_network_has_the_published_shapes():
    spec = EnvSpec({"image": ArraySpec((84, 84, 3), jnp.uint8)}, ContinuousAction(6))
    agent = make_agent(DrQv2Config(), spec)
    params = jax.eval_shape(agent.init, jax.random.key(0)).params
    assert params["encoder"]["conv0_kernel"].shape == (3, 3, 9, 32)
    assert params["actor"]["trunk"]["kernel"].shape == (32 * 35 * 35, 50)
    assert params["critic"]["q0_hidden0"]["kernel"].shape == (56, 1024)
    assert set(params) == {"encoder", "actor", "critic"}


def timestep(spec, n, first, seed=0):
    rng = np.random.default_rng(seed)
    obs = {}
    for name, (shape, dtype) in spec.observation.items():
        x = rng.integers(0, 256, (n, *shape)) if dtype == jnp.uint8 else rng.normal(size=(n, *shape))
        obs[name] = jnp.asarray(x.astype(dtype))
    no = jnp.zeros((n,), bool)
    return TimeStep(obs, jnp.zeros((n,)), no | first, no, no)


def test_acting_is_random_first_then_noisy_and_its_mode_is_the_mean():
    n, config = 4, dataclasses.replace(small.CONFIG, random_steps=8, noise_steps=1, noise_last=0.05)
    agent = make_agent(config, small.VECTOR)
    params = agent.init(jax.random.key(0)).params
    policy = agent.init_policy(n)
    step = timestep(small.VECTOR, n, True)
    keys = jax.random.split(jax.random.key(1), 4)
    mode = agent.act(params, policy, step, keys[0], mode="mode")[1]
    np.testing.assert_array_equal(mode, agent.act(params, policy, step, keys[1], mode="mode")[1])
    for i in range(4):
        policy, action = agent.act(params, policy, step, keys[i])
        assert int(policy.step) == n * (i + 1)
        np.testing.assert_array_equal(policy.prev_action, action)
        assert float(jnp.max(jnp.abs(action))) < 1.0
        distance = float(jnp.max(jnp.abs(action - mode)))
        assert (distance > 0.3) == (i < 2), "the first 8 agent steps are random, then the noise is 0.05"
    most = jnp.asarray(2**31 - 2, jnp.int32)
    policy, _ = agent.act(params, policy._replace(step=most), step, keys[0])
    assert int(policy.step) == 2**31 - 1, "counted to the end, and not begun anew"
    with pytest.raises(ValueError, match="mode: expected"):
        agent.act(params, policy, step, keys[0], mode="best")


@pytest.fixture(scope="module", params=["image", "vector"])
def quiet(request):
    """An agent whose update has no randomness: no noise, no shifts."""
    spec = small.IMAGE if request.param == "image" else small.VECTOR
    config = dataclasses.replace(small.CONFIG, noise_first=0.0, noise_last=0.0, shift=0)
    agent = make_agent(config, spec)
    state = agent.init(jax.random.key(3))
    target = jax.tree.map(lambda x: 0.9 * x, state.target)
    return SimpleNamespace(config=config, spec=spec, agent=agent, state=state._replace(target=target))


def adam_once(params, grads, rate):
    """The first step of Adam: its moments are the gradient and its square."""
    return jax.tree.map(lambda p, g: p - rate * g / (jnp.sqrt(g * g) + 1e-8), params, grads)


def test_an_update_is_what_the_equations_say(quiet):
    """Critic and encoder by the squared errors, then the actor by the new critic, on the old encodings alone."""
    config, state = quiet.config, quiet.state
    batch = small.batch(quiet.spec, config)
    nets = Networks.build(config, quiet.spec)
    data = n_step(batch, config.frame_stack, config.discount)
    keep = np.flatnonzero(np.asarray(data.valid))
    assert len(keep) == config.batch_size - 1
    data = jax.tree.map(lambda x: x[keep], data)
    actor, target = state.params["actor"], state.target

    next_encoding = nets.encode(state.params["encoder"], data.next_obs)
    next_action = jnp.clip(nets.mean(actor, next_encoding), -1 + 1e-6, 1 - 1e-6)
    next_values = np.asarray(nets.values(target, next_encoding, next_action)).min(axis=1)
    aim = jnp.asarray(np.asarray(data.reward) + np.asarray(data.discount) * next_values)

    def error(params):
        values = nets.values(params["critic"], nets.encode(params["encoder"], data.obs), data.action)
        return jnp.mean(jnp.square(values[:, 0] - aim)) + jnp.mean(jnp.square(values[:, 1] - aim))

    before = {name: state.params[name] for name in ("encoder", "critic")}
    want = adam_once(before, jax.grad(error)(before), config.learning_rate)
    encoding = nets.encode(state.params["encoder"], data.obs)  # of the old encoder

    def loss(params):
        return -jnp.mean(jnp.min(nets.values(want["critic"], encoding, nets.mean(params, encoding)), axis=1))

    want["actor"] = adam_once(actor, jax.grad(loss)(actor), config.learning_rate)
    new, latents, metrics = quiet.agent.train_step(small.copy(state), batch)
    assert latents.deter.shape == (config.batch_size, config.batch_length, 0)
    assert float(metrics["loss/critic"]) == pytest.approx(float(error(before)), rel=1e-5)
    assert float(metrics["loss/actor"]) == pytest.approx(float(loss(actor)), rel=1e-5)
    assert float(metrics["target"]) == pytest.approx(float(jnp.mean(aim)), rel=1e-5, abs=1e-7)
    flat = lambda tree: jax.tree.leaves_with_path(tree)
    for (path, got), (_, expected) in zip(flat(new.params), flat(want), strict=True):
        # Where a gradient all but vanishes, the first step of Adam amplifies its rounding.
        wrong = np.abs(np.asarray(got) - np.asarray(expected)) > 1e-5
        assert wrong.mean() < 0.02, jax.tree_util.keystr(path)
    average = jax.tree.map(lambda slow, fast: 0.99 * slow + 0.01 * fast, target, new.params["critic"])
    for got, expected in zip(jax.tree.leaves(new.target), jax.tree.leaves(average), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-6)
    assert int(new.update) == 1


def test_the_actors_gradient_does_not_reach_the_encoder(quiet):
    """Rewards that make every value right leave the critics and the encoder nothing to learn; the actor learns."""
    config = quiet.config
    nets = Networks.build(config, quiet.spec)
    critic = quiet.state.params["critic"]
    critic = {name: critic[name.replace("q1", "q0")] for name in critic}  # two equal ones
    params = {**quiet.state.params, "critic": critic}
    state = quiet.state._replace(params=params, target=critic)
    batch = small.batch(quiet.spec, config)
    data = n_step(batch, config.frame_stack, config.discount)
    value = lambda obs, action: nets.values(critic, nets.encode(params["encoder"], obs), action)[:, 0]
    mean = nets.mean(params["actor"], nets.encode(params["encoder"], data.next_obs))
    reward = value(data.obs, data.action) - data.discount * value(data.next_obs, mean)
    batch = batch._replace(reward=jnp.zeros_like(batch.reward).at[:, config.frame_stack].set(reward))
    new, _, metrics = quiet.agent.train_step(small.copy(state), batch)
    gradient = {name: float(jnp.max(jnp.abs(optax.tree.get(new.optimizer[name], "mu")))) for name in new.optimizer}
    assert float(metrics["loss/critic"]) < 1e-8
    assert gradient["critic"] < 1e-5
    assert gradient["actor"] > 1e-3


def test_the_critics_loss_by_hand():
    values = jnp.asarray([[1.0, 2.0], [0.0, 3.0], [9.0, 9.0]])
    loss = critic_loss(values, jnp.asarray([2.0, 1.0, -100.0]), jnp.asarray([True, True, False]))
    assert float(loss) == pytest.approx(((1 + 0) + (1 + 4)) / 2)
    assert float(critic_loss(values, jnp.zeros((3,)), jnp.zeros((3,), bool))) == 0.0


@pytest.fixture(scope="module")
def loud():
    """An agent with noise and shifts, whose noise falls within a few updates."""
    config = dataclasses.replace(small.CONFIG, random_steps=100, steps_per_update=50.0, noise_steps=1000)
    return make_agent(config, small.BOTH)


def test_the_same_seed_gives_the_same_bits_in_one_program(loud):
    batch = small.batch(small.BOTH)

    def run(seed):
        state = loud.init(jax.random.key(seed))
        for _ in range(3):
            state, _, metrics = loud.train_step(state, batch)
        return state, metrics

    assert_same(run(0), run(0))
    assert loud.train_step._cache_size() == 1
    others = [np.any(np.asarray(a) != np.asarray(b)) for a, b in zip(*map(leaves, (run(0), run(1))), strict=True)]
    assert any(others)


def leaves(run):
    return jax.tree.leaves(run[0].params["actor"])


def test_the_noise_of_updates_follows_the_agent_steps(loud):
    state = loud.init(jax.random.key(0))
    for update in (0, 6, 30):
        state = state._replace(update=jnp.asarray(update, jnp.int32))
        state, _, metrics = loud.train_step(state, small.batch(small.BOTH))
        want = noise(loud.config, jnp.asarray(100 + 50 * update, jnp.int32))
        assert float(metrics["noise"]) == pytest.approx(float(want), rel=1e-6)


@pytest.mark.parametrize(
    ("config", "spec", "message"),
    [
        (DrQv2Config(), EnvSpec(small.VECTOR.observation, DiscreteAction(3)), "expected continuous actions, got Disc"),
        (DrQv2Config(), EnvSpec({"image": ArraySpec((14, 20, 3), jnp.uint8)}, ContinuousAction(1)), "at least 15, got"),
    ],
)
def test_what_does_not_fit_is_refused(config, spec, message):
    with pytest.raises(ValueError, match=message):
        make_agent(config, spec)


def test_a_batch_that_does_not_fit_is_refused(quiet):
    batch = small.batch(quiet.spec)
    with pytest.raises(ValueError, match=r"does not fit the agent: .*reward: expected float32\[6, 6\]"):
        quiet.agent.train_step(small.copy(quiet.state), batch._replace(reward=batch.reward[:, 1:]))
