"""Episodes of other people's in replay, and learning from them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax import loop, make_agent, replay
from ne_dreamer_jax.replay import Episode, ring
from ne_dreamer_jax.system import memory
from ne_dreamer_jax.types import ArraySpec, DiscreteAction, EnvSpec
from tests import counting, tiny

pytestmark = pytest.mark.usefixtures("quick_compilation")

SPEC = tiny.BOTH
SIZES = tiny.CONFIG.latent_sizes


def episode(length=6, terminal=False, seed=0, **changes):
    rng = np.random.default_rng(seed)
    obs = {
        "image": rng.integers(0, 255, (length + 1, 8, 8, 3), np.uint8),
        "vector": rng.normal(size=(length + 1, 3)),  # float64, as data sets have it
    }
    made = Episode(obs, rng.uniform(-1, 1, (length, 2)), rng.normal(size=length), terminal)
    return made._replace(**changes)


def test_steps_are_held_in_the_time_convention():
    episodes = [episode(4, True, 0), episode(5, False, 1)]
    data = replay.from_episodes(iter(episodes), SPEC, SIZES).data
    begin = 0
    for made in episodes:
        length = len(made.reward)
        rows = slice(begin, begin + length + 1)
        np.testing.assert_array_equal(data.obs["image"][rows, 0], made.obs["image"])
        np.testing.assert_allclose(data.obs["vector"][rows, 0], made.obs["vector"], rtol=1e-6)
        np.testing.assert_allclose(data.action[rows, 0][:-1], made.action, rtol=1e-6)
        np.testing.assert_allclose(data.reward[rows, 0], [0, *made.reward], rtol=1e-6)  # on arrival
        np.testing.assert_array_equal(data.is_first[rows, 0], np.arange(length + 1) == 0)
        np.testing.assert_array_equal(data.is_last[rows, 0], np.arange(length + 1) == length)
        assert bool(data.is_terminal[begin + length, 0]) == made.is_terminal
        begin += length + 1
    assert begin == data.reward.shape[0]


def test_data_that_fits_memory_once_is_held_once(monkeypatch):
    episodes = [episode(40, seed=s) for s in range(3)]
    made = replay.from_episodes(episodes, SPEC, SIZES)
    size = sum(x.nbytes for x in jax.tree.leaves(made.data))
    allocated = []
    zeros = jnp.zeros
    monkeypatch.setattr(
        jnp, "zeros", lambda *args, **options: allocated.append(zeros(*args, **options)) or allocated[-1]
    )
    replay.from_episodes(episodes, SPEC, SIZES)
    latents = sum(x.nbytes for x in jax.tree.leaves(made.data.latent))
    assert sum(x.nbytes for x in allocated) <= latents + 64 < size / 2
    monkeypatch.setattr(memory, "available", lambda: size // 2)
    with pytest.raises(ValueError, match="free"):
        replay.from_episodes(episodes, SPEC, SIZES)


def test_every_sequence_of_the_data_is_sampled_and_none_that_wraps_around():
    held = replay.from_episodes([episode(6, seed=s) for s in range(3)], SPEC, SIZES)
    batch = jax.jit(replay.sample, static_argnums=(2, 3))(held, jax.random.key(0), 500, 5)
    first = np.asarray(batch.index[:, 0])
    assert set(first) == set(range(1, 21 - 5 + 1))
    np.testing.assert_array_equal(np.diff(batch.index, axis=1), 1)


def test_an_agent_learns_from_episodes_without_an_environment():
    agent = make_agent(tiny.CONFIG, SPEC)
    held = replay.from_episodes([episode(9, seed=s) for s in range(3)], SPEC, SIZES)
    state = agent.init(jax.random.key(0))
    before = jax.tree.map(np.asarray, state.params)
    state, held, metrics = loop.train_offline(agent, state, held, jax.random.key(1), updates=3)
    assert int(state.update) == 3
    assert all(np.isfinite(value) for value in metrics.values())
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), before, jax.tree.map(np.asarray, state.params))
    assert all(jax.tree.leaves(changed["actor"]))
    assert np.any(held.data.latent.deter), "latents are written back"


def test_an_agent_that_learns_again_is_not_compiled_again():
    agent = make_agent(tiny.CONFIG, SPEC)
    held = replay.from_episodes([episode(9, seed=s) for s in range(3)], SPEC, SIZES)
    state, traced = agent.init(jax.random.key(0)), []

    def train_step(state, batch):
        traced.append(batch)
        return agent.train_step(state, batch)

    counting = agent._replace(train_step=train_step)
    state, held, _ = loop.train_offline(counting, state, held, jax.random.key(1), updates=1)
    times = len(traced)
    state, held, _ = loop.train_offline(counting, state, held, jax.random.key(2), updates=2)
    assert len(traced) == times
    assert int(state.update) == 3
    larger = counting._replace(config=dataclasses.replace(agent.config, batch_size=2 * agent.config.batch_size))
    loop.train_offline(larger, state, held, jax.random.key(3), updates=1)
    assert traced[-1].reward.shape[0] == 2 * agent.config.batch_size


def test_skipped_updates_are_counted_and_not_in_the_means():
    agent, key = make_agent(tiny.CONFIG, SPEC), jax.random.key(1)
    held = replay.from_episodes([episode(9, seed=s) for s in range(3)], SPEC, SIZES)
    broken = dataclasses.replace(held, data=held.data._replace(reward=jnp.full_like(held.data.reward, jnp.nan)))
    state = agent.init(jax.random.key(0))
    _, _, metrics = loop.train_offline(agent, jax.tree.map(jnp.copy, state), broken, key, updates=3)
    assert metrics["skipped_updates"] == metrics["non_finite/loss/reward"] == 3
    assert np.isnan(metrics["loss/total"])


def test_means_over_many_updates_are_of_all_of_them():
    """Added up in one float32 sum, 100,000 times 0.1 would differ by 1e-4."""
    stub = counting.stub(SPEC)
    made, value = stub.train_step, np.float32(0.1)

    def train_step(state, batch):
        state, latent, metrics = made(state, batch)
        return state, latent, metrics | {"value": jnp.asarray(value)}

    stub.train_step = train_step
    held = replay.from_episodes([episode(9)], SPEC, (2, 1, 2))
    state = stub.init(jax.random.key(0))
    _, _, metrics = loop.train_offline(stub, state, held, jax.random.key(1), updates=100_000, write_latents=False)
    np.testing.assert_allclose(metrics["value"], value, rtol=2e-5)
    np.testing.assert_allclose(metrics["update"], 50_000.5, rtol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward": np.zeros(5)}, r"episode 1, action: expected float32\[5, 2\], got float64\[6, 2\]"),
        ({"reward": np.zeros((6, 1))}, r"episode 1, reward: expected float32\['L'\], got float64\[6, 1\]"),
        ({"action": np.zeros((7, 2))}, r"episode 1, action: expected float32\[6, 2\], got float64\[7, 2\]"),
        ({"action": np.full((6, 2), 3.0)}, r"episode 1, action: expected values from -1 to 1, got 3.0 to 3.0"),
        ({"obs": {"vector": np.zeros((7, 3))}}, r"expected observations named \['image', 'vector'\], got \['vector'\]"),
        (
            {"obs": {"image": np.zeros((7, 8, 8, 3)), "vector": np.zeros((7, 3))}},
            r"obs\['image'\]: expected uint8\[7, 8, 8, 3\], got float64\[7, 8, 8, 3\]",
        ),
        (
            {"obs": {"image": np.zeros((6, 8, 8, 3), np.uint8), "vector": np.zeros((7, 3))}},
            r"obs\['image'\]: expected uint8\[7, 8, 8, 3\], got uint8\[6, 8, 8, 3\]",
        ),
        ({"is_terminal": np.zeros(6, bool)}, r"episode 1, is_terminal: expected one bool for the whole episode"),
        ({"is_terminal": 2}, r"episode 1, is_terminal: expected one bool for the whole episode, got 2"),
        ({"is_terminal": [[1], [1, 2]]}, r"episode 1, is_terminal: expected one bool for the whole episode"),
        ({"is_terminal": np.void(b"x")}, r"episode 1, is_terminal: expected one bool for the whole episode"),
        ({"is_terminal": "yes"}, r"episode 1, is_terminal: expected one bool for the whole episode, got yes"),
        ({"reward": np.full(6, np.nan)}, r"episode 1, reward: expected finite numbers, got nan"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_place(changes, message):
    with pytest.raises(ValueError, match=message):
        replay.from_episodes([episode(), episode(**changes)], SPEC, SIZES)


@pytest.mark.parametrize("given", [0, 1, 1.0, np.bool_(True), np.int64(0)])
def test_an_end_may_be_a_number_as_in_data_sets(given):
    held = replay.from_episodes([episode(is_terminal=given), episode(is_terminal=bool(given))], SPEC, SIZES)
    assert int(np.sum(held.data.is_terminal)) == 2 * given


def test_a_continuous_action_may_exceed_one_by_round_off():
    held = replay.from_episodes([episode(action=np.full((6, 2), np.nextafter(1.0, 2.0)))], SPEC, SIZES)
    assert np.max(held.data.action) == 1.0


def test_a_discrete_action_that_would_wrap_round_is_refused():
    spec = EnvSpec({"vector": ArraySpec((3,), jnp.float32)}, DiscreteAction(3))
    one = replay.Episode({"vector": np.zeros((3, 3), np.float32)}, np.array([0, 2**32 + 1]), np.zeros(2), False)
    with pytest.raises(ValueError, match="episode 0, action: expected values from 0 to 2, got 0 to 4294967297"):
        replay.from_episodes([one], spec, SIZES)


def test_too_little_data_is_refused():
    for wrong, message in (
        ([], "at least one episode, got none"),
        (episode(), "put it into a list"),
        ([{}], "got dict"),
    ):
        with pytest.raises(ValueError, match=message):
            replay.from_episodes(wrong, SPEC, SIZES)
    agent = make_agent(tiny.CONFIG, SPEC)
    held = replay.from_episodes([episode(3)], SPEC, SIZES)
    shapes = jax.eval_shape(agent.init, jax.random.key(0))
    with pytest.raises(ValueError, match=r"expected more than agent.batch_length 5 steps, got 4"):
        loop.train_offline(agent, shapes, held, jax.random.key(0), 1)
    assert int(ring.next_row(held)) == 0
    assert held.data.reward.dtype == jnp.float32
