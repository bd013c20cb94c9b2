"""Walker: a planar biped that has to stand, walk or run."""

import jax.numpy as jnp

from ne_dreamer_jax.envs.dmc.common import Episode, Task, random_joints
from ne_dreamer_jax.envs.dmc.rewards import tolerance
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array

_STAND_HEIGHT = 1.2  # metres
_SPEED = {"stand": 0.0, "walk": 1.0, "run": 8.0}  # metres a second


def load(task: str) -> Task:
    """Tasks: stand, walk, run."""
    simulation = Simulation.load("walker.xml", control_timestep=0.025)
    initial = simulation.initial()
    torso = simulation.mj_model.body("torso").id
    velocity_sensor = simulation.sensor("torso_subtreelinvel")
    speed = _SPEED[task]
    sample_joints = random_joints(simulation.mj_model)

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        return initial.replace(qpos=sample_joints(key)), ()

    def reward(data: mjx.Data, _: Episode) -> Array:
        standing = tolerance(data.xpos[torso, 2], (_STAND_HEIGHT, jnp.inf), margin=_STAND_HEIGHT / 2)
        upright = (1 + data.xmat[torso, 2, 2]) / 2
        stand = (3 * standing + upright) / 4
        if speed == 0:
            return stand
        forward_velocity = data.sensordata[velocity_sensor][0]
        move = tolerance(forward_velocity, (speed, jnp.inf), margin=speed / 2, value_at_margin=0.5, sigmoid="linear")
        return stand * (5 * move + 1) / 6

    def observe(data: mjx.Data, _: Episode) -> dict[str, Array]:
        orientations = jnp.stack([data.xmat[1:, 0, 0], data.xmat[1:, 0, 2]], axis=-1).reshape(-1)
        return {"orientations": orientations, "height": data.xpos[torso, 2], "velocity": data.qvel}

    return Task(simulation, 25.0, reset, reward, observe)
