"""Pendulum: a mass on a stick whose motor is too weak to lift it in one go."""

import math

import jax.numpy as jnp

from ne_dreamer_jax.envs.dmc.common import Episode, Task, uniform
from ne_dreamer_jax.envs.dmc.rewards import tolerance
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array

_COSINE_BOUND = math.cos(math.radians(8))


def load(task: str) -> Task:
    """Tasks: swingup."""
    simulation = Simulation.load("pendulum.xml")
    initial = simulation.initial()
    pole = simulation.mj_model.body("pole").id

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        return initial.replace(qpos=uniform(key, -math.pi, math.pi, (1,))), ()

    def reward(data: mjx.Data, _: Episode) -> Array:
        return tolerance(data.xmat[pole, 2, 2], (_COSINE_BOUND, 1.0))

    def observe(data: mjx.Data, _: Episode) -> dict[str, Array]:
        orientation = jnp.stack([data.xmat[pole, 2, 2], data.xmat[pole, 0, 2]])
        return {"orientation": orientation, "velocity": data.qvel}

    return Task(simulation, 20.0, reset, reward, observe)
