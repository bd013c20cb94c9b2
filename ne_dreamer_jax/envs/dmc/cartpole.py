"""Cartpole: a pole hinged to a cart that is pushed along a rail."""

import jax
import jax.numpy as jnp

from ne_dreamer_jax.envs.dmc.common import Episode, Task, uniform
from ne_dreamer_jax.envs.dmc.rewards import tolerance
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array


def load(task: str) -> Task:
    """Tasks: balance, balance_sparse, swingup, swingup_sparse."""
    simulation = Simulation.load("cartpole.xml")
    initial = simulation.initial()
    pole = simulation.mj_model.body("pole_1").id
    swing_up, sparse = task.startswith("swingup"), task.endswith("sparse")

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        position_key, velocity_key = jax.random.split(key)
        if swing_up:
            qpos = jnp.array([0.0, jnp.pi]) + 0.01 * jax.random.normal(position_key, (2,))
        else:
            qpos = jnp.array([0.1, 0.034]) * uniform(position_key, -1.0, 1.0, (2,))
        return initial.replace(qpos=qpos, qvel=0.01 * jax.random.normal(velocity_key, (2,))), ()

    def reward(data: mjx.Data, _: Episode) -> Array:
        cart, cosine = data.qpos[0], data.xmat[pole, 2, 2]
        if sparse:
            return tolerance(cart, (-0.25, 0.25)) * tolerance(cosine, (0.995, 1.0))
        upright = (cosine + 1) / 2
        centered = (1 + tolerance(cart, margin=2)) / 2
        small_control = (4 + tolerance(data.ctrl[0], margin=1, value_at_margin=0, sigmoid="quadratic")) / 5
        small_velocity = (1 + tolerance(data.qvel[1], margin=5)) / 2
        return upright * small_control * small_velocity * centered

    def observe(data: mjx.Data, _: Episode) -> dict[str, Array]:
        position = jnp.stack([data.qpos[0], data.xmat[pole, 2, 2], data.xmat[pole, 0, 2]])
        return {"position": position, "velocity": data.qvel}

    return Task(simulation, 10.0, reset, reward, observe)
