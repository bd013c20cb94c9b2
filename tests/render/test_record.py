"""What a picture is drawn from is enough to draw it again, to the bit."""

import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ne_dreamer_jax import envs, render
from ne_dreamer_jax.envs import dmc
from tests.marks import slow_but

TASKS = {"cartpole": "swingup", "ball_in_cup": "catch", "finger": "turn_hard", "walker": "walk", "quadruped": "walk"}
QUICK = ("cartpole",)  # the smallest
FIELDS = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "xpos", "subtree_com")


def moved(model, count):
    """The fields of some states, as C MuJoCo computes them: [count, ...]."""
    rng, states = np.random.default_rng(0), []
    for _ in range(count):
        data = mujoco.MjData(model)
        data.qpos[:] += 0.3 * rng.normal(size=model.nq)
        mujoco.mj_forward(model, data)
        states.append({name: np.array(getattr(data, name), np.float32) for name in FIELDS})
    return jax.tree.map(lambda *x: jnp.stack(x), *states)


@pytest.mark.strict
@pytest.mark.parametrize("domain", slow_but(TASKS, *QUICK))
def test_a_picture_is_drawn_again_to_the_bit(domain):
    task = dmc.load(domain, TASKS[domain])
    scene = render.build(task.simulation.mj_model, task.camera, height=64, width=64)
    state = lambda fields: types.SimpleNamespace(**fields)
    fields = moved(task.simulation.mj_model, 6)
    drawn = jax.jit(jax.vmap(lambda x: render.draw(scene, state(x))))(fields)
    records = jax.jit(jax.vmap(lambda x: render.record(scene, state(x))))(fields)
    assert records.dtype == jnp.float32
    assert records.shape[0] == 6
    assert 0 < records[0].nbytes < 64 * 64 * 3 / 4

    # Compiled in another program, for another number of states.
    redraw = lambda vector: render.draw(scene, render.recorded(scene, vector))
    again = jax.jit(lambda x: jax.lax.map(redraw, x, batch_size=4))(records)
    np.testing.assert_array_equal(again, drawn)
    assert (drawn != drawn[:1]).any(axis=(1, 2, 3))[1:].all()  # the states look different


@pytest.mark.slow
@pytest.mark.strict
@pytest.mark.parametrize("name", ["dmc/walker_walk", "dmc/reacher_hard"])
def test_an_environments_images_are_drawn_again_to_the_bit(name):
    env = envs.make(name)

    def run(state, key):
        def step(state, key):
            action = jax.random.uniform(key, (3, env.spec.action.size), minval=-1.0)
            state, timestep = jax.vmap(env.step)(state, action)
            return state, (timestep.obs["image"], jax.vmap(env.pictures.record)(state))

        return jax.lax.scan(step, state, jax.random.split(key, 12))[1]

    images, records = jax.jit(run)(jax.vmap(env.prepare)(jax.random.split(jax.random.key(0), 3)), jax.random.key(1))
    again = jax.jit(lambda x: jax.lax.map(env.pictures.redraw, x, batch_size=16))(records.reshape(36, -1))
    np.testing.assert_array_equal(again, images.reshape(again.shape))
