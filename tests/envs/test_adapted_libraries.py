"""The libraries themselves, where they are installed: `ne_dreamer_jax.envs.adapters.BACKENDS` says which versions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.envs import adapters, conformance
from ne_dreamer_jax.types import ContinuousAction, DiscreteAction

pytestmark = [
    pytest.mark.usefixtures("quick_compilation"),
    pytest.mark.filterwarnings("ignore"),  # of their own code
]


def library(name):
    pytest.importorskip(adapters.BACKENDS[name].package, exc_type=ImportError)


def rollout(env, actions, key=0):
    """Time steps of a compiled scan, the first included: [len(actions) + 1, ...]."""

    @jax.jit
    def run(key, actions):
        state, first = env.reset(key)
        _, rest = jax.lax.scan(env.step, state, actions)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)

    return jax.device_get(run(jax.random.key(key), jnp.asarray(actions)))


def ends(seen):
    """(step, terminal) of the ends of episodes."""
    return [(int(i), bool(seen.is_terminal[i])) for i in np.flatnonzero(seen.is_last)]


def conforms(name, **options):
    env = adapters.make(name, **options)
    assert conformance.findings(env, jax.random.key(0), beginning_steps=10, echo=lambda line: None) == []


# POPGym Arcade.


@pytest.fixture
def popgym_arcade():
    library("popgym_arcade")
    from gymnax.environments.environment import Environment

    if hasattr(Environment, "is_truncated"):
        pytest.skip("gymnax 1.x lies in the place of stable-gymnax")


GAMES = ("AutoEncode", "BattleShip", "Breakout", "CartPole", "CountRecall", "MineSweeper", "Navigator", "Skittles")


@pytest.mark.parametrize("game", ["AutoEncode", "Navigator"])
def test_twins_share_their_states_and_differ_in_what_is_seen(game, popgym_arcade):
    whole, part = (adapters.make(f"jax:popgym_arcade/{game}Easy{kind}") for kind in ("", "-partial"))
    assert whole.spec == part.spec
    assert whole.spec.observation["image"].shape == (64, 64, 3)
    actions = np.random.default_rng(0).integers(whole.spec.action.size, size=100).astype(np.int32)
    seen, glimpsed = rollout(whole, actions), rollout(part, actions)
    for name in ("reward", "is_first", "is_last", "is_terminal"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(glimpsed, name))
    assert (seen.obs["image"] != glimpsed.obs["image"]).any()
    assert len({image.tobytes() for image in seen.obs["image"]}) > 10


@pytest.mark.parametrize("game", [*GAMES, "NoisyCartPole", "Tetris"])
@pytest.mark.slow
def test_a_picture_drawn_from_the_state_is_the_one_that_the_library_returns(game, popgym_arcade):
    import popgym_arcade as library

    env = adapters.make(f"jax:popgym_arcade/{game}Easy-partial", image_size=None)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        theirs, params = library.make(f"{game}Easy", partial_obs=True)
    state, timestep = env.reset(jax.random.key(3))
    step, their_step = jax.jit(env.step), jax.jit(theirs.step_env)
    for number in range(8):
        action = jnp.int32(number % env.spec.action.size)
        before, (state, timestep) = state, step(state, action)
        # The key that the environment gave to the step, as base.from_core derives it.
        key = jax.random.fold_in(jax.random.split(before.key, 3)[2], before.steps)
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            obs, _, reward, done, _ = their_step(key, before.core.env, action, params)
        np.testing.assert_array_equal(timestep.obs["image"], obs)
        np.testing.assert_allclose(timestep.reward, reward, rtol=1e-6)
        assert bool(timestep.is_last) == bool(done)
        if done:
            break


@pytest.mark.slow
@pytest.mark.parametrize("game", [*GAMES, "NoisyCartPole", "Tetris"])
def test_each_game_conforms(game, popgym_arcade):
    conforms(f"jax:popgym_arcade/{game}Easy-partial")


def test_a_game_played_to_its_end_is_terminal_and_one_waited_out_is_not(popgym_arcade):
    env = adapters.make("jax:popgym_arcade/AutoEncodeEasy", image_size=16)
    confirm, wait = 4, 0
    # Cards are shown for 26 steps and asked for in 26 more; the time limit is 26 * 2 * 5.
    (end, terminal) = ends(rollout(env, np.full(70, confirm, np.int32)))[0]
    assert 52 <= end <= 56
    assert terminal
    (end, terminal) = ends(rollout(env, np.full(270, wait, np.int32)))[0]
    assert 260 <= end <= 262
    assert not terminal


def test_the_library_draws_256_pixels_too(popgym_arcade):
    env = adapters.make("jax:popgym_arcade/CountRecallEasy", obs_size=256, image_size=None)
    assert env.spec.observation["image"].shape == (256, 256, 3)
    with pytest.raises(ValueError, match="expected obs_size to be 128 or 256, got 100"):
        adapters.make("jax:popgym_arcade/CountRecallEasy", obs_size=100)


# gymnax, of version 1 or as stable-gymnax has it.


@pytest.mark.parametrize(
    "name", ["MemoryChain-bsuite", "MetaMaze-misc", "Pendulum-v1", "Catch-bsuite", "Breakout-MinAtar"]
)
def test_gymnax_conforms(name):
    library("gymnax")
    conforms(f"jax:gymnax/{name}")


def test_gymnax_time_limits_and_ends():
    library("gymnax")
    waiting = rollout(adapters.make("jax:gymnax/MountainCar-v0"), np.full(201, 1, np.int32))
    assert ends(waiting) == [(200, False)]
    falling = rollout(adapters.make("jax:gymnax/CartPole-v1"), np.full(30, 1, np.int32))
    (end, terminal), *_ = ends(falling)
    assert 8 <= end <= 11  # a pole that is always pushed to one side
    assert terminal
    assert abs(falling.obs["vector"][end][2]) > 0.2  # the last observation, not the next episode's first
    assert abs(falling.obs["vector"][end + 1][2]) < 0.1


def test_gymnax_takes_parameters_and_settings():
    library("gymnax")
    env = adapters.make("jax:gymnax/MemoryChain-bsuite", params={"memory_length": 3})
    (end, terminal), *_ = ends(rollout(env, np.zeros(12, np.int32)))
    assert (end, terminal) == (4, True)
    with pytest.raises(ValueError, match=r"expected params among .*memory_length.*, got memory"):
        adapters.make("jax:gymnax/MemoryChain-bsuite", params={"memory": 3})
    env = adapters.make("jax:gymnax/Catch-bsuite", settings={"rows": 4, "columns": 7})
    assert env.spec.observation["vector"].shape == (28,)


def test_gymnax_actions_reach_their_bounds():
    library("gymnax")
    env = adapters.make("jax:gymnax/Pendulum-v1")
    assert env.spec.action == ContinuousAction(1)
    state, _ = env.reset(jax.random.key(0))
    pushed = [float(env.step(state, jnp.array([a], jnp.float32))[0].core.env.last_u) for a in (-1.0, 0.5, 1.0)]
    assert pushed == [-2.0, 1.0, 2.0]


def test_names_and_options_are_checked():
    library("gymnax")
    with pytest.raises(ValueError, match="no environment is called 'jax:gymnax/MemoryChain'; did you mean Memory"):
        adapters.make("jax:gymnax/MemoryChain")
    with pytest.raises(ValueError, match="expected options among image_size, params, settings, got size"):
        adapters.make("jax:gymnax/MemoryChain-bsuite", size=3)
    assert "jax:gymnax/MemoryChain-bsuite" in adapters.names("gymnax")


def test_popgym_arcade_says_what_it_needs_where_another_gymnax_lies():
    library("gymnax")
    import gymnax

    library("popgym_arcade")
    if not hasattr(gymnax.environments.environment.Environment, "is_truncated"):
        pytest.skip("no gymnax 1.x")
    with pytest.raises(ValueError, match="expected the gymnax of stable-gymnax"):
        adapters.make("jax:popgym_arcade/AutoEncodeEasy")


# Craftax.


def test_craftax_classic_is_cut_by_its_time_limit():
    library("craftax")
    env = adapters.make("jax:craftax/Craftax-Classic-Symbolic-v1", params={"max_timesteps": 3})
    assert env.spec.action == DiscreteAction(17)
    assert ends(rollout(env, np.zeros(5, np.int32))) == [(3, False)]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Craftax-Classic-Pixels-v1", "Craftax-Classic-Symbolic-v1", "Craftax-Symbolic-v1"])
def test_craftax_conforms(name):
    library("craftax")
    conforms(f"jax:craftax/{name}")


@pytest.mark.slow
def test_a_player_who_dies_ends_the_episode_terminally():
    library("craftax")
    env = adapters.make("jax:craftax/Craftax-Classic-Pixels-v1")
    state, timestep = env.reset(jax.random.key(0))
    assert timestep.obs["image"].shape == (64, 64, 3)
    assert len(np.unique(timestep.obs["image"])) > 20
    game = state.core.env.replace(player_health=jnp.zeros_like(state.core.env.player_health))
    _, timestep = jax.jit(env.step)(state._replace(core=state.core._replace(env=game)), jnp.int32(0))
    assert bool(timestep.is_last)
    assert bool(timestep.is_terminal)


# XLand-MiniGrid.


@pytest.mark.parametrize("name", ["MiniGrid-MemoryS8", "XLand-MiniGrid-R1-9x9"])
def test_xminigrid_conforms(name):
    library("xminigrid")
    conforms(f"jax:xminigrid/{name}")


def test_xminigrid_symbols_and_time_limits():
    library("xminigrid")
    env = adapters.make("jax:xminigrid/MiniGrid-MemoryS8", params={"max_steps": 4})
    seen = rollout(env, np.full(6, 1, np.int32))  # turning on the spot
    assert ends(seen) == [(4, False)]
    vector = seen.obs["vector"].reshape(-1, 3, 3, 13 + 12)
    np.testing.assert_array_equal(vector[..., :13].sum(-1), 1)
    np.testing.assert_array_equal(vector[..., 13:].sum(-1), 1)


def test_xminigrid_pictures(tmp_path, monkeypatch):
    library("xminigrid")
    monkeypatch.setenv("XLAND_MINIGRID_CACHE", str(tmp_path))
    env = adapters.make("jax:xminigrid/MiniGrid-MemoryS8", obs="pixels", image_size=48)
    assert env.spec.observation["image"].shape == (48, 48, 3)
    _, timestep = env.reset(jax.random.key(0))
    assert len(np.unique(timestep.obs["image"].reshape(-1, 3), axis=0)) > 2
    with pytest.raises(ValueError, match="expected obs to be vector or pixels, got 'image'"):
        adapters.make("jax:xminigrid/MiniGrid-MemoryS8", obs="image")


# Brax and MuJoCo Playground.


@pytest.mark.slow
def test_brax_conforms_and_a_fallen_pole_is_terminal():
    library("brax")
    conforms("jax:brax/inverted_pendulum")
    env = adapters.make("jax:brax/inverted_pendulum", episode_length=5)
    assert ends(rollout(env, np.zeros((6, 1), np.float32))) == [(5, False)]
    (end, terminal), *_ = ends(rollout(env, np.ones((6, 1), np.float32)))
    assert (end < 5) == terminal


@pytest.mark.slow
def test_playground_conforms_and_ends_by_its_configuration():
    library("playground")
    conforms("jax:playground/CartpoleBalance")
    env = adapters.make("jax:playground/CartpoleBalance", config={"episode_length": 6, "action_repeat": 2})
    assert ends(rollout(env, np.zeros((4, 1), np.float32))) == [(3, False)]
