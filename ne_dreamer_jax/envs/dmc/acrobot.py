"""Acrobot: two links hanging from a hinge, with a motor at the elbow only, to be swung up and held there."""

import math

import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs.dmc.common import Episode, Task, uniform
from ne_dreamer_jax.envs.dmc.rewards import tolerance
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array


def load(task: str) -> Task:
    """Tasks: swingup."""
    simulation = Simulation.load("acrobot.xml")
    mj_model = simulation.mj_model
    initial = simulation.initial()
    arms = np.array([mj_model.body("upper_arm").id, mj_model.body("lower_arm").id])
    tip, target = mj_model.site("tip").id, mj_model.site("target").id
    target_radius = float(mj_model.site_size[target, 0])

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        return initial.replace(qpos=uniform(key, -math.pi, math.pi, (2,))), ()

    def reward(data: mjx.Data, _: Episode) -> Array:
        distance = jnp.linalg.norm(data.site_xpos[target] - data.site_xpos[tip])
        return tolerance(distance, (0.0, target_radius), margin=1)

    def observe(data: mjx.Data, _: Episode) -> dict[str, Array]:
        orientations = jnp.concatenate([data.xmat[arms, 0, 2], data.xmat[arms, 2, 2]])
        return {"orientations": orientations, "velocity": data.qvel}

    return Task(simulation, 10.0, reset, reward, observe)
