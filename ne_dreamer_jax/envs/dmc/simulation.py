"""Loading a Control Suite model, and stepping it on MJX in the order in which dm_control steps it."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import importlib.util
import io
import math
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# MuJoCo looks for an OpenGL library when imported, unless told not to. Drawing here needs none.
os.environ.setdefault("MUJOCO_GL", "disable")

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from ne_dreamer_jax.types import Array

with contextlib.redirect_stdout(io.StringIO()):  # it prints that its optional Warp backend is not installed
    from mujoco import mjx
    from mujoco.mjx._src import math as mjx_math
    from mujoco.mjx._src import solver as mjx_solver

    from ne_dreamer_jax.envs.dmc import support

Start = dict[str, Array]
"""Fields of ``mjx.Data`` that a state consists of; all others follow from them."""

STATE = (
    "time",
    "qpos",
    "qvel",
    "act",
    "qacc_warmstart",
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "eq_active",
    "mocap_pos",
    "mocap_quat",
    "userdata",
)
"""MuJoCo's mjSTATE_INTEGRATION, but for what MJX has no use for (plugins, histories of delays)."""

FORCES = (
    "qacc",
    "qacc_smooth",
    "act_dot",
    "actuator_force",
    "qfrc_actuator",
    "qfrc_smooth",
    "qfrc_constraint",
    "qfrc_inverse",
    "_impl",
)
"""Fields that are of the state before the last integration: what settles a state does not compute them."""

LINE_SEARCH = 8
"""Turns of the solver's line search in `Simulation.fast`."""


def start_of(data: mjx.Data) -> Start:
    """The fields of ``data`` that a state consists of, `STATE`."""
    return {name: getattr(data, name) for name in STATE}


def substitute(data: mjx.Data, where: Array, new: Start) -> mjx.Data:
    """``data``, not settled, with the fields of ``new`` replaced if ``where``."""
    return data.replace(**{name: jnp.where(where, value, getattr(data, name)) for name, value in new.items()})


def suite_directory() -> Path:
    """Where dm_control keeps the Control Suite's models; found without importing dm_control.

    Raises:
      ImportError: dm_control is not installed.
    """
    found = importlib.util.find_spec("dm_control")
    if found is None or found.origin is None:
        raise ImportError("the dmc environments need dm_control's model files: pip install dm-control")
    return Path(found.origin).parent / "suite"


def _closest_segment_point(a: Array, b: Array, point: Array) -> Array:
    """The point of the segment from ``a`` to ``b`` that is closest to ``point``, all [3]."""
    along = b - a
    squared = jnp.dot(along, along)
    share = jnp.dot(point - a, along) / jnp.where(squared > 0, squared, 1)
    return a + jnp.clip(share, 0, 1) * along


def _while_loop(condition: Callable, body: Callable, start: Any, _: int) -> Any:
    """A loop that ends where the condition does, which bounds its turns itself."""
    return jax.lax.while_loop(condition, body, start)


_INSTEAD = ((mjx_math, "closest_segment_point", _closest_segment_point), (mjx_solver, "_while_loop_scan", _while_loop))
"""What MJX is traced with in place of its own.

Its closest point of a segment adds 1e-6 to the squared length that it divides by. For capsules of a few centimetres
that turns the normals of contacts by up to 5e-4, and changes velocities as much.

Its line search can be differentiated in reverse, which nothing asks of a simulation whose solver can't. For that it
takes all its 50 turns whenever environments are stepped together, though few are needed.
"""


_TRACING = threading.RLock()
"""One thread at a time traces with these: of two, the first to end would put the other's back."""


@contextlib.contextmanager
def _mjx_numerics() -> Iterator[None]:
    """What MJX is traced under, whatever the caller's configuration.

    It relies on implicit promotion, and its solver on float32 products: the three digits of TensorFloat-32, a GPU's
    default, would take its trajectories away from MuJoCo's.
    """
    promotion = (jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"))
    with _TRACING:
        theirs = [getattr(module, name) for module, name, _ in _INSTEAD]
        for module, name, ours in _INSTEAD:
            setattr(module, name, ours)
        try:
            with promotion[0], promotion[1], jax.default_matmul_precision("highest"):
                yield
        finally:
            for (module, name, _), their in zip(_INSTEAD, theirs, strict=True):
                setattr(module, name, their)


@dataclasses.dataclass(frozen=True)
class Simulation:
    """A MuJoCo model and its stepping.

    dm_control keeps everything that depends on positions and velocities current ("settled" here) between control
    steps: a control step is ``n_sub_steps`` times forces and integration at the current state, then positions and
    velocities of the new state. So sensors of accelerations and forces speak of the state before the last
    integration, all others of the state after it.
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

        Raises:
          ValueError: as ``of``.
        """
        spec = mujoco.MjSpec.from_file(str(suite_directory() / filename))
        if edit is not None:
            edit(spec)
        with warnings.catch_warnings():
            # cheetah.xml scales its masses in a way that MuJoCo discourages in new models.
            warnings.filterwarnings("ignore", message=".*settotalmass")
            mj_model = spec.compile()
        return cls.of(mj_model, control_timestep)

    @classmethod
    def of(cls, mj_model: mujoco.MjModel, control_timestep: float | None = None) -> Simulation:
        """The simulation of any model, such as ``mujoco.MjModel.from_xml_path`` gives.

        Args:
          mj_model: is copied.
          control_timestep: seconds, a multiple of the model's timestep; None: one physics step.

        Raises:
          ValueError: this is no model, MJX lacks something that it uses (the message says what), or the control
            timestep is no multiple.

        Warns:
          support.SimulatedOtherwise: MJX finds the contacts of some of its geoms, such as boxes, meshes and height
            fields, otherwise than MuJoCo, or the model has connect or weld constraints, in which MJX leaves out a term.
            The message names them. Trajectories part then, by how much depends on the model: single bodies of 10 cm
            on such geoms were 1 mm to 8 cm off after 0.4 s.
        """
        if not isinstance(mj_model, mujoco.MjModel):
            raise ValueError(
                f"expected a mujoco.MjModel, such as mujoco.MjModel.from_xml_path makes of a file, got {mj_model!r}"
            )
        mj_model = copy.copy(mj_model)
        timestep = mj_model.opt.timestep
        if control_timestep is not None and not 0 < control_timestep < math.inf:
            raise ValueError(f"expected control_timestep in seconds, more than 0 and finite, got {control_timestep}")
        n_sub_steps = 1 if control_timestep is None else round(control_timestep / timestep)
        if n_sub_steps < 1 or abs(n_sub_steps * timestep - (control_timestep or timestep)) > 1e-9:
            raise ValueError(f"expected control_timestep to be a multiple of {timestep:g} s, got {control_timestep}")
        mj_model.opt.enableflags = support.without_idle_flags(mj_model.opt.enableflags)
        support.refuse_what_mjx_lacks(mj_model)
        touching = support.can_touch(mj_model)
        if not touching:
            mj_model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL  # no part in the dynamics; MJX fails at the other
        try:
            model = mjx.put_model(mj_model)
        except NotImplementedError as error:
            raise ValueError(f"MJX can't simulate this model: {error}") from error
        if not touching and (mj_model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH).any():
            raise ValueError("MJX can't simulate this model: it has touch sensors, and no two geoms that could touch")
        support.warn_of_differences(mj_model)
        return cls(mj_model, model, n_sub_steps)

    def fast(self) -> Simulation:
        """The same, with a line search of at most `LINE_SEARCH` turns in the constraint solver; MuJoCo's default is 50.

        Environments that are stepped together take as many turns as the one that needs most.
        """
        turns = min(LINE_SEARCH, int(self.mj_model.opt.ls_iterations))
        return dataclasses.replace(self, model=self.model.tree_replace({"opt.ls_iterations": turns}))

    @property
    def control_timestep(self) -> float:
        """Seconds."""
        return self.n_sub_steps * self.mj_model.opt.timestep

    def initial(self) -> mjx.Data:
        """The model's default state, at rest, settled and with its forces."""
        data = mujoco.MjData(self.mj_model)
        mujoco.mj_forward(self.mj_model, data)
        data.qacc_warmstart[:] = 0
        # What no stage computes is uninitialised memory, and may hold what no float32 can.
        # These are constants, also where a task asks for them while it is traced.
        with np.errstate(over="ignore", invalid="ignore"), jax.ensure_compile_time_eval():
            placed = mjx.put_data(self.mj_model, data)
            return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), placed)  # not bound to the device it was put on

    def in_contact(self, data: mjx.Data) -> Array:
        """Whether any two geoms touch at the given positions; ``data`` need not be settled."""
        with _mjx_numerics():
            contact = mjx.collision(self.model, mjx.kinematics(self.model, data))._impl.contact
            return (contact.dist < contact.includemargin).any()

    def settle(self, data: mjx.Data) -> mjx.Data:
        """Brings all that depends on positions and velocities, but for sensors, up to date."""
        with _mjx_numerics():
            return mjx.fwd_velocity(self.model, mjx.fwd_position(self.model, data))

    @jax.named_scope("physics")
    def advance(
        self, data: mjx.Data, control: Array, restart: Array, start: Start, fresh_forces: bool = False
    ) -> mjx.Data:
        """One control step or, where ``restart``, the state that an episode starts in.

        That is ``start``, settled, with all sensors read without any actuation, as in dm_control. Holding it in place
        of what the integrator returns makes one piece of compiled code serve both.

        Args:
          data: settled, as is what is returned.
          control: float32 [nu], in the actuators' units; without meaning where ``restart``.
          restart: bool [].
          start: of the new episode; fields that it leaves out stay as they are in ``data``.
          fresh_forces: whether the fields `FORCES` of a new episode, too, are its own: without actuation. Else, unless
            sensors need them, they may be the old episode's until the next step.
        """

        def move(data: mjx.Data) -> mjx.Data:
            settled = self.settle(substitute(data, restart, start))
            # In 64-bit mode MJX returns some integers wider than it takes them; a loop's carry has to keep its types.
            return jax.tree.map(lambda new, old: new.astype(old.dtype), settled, data)

        def step(_: Array, data: mjx.Data) -> mjx.Data:
            data = self._accelerate(data, passive=restart)
            with _mjx_numerics():
                return move(integrate(self.model, data))

        def runge_kutta(_: Array, data: mjx.Data) -> mjx.Data:
            return _runge_kutta(data, self.mj_model.opt.timestep, lambda data: self._accelerate(data, restart), move)

        def integrate(model: mjx.Model, data: mjx.Data) -> mjx.Data:
            if self.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
                return mjx.implicit(model, data)
            if self.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
                return mjx.euler(model, data)
            # The sensors speak of the first stage.
            return mjx.rungekutta4(model, data).replace(sensordata=data.sensordata)

        plain = self.mj_model.nq == self.mj_model.nv and not self.mj_model.na and not self._senses_acceleration
        rk4 = self.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        sub_steps: Any = self.n_sub_steps
        if (self._senses_acceleration or fresh_forces) and sub_steps == 1:
            sub_steps = jnp.where(restart, 2, 1)  # the second one computes the forces in the new state
        sub_step = runge_kutta if rk4 and plain else step
        return self._sense(jax.lax.fori_loop(0, sub_steps, sub_step, data.replace(ctrl=control)))

    @property
    def _senses_acceleration(self) -> bool:
        return bool((self.mj_model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC).any())

    def _accelerate(self, data: mjx.Data, passive: Array) -> mjx.Data:
        """Forces, constraints and the sensors that need them; where ``passive`` without the actuators' forces."""
        with _mjx_numerics():
            data = mjx.fwd_actuation(self.model, data)
            data = data.replace(qfrc_actuator=jnp.where(passive, 0.0, data.qfrc_actuator))
            data = mjx.fwd_acceleration(self.model, data)
            if data._impl.efc_J.size == 0:  # no constraint is possible in this model
                return mjx.sensor_acc(self.model, data.replace(qacc=data.qacc_smooth))
            return mjx.sensor_acc(self.model, mjx.solve(self.model, data))

    def _sense(self, data: mjx.Data) -> mjx.Data:
        """Reads the sensors that need positions and velocities alone."""
        with _mjx_numerics():
            return mjx.sensor_vel(self.model, mjx.sensor_pos(self.model, data))

    def sensor(self, name: str) -> slice:
        """Where a sensor's readings lie in ``data.sensordata``."""
        sensor = self.mj_model.sensor(name)
        return slice(sensor.adr[0], sensor.adr[0] + sensor.dim[0])


def _runge_kutta(
    data: mjx.Data,
    timestep: float,
    accelerate: Callable[[mjx.Data], mjx.Data],
    move: Callable[[mjx.Data], mjx.Data],
) -> mjx.Data:
    """The classical fourth-order Runge-Kutta step, for models with as many coordinates as degrees of freedom.

    MJX has one, but unrolled, which takes four times as long to compile. Here each stage is one turn of a loop:
    accelerations at the current point, then a move to the next stage's point or, from the last stage, to the result.
    """
    qpos, qvel = data.qpos, data.qvel
    ahead = jnp.array([0.5, 0.5, 1.0, 0.0])  # where the next stage lies along this stage's slope
    weight = jnp.array([1.0, 2.0, 2.0, 1.0]) / 6  # of this stage's slope in the mean slope
    last = jnp.array([0.0, 0.0, 0.0, 1.0])  # whether to move along the mean slope instead

    def stage(
        carry: tuple[mjx.Data, Array, Array], row: tuple[Array, Array, Array]
    ) -> tuple[tuple[mjx.Data, Array, Array], None]:
        (data, mean_qvel, mean_qacc), (ahead, weight, last) = carry, row
        data = accelerate(data)
        mean_qvel, mean_qacc = mean_qvel + weight * data.qvel, mean_qacc + weight * data.qacc
        data = data.replace(
            qpos=qpos + timestep * (ahead * data.qvel + last * mean_qvel),
            qvel=qvel + timestep * (ahead * data.qacc + last * mean_qacc),
            time=data.time + timestep * last,
            qacc_warmstart=data.qacc,
        )
        return (move(data), mean_qvel, mean_qacc), None

    carry = (data, jnp.zeros_like(qvel), jnp.zeros_like(qvel))
    return jax.lax.scan(stage, carry, (ahead, weight, last))[0][0]
