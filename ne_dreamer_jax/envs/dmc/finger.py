"""Finger: a two-link finger that has to spin a body on a hinge, or turn it until its tip is at a target."""

import math

import jax
import jax.numpy as jnp
import mujoco

from ne_dreamer_jax.envs.dmc.common import Episode, Task, random_joints, redraw_while_touching, uniform
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array

_SPIN_VELOCITY = 15.0  # radians a second
_TARGET_RADIUS = {"turn_easy": 0.07, "turn_hard": 0.03}  # metres

_OUT_OF_REACH = ("ground", "proximal_decoration", "proximal", "spinner_decoration")
"""Geoms that no joint angles bring into contact with any other. MJX would spend most of its time on such pairs."""


def load(task: str) -> Task:
    """Tasks: spin, turn_easy, turn_hard.

    A turn's episode is the target's place in the plane of the finger, float32 [2] (x, z), relative to the hinge of
    the body, in metres. Spinning has no target.
    """

    def edit(spec: mujoco.MjSpec) -> None:
        for geom in _OUT_OF_REACH:
            spec.geom(geom).contype = spec.geom(geom).conaffinity = 0
        if task == "spin":
            spec.joint("hinge").damping[0] = 0.03
            for site in ("target", "tip"):
                spec.site(site).rgba[3] = 0
        else:
            spec.site("target").size[0] = _TARGET_RADIUS[task]

    simulation = Simulation.load("finger.xml", control_timestep=0.02, edit=edit)
    mj_model = simulation.mj_model
    initial = simulation.initial()
    sensors = {mj_model.sensor(i).name: simulation.sensor(mj_model.sensor(i).name) for i in range(mj_model.nsensor)}
    hinge = initial.xanchor[mj_model.joint("hinge").id]
    orbit = float(mj_model.geom("cap1").size.sum())  # distance of targets from the hinge
    target_site = mj_model.site("target").id
    draw_joints = redraw_while_touching(simulation, random_joints(mj_model))

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        joints_key, angle_key = jax.random.split(key)
        start = initial.replace(qpos=draw_joints(joints_key))
        if task == "spin":
            return start, ()
        angle = uniform(angle_key, -math.pi, math.pi)
        return start, orbit * jnp.stack([jnp.sin(angle), jnp.cos(angle)])

    def read(data: mjx.Data, *names: str) -> Array:
        return jnp.concatenate([data.sensordata[sensors[name]] for name in names])

    def tip_position(data: mjx.Data) -> Array:
        return (read(data, "tip") - read(data, "spinner"))[::2]

    def distance_to_target(data: mjx.Data, target: Array) -> Array:
        return jnp.linalg.norm(target - tip_position(data)) - _TARGET_RADIUS[task]

    def reward(data: mjx.Data, episode: Episode) -> Array:
        if task == "spin":
            return (read(data, "hinge_velocity")[0] <= -_SPIN_VELOCITY).astype(jnp.float32)
        return (distance_to_target(data, episode) <= 0).astype(jnp.float32)

    def observe(data: mjx.Data, episode: Episode) -> dict[str, Array]:
        observation = {
            "position": jnp.concatenate([read(data, "proximal", "distal"), tip_position(data)]),
            "velocity": read(data, "proximal_velocity", "distal_velocity", "hinge_velocity"),
            "touch": jnp.log1p(read(data, "touchtop", "touchbottom")),
        }
        if task != "spin":
            observation |= {"target_position": episode, "dist_to_target": distance_to_target(data, episode)}
        return observation

    def pose(data: mjx.Data, episode: Episode) -> mjx.Data:
        if task == "spin":
            return data
        place = jnp.stack([hinge[0] + episode[0], data.site_xpos[target_site, 1], hinge[2] + episode[1]])
        return data.replace(site_xpos=data.site_xpos.at[target_site].set(place))

    return Task(simulation, 20.0, reset, reward, observe, () if task == "spin" else jnp.zeros(2), pose=pose)
