"""A policy played in dm_control sees and does there what it would here."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dm_control import suite

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax.commands import evaluate
from ne_dreamer_jax.envs.config import DmcConfig
from ne_dreamer_jax.runs import control_suite
from ne_dreamer_jax.types import PolicyState

EPISODES = 2


def agent_of(env, seen, action):
    """Always the same action; keeps the time steps that it was shown."""

    def act(params, policy, timestep, key, mode):
        assert mode == "mode"
        seen.append(timestep)
        return policy._replace(prev_action=action), action

    init_policy = lambda n: PolicyState((), jnp.zeros((n, *env.spec.action.shape)))
    return SimpleNamespace(spec=env.spec, act=act, init_policy=init_policy)


def play(config, random=False):
    env = nedreamer.envs.make(config.task, obs=config.obs, action_repeat=config.action_repeat, image_size=32)
    seen, action = [], jnp.full((EPISODES, *env.spec.action.shape), 0.3)
    found = control_suite.evaluate(config, agent_of(env, seen, action), {}, jax.random.key(1), EPISODES, random)
    return env, found, seen


def test_returns_are_dm_controls_own():
    config = DmcConfig("dmc/pendulum_swingup", obs="vector")
    env, found, seen = play(config)
    assert found.lengths.tolist() == [500, 500]
    assert len(seen) == 500  # none is asked after the last
    assert seen[0].is_first.all()
    assert not any(timestep.is_first.any() for timestep in seen[1:])
    assert found.frames is None
    for name, spec in env.spec.observation.items():
        assert (seen[0].obs[name].shape, seen[0].obs[name].dtype) == ((EPISODES, *spec.shape), spec.dtype)

    # The same episodes by hand.
    seed_key, _ = jax.random.split(jax.random.key(1))
    for i, seed in enumerate(jax.random.randint(seed_key, (EPISODES,), 0, 2**31 - 1)):
        theirs = suite.load("pendulum", "swingup", task_kwargs={"random": int(seed)})
        timestep, total = theirs.reset(), 0.0
        np.testing.assert_allclose(seen[0].obs["orientation"][i], timestep.observation["orientation"], rtol=1e-6)
        while not timestep.last():
            timestep = theirs.step([0.3])
            total += timestep.reward
        np.testing.assert_allclose(found.returns[i], total, rtol=1e-5)


def test_a_random_policy_does_not_repeat_itself():
    _, found, _ = play(DmcConfig("dmc/cartpole_swingup", obs="vector"), random=True)
    assert found.returns[0] != found.returns[1]
    assert (found.returns > 0).all()


def test_opengl_is_asked_for_by_name_and_a_users_choice_stands(monkeypatch):
    for given, wanted in (("egl", "egl"), ("glfw", "glfw"), ("disable", ("osmesa", "egl"))):
        monkeypatch.setenv("MUJOCO_GL", given)
        evaluate.allow_opengl()
        assert evaluate.os.environ["MUJOCO_GL"] in wanted


def test_a_mistyped_way_to_draw_is_refused(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmessa")
    with pytest.raises(ValueError, match=r"no way to draw is called 'osmessa'. Did you mean osmesa"):
        evaluate.allow_opengl()


def test_without_opengl_the_message_says_what_to_install(monkeypatch):
    def refuse(player, size):
        raise OSError("no such library")

    monkeypatch.setattr(control_suite.Player, "draw", refuse)
    with pytest.raises(RuntimeError, match="Install OSMesa"):
        play(DmcConfig("dmc/pendulum_swingup", image_size=32))
