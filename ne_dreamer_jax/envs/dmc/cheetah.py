"""Cheetah: a planar quadruped's half, to run as fast as 10 m/s."""

import jax.numpy as jnp

from ne_dreamer_jax.envs.dmc.common import Episode, Task, random_joints
from ne_dreamer_jax.envs.dmc.rewards import tolerance
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array

_SPEED = 10.0  # metres a second
_SETTLING_STEPS = 200  # for which the cheetah falls to the floor before an episode begins


def load(task: str) -> Task:
    """Tasks: run."""
    simulation = Simulation.load("cheetah.xml")
    initial = simulation.initial()
    velocity_sensor = simulation.sensor("torso_subtreelinvel")
    sample_joints = random_joints(simulation.mj_model, unlimited=False)

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        return initial.replace(qpos=sample_joints(key)), ()

    def reward(data: mjx.Data, _: Episode) -> Array:
        speed = data.sensordata[velocity_sensor][0]
        return tolerance(speed, (_SPEED, jnp.inf), margin=_SPEED, value_at_margin=0, sigmoid="linear")

    def observe(data: mjx.Data, _: Episode) -> dict[str, Array]:
        return {"position": data.qpos[1:], "velocity": data.qvel}

    return Task(simulation, 10.0, reset, reward, observe, coast=_SETTLING_STEPS)
