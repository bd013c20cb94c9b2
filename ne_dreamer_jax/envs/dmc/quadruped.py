"""Quadruped: a four-legged robot in three dimensions that has to walk or run forward."""

import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from ne_dreamer_jax.envs.dmc import support
from ne_dreamer_jax.envs.dmc.common import Episode, Task
from ne_dreamer_jax.envs.dmc.rewards import tolerance
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array

_TIME_LIMIT = 20.0  # seconds
_SPEED = {"walk": 0.5, "run": 5.0}  # metres a second
_LEGS = ("front_left", "front_right", "back_right", "back_left")
_RISE = 0.01  # metres, step of the search for a first height


def load(task: str) -> Task:
    """Tasks: walk, run."""
    speed = _SPEED[task]

    def edit(spec: mujoco.MjSpec) -> None:
        """Leaves the robot alone on a floor that it can't leave in time.

        Contacts of shins with the torso, which are 7 cm apart at the joints' limits, are left out.
        """
        spec.geom("floor").size = [_TIME_LIMIT * speed, _TIME_LIMIT * speed, 0.5]
        extras = [spec.geom(name) for name in ("wall_px", "wall_py", "wall_nx", "wall_ny", "terrain")]
        extras += [spec.body("ball"), spec.site("target")]
        extras += [sensor for sensor in spec.sensors if sensor.type == mujoco.mjtSensor.mjSENS_RANGEFINDER]
        for extra in extras:
            spec.delete(extra)
        for leg in _LEGS:
            spec.add_exclude(bodyname1="torso", bodyname2=f"knee_{leg}")

    with warnings.catch_warnings():
        # Feet touch the torso and the eyes otherwise than MuJoCo's; benchmarks/DMC.md compares the task as it is.
        warnings.simplefilter("ignore", support.SimulatedOtherwise)
        simulation = Simulation.load("quadruped.xml", control_timestep=0.02, edit=edit)
    initial = simulation.initial()
    torso = simulation.mj_model.body("torso").id
    velocity_sensor = simulation.sensor("velocimeter")
    accelerometer, gyro = simulation.sensor("imu_accel"), simulation.sensor("imu_gyro")
    toe_sensors = [simulation.sensor(f"{kind}_toe_{leg}") for kind in ("force", "torque") for leg in _LEGS]

    depth_below = _depth_below(simulation.mj_model)

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        """A random orientation, at the lowest height, in centimetres from zero, where nothing touches the floor."""
        orientation = jax.random.normal(key, (4,))
        orientation /= jnp.linalg.norm(orientation)
        height = _RISE * jnp.ceil(depth_below(orientation) / _RISE)
        root = jnp.concatenate([jnp.zeros(2), height[None], orientation])
        return initial.replace(qpos=initial.qpos.at[:7].set(root)), ()

    def reward(data: mjx.Data, _: Episode) -> Array:
        forward = data.sensordata[velocity_sensor][0]
        move = tolerance(forward, (speed, jnp.inf), margin=speed, value_at_margin=0.5, sigmoid="linear")
        upright = tolerance(data.xmat[torso, 2, 2], (1.0, jnp.inf), margin=2, value_at_margin=0, sigmoid="linear")
        return upright * move

    def observe(data: mjx.Data, _: Episode) -> dict[str, Array]:
        read = data.sensordata
        return {
            "egocentric_state": jnp.concatenate([data.qpos[7:], data.qvel[6:], data.act]),
            "torso_velocity": read[velocity_sensor],
            "torso_upright": data.xmat[torso, 2, 2],
            "imu": jnp.concatenate([read[accelerometer], read[gyro]]),
            "force_torque": jnp.arcsinh(jnp.concatenate([read[sensor] for sensor in toe_sensors])),
        }

    return Task(simulation, _TIME_LIMIT, reset, reward, observe, camera=2)


def _depth_below(mj_model: mujoco.MjModel) -> Callable[[Array], Array]:
    """Returns a function: orientation [4] of the torso -> metres that the robot reaches below the torso's origin.

    The joints are in their default pose, where the robot doesn't touch itself. How far a convex body reaches along
    a direction is its support function.
    """
    data = mujoco.MjData(mj_model)
    mujoco.mj_kinematics(mj_model, data)
    robot = np.flatnonzero(mj_model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    center = data.geom_xpos[robot] - data.xpos[mj_model.body("torso").id]  # [G, 3]
    axes = data.geom_xmat[robot].reshape(-1, 3, 3)  # [G, 3, 3], a geom's own axes in columns
    kind, size = mj_model.geom_type[robot], mj_model.geom_size[robot]
    # Every kind here is a sum of an ellipsoid, a disc across its z axis and a segment along it.
    ellipsoid = np.where((kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID)[:, None], size, size[:, :1])
    disc = np.where(kind == mujoco.mjtGeom.mjGEOM_CYLINDER, size[:, 0], 0)
    ellipsoid = np.where((kind == mujoco.mjtGeom.mjGEOM_CYLINDER)[:, None], 0, ellipsoid)
    segment = np.where(np.isin(kind, (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE)), size[:, 1], 0)
    center, axes, ellipsoid, disc, segment = (x.astype(np.float32) for x in (center, axes, ellipsoid, disc, segment))

    def depth_below(orientation: Array) -> Array:
        w, x, y, z = orientation
        up = jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])  # in the torso's frame
        along = jnp.einsum("gij,i->gj", axes, up)  # the vertical in each geom's frame
        sine = jnp.sqrt(jnp.maximum(1 - along[:, 2] ** 2, 0.0))
        reach = jnp.linalg.norm(ellipsoid * along, axis=-1) + disc * sine + segment * jnp.abs(along[:, 2])
        return (reach - center @ up).max()

    return depth_below
