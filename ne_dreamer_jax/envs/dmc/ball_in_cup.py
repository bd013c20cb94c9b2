"""Ball in cup: a ball on a string, to be caught in the cup that it hangs from."""

import jax
import jax.numpy as jnp

from ne_dreamer_jax.envs.dmc.common import Episode, Task, redraw_while_touching, uniform
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array


def load(task: str) -> Task:
    """Tasks: catch."""
    simulation = Simulation.load("ball_in_cup.xml", control_timestep=0.02)
    mj_model = simulation.mj_model
    initial = simulation.initial()
    ball, target = mj_model.body("ball").id, mj_model.site("target").id
    room = mj_model.site_size[target, ::2] - mj_model.geom("ball").size[0]  # half-widths along x and z
    room_x, room_z = map(float, room)

    def sample(key: Array) -> Array:
        x_key, z_key = jax.random.split(key)
        x, z = uniform(x_key, -0.2, 0.2), uniform(z_key, 0.2, 0.5)
        return jnp.concatenate([initial.qpos[:2], jnp.stack([x, z])])

    draw = redraw_while_touching(simulation, sample)

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        return initial.replace(qpos=draw(key)), ()

    def reward(data: mjx.Data, _: Episode) -> Array:
        offset = jnp.abs(data.site_xpos[target] - data.xpos[ball])
        return ((offset[0] < room_x) & (offset[2] < room_z)).astype(jnp.float32)

    def observe(data: mjx.Data, _: Episode) -> dict[str, Array]:
        return {"position": data.qpos, "velocity": data.qvel}

    return Task(simulation, 20.0, reset, reward, observe)
