"""What the Control Suite's domains share: loading a model, stepping it as dm_control does, and the task interface."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

# MuJoCo looks for an OpenGL library when imported, unless told not to. Drawing here needs none.
os.environ.setdefault("MUJOCO_GL", "disable")

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from ne_dreamer_jax.types import Array

with contextlib.redirect_stdout(io.StringIO()):  # it prints that its optional Warp backend is not installed
    from mujoco import mjx

Episode = Any  # what a task draws anew for each episode besides the state, a pytree of arrays


@contextlib.contextmanager
def library_numerics() -> Iterator[None]:
    """MJX relies on implicit promotion; this allows it while MJX is traced, whatever the caller's configuration."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def suite_directory() -> Path:
    """Where dm_control keeps the Control Suite's models; found without importing dm_control.

    Raises:
      ImportError: dm_control is not installed.
    """
    found = importlib.util.find_spec("dm_control")
    if found is None or found.origin is None:
        raise ImportError("the dmc environments need dm_control's model files: pip install dm-control")
    return Path(found.origin).parent / "suite"


@dataclasses.dataclass(frozen=True)
class Simulation:
    """A MuJoCo model, and its stepping by MJX in the order in which dm_control steps it.

    dm_control keeps everything that depends on positions and velocities current between control steps: one control
    step is ``n_sub_steps`` times (forces and integration at the current state, then positions and velocities of the
    new state). So sensors of accelerations and forces speak of the state before the last integration, all others of
    the state after it.
    """

    mj_model: mujoco.MjModel
    model: mjx.Model  # the same on the device
    n_sub_steps: int  # physics steps in a control step

    @classmethod
    def load(
        cls,
        filename: str,
        control_timestep: float | None = None,
        edit: Callable[[mujoco.MjSpec], None] | None = None,
    ) -> Simulation:
        """Loads a model of the Control Suite.

        Args:
          filename: name of the MJCF file in the suite's directory.
          control_timestep: seconds; None: one physics step.
          edit: changes the specification in place before it is compiled.
        """
        spec = mujoco.MjSpec.from_file(str(suite_directory() / filename))
        if edit is not None:
            edit(spec)
        mj_model = spec.compile()
        mj_model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)  # MJX refuses it; it has no part in the dynamics
        n_sub_steps = 1 if control_timestep is None else round(control_timestep / mj_model.opt.timestep)
        return cls(mj_model, mjx.put_model(mj_model), n_sub_steps)

    @property
    def control_timestep(self) -> float:
        """Seconds."""
        return self.n_sub_steps * self.mj_model.opt.timestep

    def initial(self) -> mjx.Data:
        """The model's default state, at rest; not settled."""
        return mjx.make_data(self.mj_model)

    def settle(self, data: mjx.Data) -> mjx.Data:
        """Brings all that depends on positions and velocities, but for sensors, up to date (MuJoCo's ``mj_step1``)."""
        with library_numerics():
            return mjx.fwd_velocity(self.model, mjx.fwd_position(self.model, data))

    def begin(self, data: mjx.Data) -> mjx.Data:
        """Brings everything up to date without any actuation, as dm_control does at the start of an episode."""
        data = self.settle(data)
        with library_numerics():
            if (self.mj_model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC).any():
                flags = self.model.opt.disableflags | mjx.DisableBit.ACTUATION
                passive = self.model.replace(opt=self.model.opt.replace(disableflags=flags))
                data = self._accelerate(passive, data)
            return self._sense(data)

    def advance(self, data: mjx.Data, control: Array) -> mjx.Data:
        """One control step. ``data`` is settled before and after; ``control``: float32 [nu], in the actuators' units."""

        def sub_step(_: Array, data: mjx.Data) -> mjx.Data:
            data = self._accelerate(self.model, data)
            if self.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
                data = mjx.rungekutta4(self.model, data)
            else:
                data = mjx.euler(self.model, data)
            return self.settle(data)

        with library_numerics():
            data = jax.lax.fori_loop(0, self.n_sub_steps, sub_step, data.replace(ctrl=control))
            return self._sense(data)

    def _accelerate(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """Forces, constraint solve and the sensors that need them (the first part of MuJoCo's ``mj_step2``)."""
        data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
        if data._impl.efc_J.size == 0:
            return data.replace(qacc=data.qacc_smooth)
        return mjx.sensor_acc(model, mjx.solve(model, data))

    def _sense(self, data: mjx.Data) -> mjx.Data:
        """The sensors that need positions and velocities alone."""
        return mjx.sensor_vel(self.model, mjx.sensor_pos(self.model, data))

    def sensor(self, name: str) -> slice:
        """Where a sensor's readings lie in ``data.sensordata``."""
        sensor = self.mj_model.sensor(name)
        return slice(sensor.adr[0], sensor.adr[0] + sensor.dim[0])


class Task(NamedTuple):
    """A task as its domain's file defines it."""

    simulation: Simulation
    time_limit: float  # seconds
    reset: Callable[[Array], tuple[mjx.Data, Episode]]  # key -> state with the first qpos and qvel; begun by the caller
    reward: Callable[[mjx.Data, Episode], Array]  # float32 []
    observe: Callable[[mjx.Data, Episode], dict[str, Array]]  # dm_control's observations, any float dtype
    camera: int = 0  # the camera whose pixels agents see
    overrides: Callable[[Episode], Any] = lambda episode: None  # what the episode changes in the drawn scene


def random_joints(mj_model: mujoco.MjModel) -> Callable[[Array], Array]:
    """Returns a function ``key -> qpos``: limited joints uniform in their range, unlimited hinges in [-pi, pi).

    Unlimited slides keep their default. Equal in distribution to dm_control's
    ``randomize_limited_and_rotational_joints``.

    Raises:
      ValueError: the model has ball or free joints.
    """
    types = mj_model.jnt_type
    hinge = types == mujoco.mjtJoint.mjJNT_HINGE
    if not (hinge | (types == mujoco.mjtJoint.mjJNT_SLIDE)).all():
        raise ValueError("expected a model with hinge and slide joints only, got one with ball or free joints")
    limited = mj_model.jnt_limited.astype(bool)
    default = mj_model.qpos0
    low = np.where(limited, mj_model.jnt_range[:, 0], np.where(hinge, -np.pi, default)).astype(np.float32)
    high = np.where(limited, mj_model.jnt_range[:, 1], np.where(hinge, np.pi, default)).astype(np.float32)

    def sample(key: Array) -> Array:
        return low + (high - low) * jax.random.uniform(key, low.shape)

    return sample


def uniform(key: Array, low: float, high: float, shape: tuple[int, ...] = ()) -> Array:
    """float32, uniform in [low, high)."""
    return jax.random.uniform(key, shape, jnp.float32, low, high)
