"""An update whose numbers are not finite changes nothing, to the bit, and is named."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.guard import PREFIX, SKIPPED, is_sound
from ne_dreamer_jax.envs import base
from ne_dreamer_jax.runs import endings, run_directory
from ne_dreamer_jax.runs.record import Record
from tests import tiny
from tests.drqv2 import small
from tests.experiments import stub, toy
from tests.marks import slow_but

pytestmark = pytest.mark.usefixtures("quick_compilation")


def bits(tree):
    """Of all arrays, typed keys included."""
    plain = lambda x: jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return [np.asarray(plain(x)).tobytes() for x in jax.tree.leaves(tree)]


@pytest.fixture(scope="module")
def agent():
    return make_agent(tiny.CONFIG, tiny.VECTORS)


SPOILED = {
    "reward": lambda batch: batch._replace(reward=batch.reward.at[1, 2].set(jnp.nan)),
    "observation": lambda batch: batch._replace(obs={name: x.at[0, 3].set(jnp.nan) for name, x in batch.obs.items()}),
    "latent": lambda batch: batch._replace(
        context=batch.context._replace(deter=batch.context.deter.at[0].set(jnp.nan)),
        is_first=jnp.zeros_like(batch.is_first),
    ),
}


@pytest.mark.parametrize("where", SPOILED)
def test_a_batch_that_is_not_finite_changes_no_bit_of_the_state(agent, where):
    state, batch = agent.init(jax.random.key(0)), tiny.batch(tiny.VECTORS)
    state, _, metrics = agent.train_step(state, batch)
    assert metrics[SKIPPED] == 0
    assert not any(value for name, value in metrics.items() if name.startswith(PREFIX))
    before = bits(state)
    state, _, metrics = agent.train_step(state, SPOILED[where](batch))
    assert bits(state) == before
    assert metrics[SKIPPED] == 1
    guilty = {name for name, value in metrics.items() if name.startswith(PREFIX) and value}
    assert f"{PREFIX}gradient/rssm" in guilty
    assert ("reward" in where) == (f"{PREFIX}loss/dynamics" not in guilty), "the loss at fault is told from others"
    state, _, metrics = agent.train_step(state, batch)
    assert metrics[SKIPPED] == 0
    assert int(state.update) == 2


def test_a_gradient_that_is_not_finite_where_the_loss_is_changes_nothing(agent):
    """Rewards so large that the gradient's squares overflow, or parameters that are."""
    state = agent.init(jax.random.key(0))
    params = jax.tree.map(lambda x: x, state.params)
    params["encoder"] = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), params["encoder"])
    before = bits(state._replace(params=params))
    new, _, metrics = agent.train_step(state._replace(params=params), tiny.batch(tiny.VECTORS))
    assert bits(new) == before
    assert metrics[f"{PREFIX}gradient/encoder"] == 1


@pytest.mark.parametrize("value", [jnp.nan, -jnp.nan, jnp.inf, -jnp.inf, 2.0**50, -1e30])
def test_one_element_makes_a_tree_unsound(value):
    tree = {"a": jnp.asarray([-0.0, 1e-42, -(2.0**49)]), "b": jnp.zeros((0, 3)), "c": jnp.zeros((4, 4))}
    assert is_sound(tree)
    assert not is_sound({**tree, "c": tree["c"].at[2, 1].set(value)})


def test_drqv2_skips_likewise():
    agent = make_agent(small.CONFIG, small.VECTOR)
    state, batch = agent.init(jax.random.key(0)), small.batch(small.VECTOR)
    state, _, metrics = agent.train_step(state, batch)
    assert metrics[SKIPPED] == 0
    before = bits(state)
    state, _, metrics = agent.train_step(state, batch._replace(reward=batch.reward.at[0].set(jnp.nan)))
    assert bits(state) == before
    assert metrics[f"{PREFIX}loss/critic"] == metrics[SKIPPED] == 1


def huge(reward):
    """The toy environment with rewards of this size."""
    env = toy.env()

    def step(state, action):
        state, timestep = env.step(state, action)
        return state, timestep._replace(reward=jnp.where(timestep.is_first, 0.0, jnp.float32(reward)))

    return env._replace(step=step)


@pytest.mark.slow
@pytest.mark.parametrize("reward", [1e6, -1e6, 0.0, 3e38])
def test_large_negative_and_constant_rewards_are_learned_from(tmp_path, reward):
    outcome = nedreamer.train(toy.config(), tmp_path / "run", env=huge(reward), echo=lambda line: None)
    assert outcome.code == 0
    loaded = nedreamer.load(tmp_path / "run", env=huge(reward), prefer="newest")
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(loaded.state.params))


@pytest.mark.parametrize("length", slow_but([1, 2], 1))
def test_episodes_of_one_and_two_steps_are_learned_from(tmp_path, length):
    def reset(key):
        return jax.random.normal(key), jnp.zeros((), jnp.int32)

    def step(state, action):
        last = state[1] + 1 >= length
        return (state[0] + action[0], state[1] + 1), base.Progress(state[0], last, last, jnp.ones((), bool))

    env = base.from_core(
        base.Core(toy.env().spec, reset, base.restart_or_step(reset, step), lambda s: {"position": s[0][None]})
    )
    assert nedreamer.train(toy.config(), tmp_path / "run", env=env, echo=lambda line: None).code == 0


def test_a_diverging_agent_stops_with_the_last_good_checkpoint_named(tmp_path):
    config = toy.config(env_steps=2_000, max_skipped=10)
    optimizer = dataclasses.replace(config.agent.optimizer, learning_rate=1e25, warmup=0)
    config = dataclasses.replace(config, agent=dataclasses.replace(config.agent, optimizer=optimizer))
    said = []
    outcome = nedreamer.train(config, tmp_path / "run", env=toy.env(), echo=said.append)
    assert outcome.code == 3
    assert any("updates in a row were not finite" in line and "loss/" in line for line in said)
    assert any("skipped updates: " in line for line in said)
    for found in nedreamer.checkpoint.checkpoints(outcome.files.checkpoints):
        assert found.step < 2_000
    loaded = (
        nedreamer.load(tmp_path / "run", env=toy.env(), prefer="newest")
        if list(outcome.files.checkpoints.glob("0*"))
        else None
    )
    assert loaded is None or all(np.isfinite(x).all() for x in jax.tree.leaves(loaded.state.params))
    assert any("with --fork" in line and "a lower agent.optimizer.learning_rate" in line for line in said)


def test_a_run_that_ends_with_skipped_updates_says_how_many(tmp_path):
    run = stub.build(toy.config(), image=False)
    lines = [{"env_step": 8 * n, "train/skipped_updates": n} for n in range(4)]
    record = Record(None, lines, print)
    said = endings.conclusion(run, run_directory.RunDirectory(tmp_path), record, 2)
    assert f"6 of {run.loop.budget.updates} updates were skipped" in said[1]
    assert "2 of them in a row at the end" in said[1]
    sound = endings.conclusion(run, run_directory.RunDirectory(tmp_path), Record(None, [], print), 0)
    assert "skipped" not in " ".join(sound)
