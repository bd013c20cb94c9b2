"""dm_control itself through the door for environments: what an agent sees and earns is dm_control's own."""

from __future__ import annotations

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dm_control import suite

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.envs.config import DmcConfig, DmControlConfig
from ne_dreamer_jax.envs.host import factories, opengl, players, worker

KEYS = jax.random.split(jax.random.key(1), 2)


def test_observations_and_rewards_are_dm_controls_own():
    env = nedreamer.envs.make("dm_control:pendulum_swingup", obs="vector", action_repeat=2)
    state, step, timesteps = env.prepare(KEYS), jax.jit(env.step), []
    for _ in range(502):
        state, timestep = step(state, jnp.full((2, 1), 0.25))
        timesteps.append(jax.device_get(timestep))
    env.host.close()
    assert [bool(t.is_last[0]) for t in timesteps] == [False] * 500 + [True, False]
    assert not any(t.is_terminal.any() for t in timesteps)
    assert timesteps[501].is_first.all()

    for i, seed in enumerate(np.asarray(state.seeds).tolist()):  # the same episodes by hand
        theirs = suite.load("pendulum", "swingup", task_kwargs={"random": worker.another_seed(seed, 0)})
        theirs.task.random.seed(worker.another_seed(seed, 0))
        timestep, total = theirs.reset(), 0.0
        for ours in timesteps[:501]:
            np.testing.assert_allclose(ours.obs["orientation"][i], timestep.observation["orientation"], rtol=1e-5)
            np.testing.assert_allclose(ours.reward[i], total, rtol=1e-5)
            if timestep.last():
                break
            total = 0.0
            for _ in range(2):
                timestep = theirs.step([0.25])
                total += timestep.reward
        assert timestep.last()


@pytest.mark.parametrize("task", ["cartpole_swingup", "walker_walk", "ball_in_cup_catch"])
def test_the_spec_is_that_of_the_same_task_here(task):
    ours = nedreamer.envs.make(f"dmc/{task}", obs="vector")
    theirs = nedreamer.envs.make(f"dm_control:{task}", obs="vector", action_repeat=2)
    theirs.host.close()
    assert theirs.spec == ours.spec
    assert theirs.step_seconds == pytest.approx(ours.step_seconds)


def test_settings_of_a_task_here_are_those_there():
    ours = DmcConfig("dmc/walker_walk", obs="both", action_repeat=4, image_size=32)
    assert env_configs.for_task("dm_control:walker_walk", ours) == DmControlConfig(
        "dm_control:walker_walk", obs="both", action_repeat=4, image_size=32
    )


def test_opengl_is_asked_for_by_name_and_a_users_choice_stands(monkeypatch):
    for given, wanted in (("egl", "egl"), ("glfw", "glfw"), ("disable", ("osmesa", "egl"))):
        monkeypatch.setenv("MUJOCO_GL", given)
        opengl.allow()
        assert os.environ["MUJOCO_GL"] in wanted


def test_a_mistyped_way_to_draw_is_refused(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmessa")
    with pytest.raises(ValueError, match=r"no way to draw is called 'osmessa'. Did you mean osmesa"):
        nedreamer.envs.check("dm_control:walker_walk")


def test_without_opengl_the_message_says_what_to_install(monkeypatch):
    class Blind:
        class physics:
            @staticmethod
            def render(*_, **__):
                raise OSError("no such library")

    monkeypatch.setenv("MUJOCO_GL", "disable")  # to be put back
    monkeypatch.setattr(suite, "load", lambda *_, **__: Blind)
    with pytest.raises(ValueError, match="Install OSMesa"):
        factories.PLAYERS["dm_control:"]("pendulum_swingup", players.Options(observe="pixels"))
