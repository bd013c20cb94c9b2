"""Quadruped: a four-legged robot in three dimensions that has to walk or run forward."""

import jax
import jax.numpy as jnp
import mujoco

from ne_dreamer_jax.envs.dmc.common import Episode, Task
from ne_dreamer_jax.envs.dmc.rewards import tolerance
from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array

_TIME_LIMIT = 20.0  # seconds
_SPEED = {"walk": 0.5, "run": 5.0}  # metres a second
_RISE = 0.01  # metres, step of the search for a first height
_MAX_RISES = 10_000


def load(task: str) -> Task:
    """Tasks: walk, run."""
    speed = _SPEED[task]

    def edit(spec: mujoco.MjSpec) -> None:
        """Leaves the robot alone on a floor that it can't leave in time."""
        spec.geom("floor").size = [_TIME_LIMIT * speed, _TIME_LIMIT * speed, 0.5]
        extras = [spec.geom(name) for name in ("wall_px", "wall_py", "wall_nx", "wall_ny", "terrain")]
        extras += [spec.body("ball"), spec.site("target")]
        extras += [sensor for sensor in spec.sensors if sensor.type == mujoco.mjtSensor.mjSENS_RANGEFINDER]
        for extra in extras:
            spec.delete(extra)

    simulation = Simulation.load("quadruped.xml", control_timestep=0.02, edit=edit)
    initial = simulation.initial()
    torso = simulation.mj_model.body("torso").id
    velocity_sensor = simulation.sensor("velocimeter")
    accelerometer, gyro = simulation.sensor("imu_accel"), simulation.sensor("imu_gyro")
    legs = ("front_left", "front_right", "back_right", "back_left")
    toe_sensors = [simulation.sensor(f"{kind}_toe_{leg}") for kind in ("force", "torque") for leg in legs]

    def reset(key: Array) -> tuple[mjx.Data, Episode]:
        """A random orientation, at the lowest height, in centimetres from zero, where nothing touches."""
        orientation = jax.random.normal(key, (4,))
        orientation /= jnp.linalg.norm(orientation)

        def at(rises: Array) -> mjx.Data:
            root = jnp.concatenate([jnp.zeros(2), _RISE * rises[None].astype(jnp.float32), orientation])
            return initial.replace(qpos=initial.qpos.at[:7].set(root))

        rises = jax.lax.while_loop(
            lambda rises: simulation.in_contact(at(rises)) & (rises < _MAX_RISES),
            lambda rises: rises + 1,
            jnp.zeros((), jnp.int32),
        )
        return at(rises), ()

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
