"""Reacher: a planar two-link arm, seen from above, whose fingertip has to stay in a ball placed at random."""

import math

import jax
import jax.numpy as jnp
import mujoco

from ne_dreamer_jax.envs.dmc.common import Episode, Task, random_joints, uniform
from ne_dreamer_jax.envs.dmc.rewards import tolerance
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array

_TARGET_RADIUS = {"easy": 0.05, "hard": 0.015}


def load(task: str) -> Task:
    """Tasks: easy, hard. The episode is the target's place in the plane, float32 [2], in metres."""

    def resize_target(spec: mujoco.MjSpec) -> None:
        spec.geom("target").size[0] = _TARGET_RADIUS[task]

    simulation = Simulation.load("reacher.xml", edit=resize_target)
    mj_model = simulation.mj_model
    initial = simulation.initial()
    finger, ball = mj_model.geom("finger").id, mj_model.geom("target").id
    touching = float(mj_model.geom_size[[finger, ball], 0].sum())
    sample_joints = random_joints(mj_model)

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        joints_key, angle_key, radius_key = jax.random.split(key, 3)
        angle = uniform(angle_key, 0.0, 2 * math.pi)
        radius = uniform(radius_key, 0.05, 0.20)
        target = radius * jnp.stack([jnp.sin(angle), jnp.cos(angle)])
        return initial.replace(qpos=sample_joints(joints_key)), target

    def finger_to_target(data: mjx.Data, target: Array) -> Array:
        return target - data.geom_xpos[finger, :2]

    def reward(data: mjx.Data, target: Array) -> Array:
        return tolerance(jnp.linalg.norm(finger_to_target(data, target)), (0.0, touching))

    def observe(data: mjx.Data, target: Array) -> dict[str, Array]:
        return {"position": data.qpos, "to_target": finger_to_target(data, target), "velocity": data.qvel}

    def pose(data: mjx.Data, target: Array) -> mjx.Data:
        return data.replace(geom_xpos=data.geom_xpos.at[ball, :2].set(target))

    return Task(simulation, 20.0, reset, reward, observe, jnp.zeros(2), pose=pose)
