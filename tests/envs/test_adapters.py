"""Adapters, on small environments of each style: `fakes`. The libraries themselves: test_adapted_libraries."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.envs import adapters, conformance
from ne_dreamer_jax.envs.adapters import common
from ne_dreamer_jax.envs.adapters.brax import from_brax
from ne_dreamer_jax.envs.adapters.gymnax import from_gymnax
from ne_dreamer_jax.envs.adapters.xminigrid import from_xminigrid, one_hots
from ne_dreamer_jax.types import ContinuousAction, DiscreteAction
from tests.envs import fakes
from tests.envs.fakes import GOAL, LIMIT, Choice, Space

pytestmark = pytest.mark.usefixtures("quick_compilation")

MAKE = {
    "one done": lambda: from_gymnax(fakes.Gymnax()),
    "is_truncated": lambda: from_gymnax(fakes.Gymnax1()),
    "info": lambda: from_gymnax(fakes.Informing()),
    "continuous": lambda: from_gymnax(fakes.Gymnax(continuous=True)),
    "brax": lambda: from_brax(fakes.Brax(), episode_length=LIMIT),
    "grid": lambda: from_xminigrid(fakes.Grid(), fakes.Params(), layers=(5, 3)),
}


def play(env, actions, key=0):
    """The states and time steps of an episode, its first included."""
    step = jax.jit(env.step)
    dtype = env.spec.action.dtype
    state, timestep = jax.jit(env.reset)(jax.random.key(key))
    seen = [(state, timestep)]
    for action in actions:
        state, timestep = step(state, jnp.full(env.spec.action.shape, action, dtype))
        seen.append((state, timestep))
    return seen


def flags(seen):
    return [(bool(t.is_first), bool(t.is_last), bool(t.is_terminal)) for _, t in seen]


@pytest.mark.parametrize("name", MAKE)
def test_each_style_conforms(name):
    assert conformance.findings(MAKE[name](), jax.random.key(0), beginning_steps=15, echo=lambda line: None) == []


# Ends. The walkers start below 1 and make steps of 0 or 1.


@pytest.mark.parametrize("name", MAKE)
def test_an_end_by_itself_is_terminal(name):
    env = MAKE[name]()
    seen = play(env, [0.0 if name == "continuous" else 1] * (GOAL + 1))  # 0 is the middle of [-1, 3]
    last = next(i for i, (_, t) in enumerate(seen) if t.is_last)
    assert last in (GOAL - 1, GOAL)  # some start closer to it
    assert flags(seen)[last] == (False, True, True)
    assert flags(seen)[last + 1] == (True, False, False)


@pytest.mark.parametrize("name", MAKE)
def test_a_time_limit_is_not_terminal(name):
    env = MAKE[name]()
    seen = play(env, [-0.5 if name == "continuous" else 0] * (LIMIT + 1))  # -0.5 is 0 in [-1, 3]
    middle = [(False, False, False)] * (LIMIT - 1)
    assert flags(seen) == [(True, False, False), *middle, (False, True, False), (True, False, False)]


@pytest.mark.parametrize(("name", "terminal"), [("one done", True), ("is_truncated", True), ("info", False)])
def test_an_end_by_itself_in_the_step_of_the_time_limit(name, terminal):
    seen = play(MAKE[name](), [0, 0, 1, 1, 1])
    assert flags(seen)[LIMIT] == (False, True, terminal)


def test_without_a_time_limit_every_end_is_terminal_and_there_is_no_other():
    seen = play(from_gymnax(fakes.Endless()), [0] * (3 * LIMIT) + [1] * GOAL)
    assert flags(seen)[1:] == [(False, False, False)] * (3 * LIMIT + GOAL - 1) + [(False, True, True)]


def test_a_parameter_sets_the_time_limit():
    seen = play(from_gymnax(fakes.Gymnax(), fakes.Params(max_steps_in_episode=2)), [0, 0])
    assert flags(seen)[-1] == (False, True, False)


def test_the_observation_of_the_last_step_is_kept_and_the_next_episode_begins_after_it():
    seen = play(from_gymnax(fakes.Gymnax()), [1] * (GOAL + 1))
    places = [float(t.obs["vector"][0]) for _, t in seen]
    assert places == [0, 1, 2, GOAL, 0]
    assert [float(t.reward) for _, t in seen] == [0, 2, 4, 2 * GOAL, 0]


def test_rewards_and_observations_are_float32_and_states_keep_what_steps_make_of_them():
    (first, _), (state, timestep) = play(from_gymnax(fakes.Gymnax(), fakes.Params(stride=0.25)), [1])
    assert first.core.env.place.dtype == jnp.float32  # Python's 0 at reset
    assert float(state.core.env.place) == 0.25
    assert timestep.reward.dtype == jnp.float32
    assert float(timestep.reward) == 0.5


# Keys.


def test_every_step_has_a_key_of_its_own():
    env = from_gymnax(fakes.Gymnax())
    seen = [[float(t.obs["vector"][2]) for _, t in play(env, [0] * (2 * LIMIT + 1), key)] for key in range(3)]
    numbers = np.array(seen)
    assert len(np.unique(numbers)) == numbers.size  # within an episode, from one to the next, between environments
    assert [float(t.obs["vector"][2]) for _, t in play(env, [0] * (2 * LIMIT + 1), 1)] == seen[1]


# Actions.


def test_actions_are_scaled_to_the_bounds_and_clipped():
    env = from_gymnax(fakes.Gymnax(continuous=True))
    assert env.spec.action == ContinuousAction(1)
    for action, size in ((-1.0, -1.0), (1.0, 3.0), (0.0, 1.0), (-0.5, 0.0), (7.0, 3.0), (-7.0, -1.0)):
        (_, (state, _)) = play(env, [action])
        assert float(state.core.env.place) == size


@pytest.mark.parametrize(("low", "high"), [(-0.1, 0.1), (-2.0, 5.0), (0.3, 0.9), (-1e-3, 7e4)])
def test_the_ends_of_the_range_are_the_bounds_to_the_bit(low, high):
    spec, scaled = common.actions(Space(low, np.full((2, 3), high, np.float32), (2, 3), jnp.float32))
    assert spec == ContinuousAction(6)
    np.testing.assert_array_equal(scaled(jnp.ones(6)), np.full((2, 3), high, np.float32))
    np.testing.assert_array_equal(scaled(-jnp.ones(6)), np.full((2, 3), low, np.float32))
    inside = np.asarray(jax.vmap(scaled)(jax.random.uniform(jax.random.key(0), (100, 6), minval=-1.0)))
    assert (inside >= np.float32(low)).all()
    assert (inside <= np.float32(high)).all()
    middle = (np.float32(low) + np.float32(high)) / 2
    np.testing.assert_allclose(scaled(jnp.zeros(6)), np.full((2, 3), middle), rtol=1e-5)


def test_components_have_bounds_of_their_own():
    _, scaled = common.actions(Space(np.array([-1.0, 0.0]), np.array([1.0, 10.0]), (2,), jnp.float32))
    np.testing.assert_allclose(scaled(jnp.array([0.5, 0.5])), [0.5, 7.5])


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (Space(-np.inf, 1.0, (2,), jnp.float32), "finite bounds"),
        (Space(0, 4, (2,), jnp.int32), "a box of floats as action space, got one of int32"),
        (object(), "expected a discrete action space or a box"),
    ],
)
def test_actions_that_cannot_be_adapted_are_refused(space, message):
    with pytest.raises(ValueError, match=message):
        common.actions(space)


# Observations.


class Spaces:
    def __init__(self, **spaces):
        self.spaces = spaces


def converted(obs, space, size=None):
    specs, convert = common.observations(jax.eval_shape(lambda: obs), space, size)
    out = convert(obs)
    assert {name: (x.shape, x.dtype) for name, x in out.items()} == {name: tuple(s) for name, s in specs.items()}
    return out


def test_images_become_uint8():
    image = jnp.array([[[0.0], [1.0], [0.5]], [[0.499 / 255], [0.501 / 255], [2.0]]], jnp.float32)
    out = converted(image, Space(0.0, 1.0, (2, 3, 1), jnp.float32))
    np.testing.assert_array_equal(out["image"][..., 0], [[0, 255, 128], [0, 1, 255]])
    whole = jnp.arange(12, dtype=jnp.uint8).reshape(2, 2, 3)
    np.testing.assert_array_equal(converted(whole, Space(0, 255, (2, 2, 3), jnp.uint8))["image"], whole)
    np.testing.assert_array_equal(converted(whole, None)["image"], whole)
    np.testing.assert_array_equal(converted(whole == 0, None)["image"], np.where(np.asarray(whole) == 0, 255, 0))


def test_all_else_becomes_a_vector():
    assert converted(jnp.int32(3), Choice(5))["vector"].tolist() == [0, 0, 0, 1, 0]
    assert converted(jnp.int32(3), None)["vector"].tolist() == [3]
    assert converted(jnp.array([[True, False]]), Space(0, 1, (1, 2), bool))["vector"].tolist() == [1, 0]
    counts = jnp.arange(8, dtype=jnp.int8).reshape(2, 2, 2)
    assert converted(counts, Space(0, 7, (2, 2, 2), jnp.int8))["vector"].tolist() == list(range(8))
    symbols = counts.astype(jnp.uint8)  # no picture: its values end at 7
    assert converted(symbols, Space(0, 7, (2, 2, 2), jnp.uint8))["vector"].tolist() == list(range(8))


def test_dicts_keep_their_names():
    obs = {"camera": {"left": jnp.zeros((2, 2, 3))}, "pair": (jnp.ones(1), jnp.int32(1)), "level": jnp.int32(2)}
    inner = Spaces(left=Space(0.0, 1.0, (2, 2, 3), jnp.float32))
    out = converted(obs, Spaces(camera=inner, level=Choice(3)))
    assert sorted(out) == ["camera/left", "level", "pair/0", "pair/1"]
    assert out["camera/left"].dtype == jnp.uint8
    assert out["level"].tolist() == [0, 0, 1]
    assert out["pair/1"].tolist() == [1]


def test_a_picture_made_smaller_by_a_whole_factor_has_the_means_of_blocks():
    image = jax.random.randint(jax.random.key(0), (8, 8, 3), 0, 256).astype(jnp.uint8)
    got = common.as_image(image, 1.0, 4)
    means = np.asarray(image, np.float64).reshape(4, 2, 4, 2, 3).mean((1, 3))
    np.testing.assert_array_equal(got, np.floor(means + 0.5))


def test_other_sizes_smooth_what_shrinks_and_repeat_what_grows():
    row = jnp.array([0, 80, 160], jnp.uint8)
    image = jnp.broadcast_to(row[None, :, None], (9, 3, 2))
    got = np.asarray(common.as_image(image, 1.0, 6))
    assert got.shape == (6, 6, 2)
    np.testing.assert_array_equal(got, np.broadcast_to(np.repeat([0, 80, 160], 2)[None, :, None], got.shape))
    flat = common.as_image(jnp.full((130, 110, 3), 77, jnp.uint8), 1.0, 64)
    np.testing.assert_array_equal(flat, np.full((64, 64, 3), 77))


@pytest.mark.parametrize("size", [0, -3, 2.5, True, "64"])
def test_bad_sizes_are_refused(size):
    with pytest.raises(ValueError, match="expected image_size to be a positive int or None"):
        from_gymnax(fakes.Gymnax(), image_size=size)


def test_symbols_become_one_hot_vectors():
    symbols = jnp.array([[[2, 0]], [[0, 1]]], jnp.uint8)
    np.testing.assert_array_equal(one_hots(symbols, (3, 2)), [0, 0, 1, 1, 0, 1, 0, 0, 0, 1])
    with pytest.raises(ValueError, match="expected 3 layers of symbols"):
        one_hots(symbols, (3, 2, 2))
    env = MAKE["grid"]()
    assert env.spec.action == DiscreteAction(2)
    assert env.spec.observation["vector"].shape == (2 * 2 * (5 + 3),)


def test_observations_that_are_not_finite_cut_the_episode():
    class Broken(fakes.Gymnax):
        def get_obs(self, state):
            return jnp.where(state.time >= 2, jnp.nan, 0.5) * jnp.ones((4, 4, 1))

        def observation_space(self, params):
            return Space(0.0, 1.0, (4, 4, 1), jnp.float32)

    seen = play(from_gymnax(Broken(), image_size=4), [0, 0])
    assert flags(seen)[1:] == [(False, False, False), (False, True, False)]
    assert int(seen[-1][0].faults) == 1
    assert seen[-1][1].obs["image"].dtype == jnp.uint8


def test_what_is_drawn_from_the_state_is_what_a_step_draws():
    env = fakes.Gymnax()
    quiet = fakes.Gymnax()
    quiet.get_obs = lambda state: jnp.zeros(())
    actions = [1] * (GOAL + 2)
    kept, drawn = play(from_gymnax(env), actions), play(from_gymnax(quiet, draw=env.get_obs), actions)
    for (_, a), (_, b) in zip(kept, drawn, strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)


# States.


def test_states_that_change_their_shape_or_structure_are_refused():
    class Growing(fakes.Gymnax):
        def step_env(self, key, state, action, params):
            obs, state, reward, done, info = super().step_env(key, state, action, params)
            return obs, state.replace(seen=jnp.zeros(2)), reward, done, info

    class Restless(fakes.Gymnax):
        def step_env(self, key, state, action, params):
            obs, state, reward, done, info = super().step_env(key, state, action, params)
            return obs, state.replace(seen={"more": state.seen}), reward, done, info

    with pytest.raises(ValueError, match=r"state\.seen: expected the shape of reset's, \[\], got \[2\] from step"):
        from_gymnax(Growing())
    with pytest.raises(ValueError, match="expected the structure of reset's"):
        from_gymnax(Restless())


def test_a_reward_of_several_numbers_is_refused():
    class Many(fakes.Gymnax):
        def step_env(self, key, state, action, params):
            obs, state, _, done, info = super().step_env(key, state, action, params)
            return obs, state, jnp.zeros(2), done, info

    with pytest.raises(ValueError, match=r"the reward: expected one number, got an array of shape \[2\]"):
        from_gymnax(Many())


def test_64_bits_elsewhere_change_nothing():
    want = play(from_gymnax(fakes.Gymnax()), [1, 0, 1])
    with jax.enable_x64(True):
        got = play(from_gymnax(fakes.Gymnax()), [1, 0, 1])
    for (_, a), (_, b) in zip(want, got, strict=True):
        assert jax.tree.map(lambda x: x.dtype, a) == jax.tree.map(lambda x: x.dtype, b)
        jax.tree.map(np.testing.assert_array_equal, a, b)


# Brax.


def test_repeated_actions_add_up_rewards_until_it_is_done():
    env = from_brax(fakes.Brax(), episode_length=None, action_repeat=2)
    (state, _), (_, second), (last, third) = play(env, [1, 1])
    start = float(state.core.env[0].place)
    np.testing.assert_allclose(second.reward, 2 * start + 1 + 2, rtol=1e-6)
    np.testing.assert_allclose(third.reward, start + 3, rtol=1e-6)  # done at 3 or more; a fourth step is not made
    np.testing.assert_allclose(last.core.env[0].place, start + 3, rtol=1e-6)
    assert (bool(third.is_last), bool(third.is_terminal)) == (True, True)
    assert sorted(env.spec.observation) == ["double", "position"]


def test_a_time_limit_within_a_repeated_step_ends_it_there():
    """A state beyond the limit, here a terminal one, is never reached."""
    env = from_brax(fakes.Brax(), episode_length=3, action_repeat=2)
    (state, _), _, (last, third) = play(env, [0.8, 0.8])
    start = float(state.core.env[0].place)
    assert start + 4 * 0.8 > fakes.GOAL > start + 3 * 0.8
    np.testing.assert_allclose(last.core.env[0].place, start + 3 * 0.8, rtol=1e-6)
    np.testing.assert_allclose(third.reward, start + 3 * 0.8, rtol=1e-6)
    assert (bool(third.is_last), bool(third.is_terminal)) == (True, False)


def test_braxs_own_time_limit_is_believed():
    class Limited(fakes.Brax):
        def reset(self, rng):
            state = super().reset(rng)
            return state.replace(info={**state.info, "truncation": jnp.zeros(())})

        def step(self, state, action):
            state = super().step(state, action)
            return state.replace(done=jnp.ones(()), info={**state.info, "truncation": jnp.ones(())})

    seen = play(from_brax(Limited(), episode_length=None), [0.0])
    assert flags(seen)[1] == (False, True, False)


@pytest.mark.parametrize("options", [{"episode_length": 0}, {"episode_length": 5, "action_repeat": None}])
def test_bad_lengths_are_refused(options):
    with pytest.raises(ValueError, match="to be a positive int"):
        from_brax(fakes.Brax(), **options)


# Names.


@pytest.mark.parametrize("backend", adapters.BACKENDS)
def test_a_library_that_is_not_installed_is_named_with_the_line_that_installs_it(backend, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    requirement = adapters.BACKENDS[backend].requirement
    with pytest.raises(ValueError, match=f"not installed; install it with: pip install {requirement}"):
        adapters.make(f"jax:{backend}/Anything")


def test_a_library_that_lacks_another_is_named_with_the_line_that_installs_it(tmp_path, monkeypatch):
    (tmp_path / "half_installed.py").write_text("import no_such_package_anywhere\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(adapters.BACKENDS, "gymnax", adapters.Backend("half_installed", "whole==1"))
    with pytest.raises(ValueError, match=r"does not load: No module named .*; install it with: pip install whole==1"):
        adapters.make("jax:gymnax/Anything")


@pytest.mark.parametrize("name", ["jax:", "jax:gymnax", "jax:gymnax/", "gymnax/CartPole-v1", "dmc/walker_walk"])
def test_what_is_no_name_is_refused(name):
    with pytest.raises(ValueError, match="expected the name of an environment, jax:BACKEND/NAME"):
        adapters.make(name)


def test_a_mistyped_backend_brings_the_nearest():
    with pytest.raises(ValueError, match="no backend is called 'gymnas'; did you mean gymnax"):
        adapters.make("jax:gymnas/CartPole-v1")
