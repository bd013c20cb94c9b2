"""Hopper: a planar one-legged robot that has to stand or to hop forward."""

import jax.numpy as jnp

from ne_dreamer_jax.envs.dmc.common import Episode, Task, random_joints
from ne_dreamer_jax.envs.dmc.rewards import tolerance
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array

_STAND_HEIGHT = 0.6  # metres, torso above foot
_HOP_SPEED = 2.0  # metres a second


def load(task: str) -> Task:
    """Tasks: stand, hop."""
    simulation = Simulation.load("hopper.xml", control_timestep=0.02)
    mj_model = simulation.mj_model
    initial = simulation.initial()
    torso, foot = mj_model.body("torso").id, mj_model.body("foot").id
    velocity_sensor = simulation.sensor("torso_subtreelinvel")
    toe_sensor, heel_sensor = simulation.sensor("touch_toe"), simulation.sensor("touch_heel")
    sample_joints = random_joints(mj_model)

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        return initial.replace(qpos=sample_joints(key)), ()

    def reward(data: mjx.Data, _: Episode) -> Array:
        standing = tolerance(data.xipos[torso, 2] - data.xipos[foot, 2], (_STAND_HEIGHT, 2.0))
        if task == "stand":
            small_control = tolerance(data.ctrl, margin=1, value_at_margin=0, sigmoid="quadratic").mean()
            return standing * (small_control + 4) / 5
        speed = data.sensordata[velocity_sensor][0]
        bounds = (_HOP_SPEED, jnp.inf)
        return standing * tolerance(speed, bounds, margin=_HOP_SPEED / 2, value_at_margin=0.5, sigmoid="linear")

    def observe(data: mjx.Data, _: Episode) -> dict[str, Array]:
        touch = jnp.concatenate([data.sensordata[toe_sensor], data.sensordata[heel_sensor]])
        return {"position": data.qpos[1:], "velocity": data.qvel, "touch": jnp.log1p(touch)}

    return Task(simulation, 20.0, reset, reward, observe)
