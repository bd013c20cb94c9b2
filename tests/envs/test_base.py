"""What from_core adds to a simulation: flags, auto-reset, clipping, the guard. On a toy whose every value is known."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.envs import base, conformance
from ne_dreamer_jax.types import ArraySpec, ContinuousAction, EnvSpec

LIMIT = 4  # steps in an episode


class Walk(NamedTuple):
    """Starts at a random place in [10, 11), moves by the action; above 20 an episode is terminal."""

    place: jax.Array  # float32 []
    steps: jax.Array  # int32 []


def make_core(limit: int = LIMIT) -> base.Core:
    def reset(key):
        return Walk(jax.random.uniform(key, (), jnp.float32, 10.0, 11.0), jnp.zeros((), jnp.int32))

    def step(state, action):
        # An action of exactly 0.5 breaks the simulation down; -0.5 breaks its reward.
        place = jnp.where(action[0] == 0.5, jnp.nan, state.place + action[0])
        state = Walk(place, state.steps + 1)
        is_terminal = place > 20
        reward = jnp.where(action[0] == -0.5, jnp.inf, place)
        return state, base.Progress(reward, (state.steps >= limit) | is_terminal, is_terminal, jnp.isfinite(place))

    def observe(state):
        return {"place": state.place}

    spec = EnvSpec({"place": ArraySpec((), jnp.float32)}, ContinuousAction(1))
    return base.Core(spec, reset, base.restart_or_step(reset, step), observe)


@pytest.fixture(scope="module")
def env():
    return base.from_core(make_core())


@pytest.fixture(scope="module")
def step(env):
    return jax.jit(env.step)


def test_a_simulation_is_traced_once():
    core, traced = make_core(), []

    def step(*args):
        traced.append(args)
        return core.step(*args)

    env = base.from_core(core._replace(step=step))
    keys = jax.random.split(jax.random.key(0), 3)
    state = jax.eval_shape(jax.vmap(env.prepare), keys)
    for _ in range(2):  # as in training and in evaluation
        jax.eval_shape(lambda *args: jax.vmap(env.step)(*args), state, jax.ShapeDtypeStruct((3, 1), jnp.float32))
    assert len(traced) == 1


def act(value):
    return jnp.array([value], jnp.float32)


def test_the_toy_conforms(env):
    conformance.check(env, jax.random.key(0), num_envs=3)


def test_conformance_notices_a_state_that_changes_its_dtype(env):
    def drifting(state, action):
        state, timestep = env.step(state, action)
        return state._replace(faults=state.faults.astype(jnp.float32)), timestep

    with pytest.raises(AssertionError, match=r"step: state.faults: dtype: expected int32, got float32"):
        conformance.check(env._replace(step=drifting), jax.random.key(0))


def test_conformance_notices_a_wrong_first_flag(env):
    def late(state, action):
        state, timestep = env.step(state, action)
        return state, timestep._replace(is_first=jnp.zeros((), bool))

    with pytest.raises(AssertionError, match="right after is_last"):
        conformance.check(env._replace(step=late), jax.random.key(0))


def test_the_time_limit_ends_an_episode_on_its_true_last_observation_and_not_terminally(env, step):
    state, first = env.reset(jax.random.key(0))
    for number in range(1, LIMIT + 1):
        state, timestep = step(state, act(1.0))
        assert float(timestep.obs["place"]) == pytest.approx(float(first.obs["place"]) + number)
        assert bool(timestep.is_last) == (number == LIMIT)
        assert not timestep.is_terminal
        assert not timestep.is_first


def test_the_step_after_the_last_ignores_its_action_and_starts_afresh(env, step):
    state, first = env.reset(jax.random.key(0))
    starts = [float(first.obs["place"])]
    for _ in range(50):
        for _ in range(LIMIT):
            state, timestep = step(state, act(1.0))
        assert timestep.is_last
        state, timestep = step(state, act(1.0))
        assert timestep.is_first
        assert not timestep.is_last
        assert float(timestep.reward) == 0.0
        assert 10 <= float(timestep.obs["place"]) < 11, "an action must not move the first state"
        starts.append(float(timestep.obs["place"]))
    assert len(set(starts)) == len(starts), "every episode has a first state of its own"
    assert 10.3 < np.mean(starts) < 10.7


def test_episodes_differ_between_environments_and_repeat_with_the_key(env):
    places = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), 64))[1].obs["place"]
    assert len(np.unique(places)) == 64
    again = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), 64))[1].obs["place"]
    np.testing.assert_array_equal(places, again)


def test_a_terminal_state_is_last_and_terminal():
    env = base.from_core(make_core(limit=100))
    state, _ = env.reset(jax.random.key(0))
    step = jax.jit(env.step)
    timestep = None
    while timestep is None or not timestep.is_last:
        state, timestep = step(state, act(1.0))
    assert timestep.is_terminal
    assert float(timestep.obs["place"]) > 20


def test_actions_are_clipped(env, step):
    state, first = env.reset(jax.random.key(0))
    _, timestep = step(state, act(5.0))
    assert float(timestep.obs["place"]) == pytest.approx(float(first.obs["place"]) + 1)


@pytest.mark.parametrize("bad_action", [0.5, -0.5, float("nan")])
def test_a_broken_simulation_ends_its_episode_with_reward_zero_and_is_counted(env, step, bad_action):
    state, _ = env.reset(jax.random.key(0))
    state, _ = step(state, act(1.0))
    state, timestep = step(state, act(bad_action))
    assert timestep.is_last
    assert not timestep.is_terminal
    assert float(timestep.reward) == 0.0
    assert np.isfinite(timestep.obs["place"])
    of_action = np.isnan(bad_action)
    assert (int(state.faults), int(state.bad_actions)) == ((0, 1) if of_action else (1, 0))
    state, timestep = step(state, act(1.0))
    assert timestep.is_first
    assert 10 <= float(timestep.obs["place"]) < 11
    state, timestep = step(state, act(1.0))
    assert np.isfinite(timestep.reward)
    assert not timestep.is_last
    assert int(state.faults + state.bad_actions) == 1, "faults are counted since reset"


def test_environments_of_a_batch_restart_one_by_one(env):
    """A batch of staggered environments equals each run alone."""
    step, many = jax.jit(env.step), jax.jit(jax.vmap(env.step))
    keys = jax.random.split(jax.random.key(3), 3)
    alone = [env.reset(key)[0] for key in keys]
    for index, state in enumerate(alone):
        for _ in range(index):
            state, _ = step(state, act(1.0))
        alone[index] = state
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone)
    for _ in range(2 * LIMIT + 1):
        together, timestep = many(together, jnp.ones((3, 1)))
        for index in range(3):
            alone[index], expected = step(alone[index], act(1.0))
            for a, b in zip(jax.tree.leaves(timestep), jax.tree.leaves(expected), strict=True):
                np.testing.assert_array_equal(a[index], b)


def test_every_step_of_an_episode_has_a_key_of_its_own():
    """A core that shows its key: none comes twice, over steps, episodes and environments."""

    def reset(key):
        return Walk(jax.random.uniform(key), jnp.zeros((), jnp.int32))

    def step(state, action, key):
        last = state.steps + 1 >= LIMIT
        progress = base.Progress(jnp.zeros(()), last, jnp.zeros((), bool), jnp.ones((), bool))
        return Walk(jax.random.uniform(key), state.steps + 1), progress

    core = make_core()._replace(reset=reset, step=base.restart_or_step(reset, step, stochastic=True))
    env = base.from_core(core)

    def play(key):
        def step(state, _):
            state, timestep = env.step(state, act(0.0))
            return state, timestep.obs["place"]

        return jax.lax.scan(step, env.prepare(key), None, length=20 * (LIMIT + 1))[1]

    shown = np.asarray(jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(0), 8)))
    assert len(np.unique(shown)) == shown.size
    again = np.asarray(jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(0), 8)))
    np.testing.assert_array_equal(shown, again)


FLAG = lambda: jnp.zeros((), bool)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"observe": lambda state: {"place": jnp.zeros((3,))}},
            r"what observe returns\['place'\]: expected float32\[\], got float32\[3\]",
        ),
        ({"observe": lambda state: {"spot": state.place}}, r"what observe returns: expected the structure"),
        (
            {"reset": lambda key: Walk(1.0, jnp.zeros((), jnp.int32))},
            r"the state that reset returns.place: expected an array of a dtype of its own, got a Python number",
        ),
        (
            {"step": lambda state, action, restart, key: (state, base.Progress(action, FLAG(), FLAG(), FLAG()))},
            r"progress.reward: expected float32\[\], got float32\[1\]",
        ),
        (
            {"step": lambda state, *_: (state.place, base.Progress(state.place, FLAG(), FLAG(), FLAG()))},
            r"the state that step returns: expected the structure",
        ),
        (
            {"blank": lambda: Walk(jnp.zeros(2), jnp.zeros((), jnp.int32))},
            r"that blank returns.place: expected float32",
        ),
        (
            {"spec": EnvSpec({"place": ArraySpec((2, 2), jnp.float32)}, ContinuousAction(1))},
            r"observation 'place': expected an image, uint8 \[height, width, channels\], or a vector",
        ),
    ],
)
def test_parts_that_do_not_fit_each_other_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        base.from_core(make_core()._replace(**changes))


def test_if_needed_computes_only_where_some_of_a_batch_need_it():
    calls = []

    def use(needed, x):
        def compute():
            jax.debug.callback(lambda: calls.append(1))
            return x + 1.0

        return base.if_needed(needed, compute, x)

    run = jax.jit(jax.vmap(use))
    x = jnp.arange(3, dtype=jnp.float32)
    np.testing.assert_array_equal(run(jnp.array([False, False, False]), x), [0, 1, 2])
    jax.effects_barrier()
    assert not calls
    np.testing.assert_array_equal(run(jnp.array([False, True, False]), x), [0, 2, 2])
    jax.effects_barrier()
    assert calls
