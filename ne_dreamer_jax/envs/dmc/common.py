"""What the Control Suite's domains share: what a task is, and distributions of first states."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from ne_dreamer_jax.envs.dmc.simulation import Simulation, mjx
from ne_dreamer_jax.types import Array

Episode = Any  # what a task draws anew for each episode besides the state, a pytree of arrays


class Task(NamedTuple):
    """A task: a model, and functions of its ``mjx.Data`` and of what the episode has drawn.

    Attributes:
      simulation: the model and its stepping.
      time_limit: seconds of an episode.
      reset: key -> the first state and the episode's draws: ``simulation.initial()`` with other values of fields that a
        state consists of (``simulation.STATE``: ``qpos``, ``qvel``, ``mocap_pos``, ``eq_active``, ...). Whatever
        follows from these is computed anew.
      reward: (data, episode) -> float32 [], of each control step.
      observe: (data, episode) -> name -> float32 [] or [n], the observations beside pixels.
      episode: an example of what ``reset`` draws besides the state, for shapes.
      coast: control steps without action from the first state on, before the episode begins.
      camera: id or name of the camera whose pixels agents see.
      pose: (data, episode) -> data with what the episode moves, such as a target, for drawing.
      terminal: (data, episode) -> bool [], whether the episode ends here, in a state of value zero; asked after each
        control step, whatever the action repeat. None: episodes end by their time limit alone.
    """

    simulation: Simulation
    time_limit: float
    reset: Callable[[Array], tuple[mjx.Data, Episode]]
    reward: Callable[[mjx.Data, Episode], Array]
    observe: Callable[[mjx.Data, Episode], dict[str, Array]]
    episode: Episode = ()
    coast: int = 0
    camera: int | str = 0
    pose: Callable[[mjx.Data, Episode], mjx.Data] = lambda data, _: data
    terminal: Callable[[mjx.Data, Episode], Array] | None = None


def random_joints(mj_model: mujoco.MjModel, unlimited: bool = True) -> Callable[[Array], Array]:
    """Returns a function ``key -> qpos`` that draws limited joints uniformly in their range.

    Where ``unlimited``, unlimited hinges are uniform in [-pi, pi), as in dm_control's
    ``randomize_limited_and_rotational_joints``. All other joints keep their default.

    Raises:
      ValueError: the model has ball or free joints.
    """
    hinge = mj_model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    if not (hinge | (mj_model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE)).all():
        raise ValueError("expected a model with hinge and slide joints only, got one with ball or free joints")
    around = hinge & unlimited
    limited = mj_model.jnt_limited.astype(bool)
    low = np.where(limited, mj_model.jnt_range[:, 0], np.where(around, -np.pi, mj_model.qpos0))
    high = np.where(limited, mj_model.jnt_range[:, 1], np.where(around, np.pi, mj_model.qpos0))
    return lambda key: jax.random.uniform(key, low.shape, jnp.float32, low.astype("float32"), high.astype("float32"))


def redraw_while_touching(
    simulation: Simulation, sample: Callable[[Array], Array], max_attempts: int = 1000
) -> Callable[[Array], Array]:
    """Returns a function ``key -> qpos`` that draws from ``sample`` until no two geoms touch.

    After ``max_attempts`` it gives what it has.
    """
    initial = simulation.initial()

    def draw(key: Array) -> Array:
        def attempt(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
            key, attempts = jax.random.split(carry[0])[0], carry[1] + 1
            qpos = sample(jax.random.split(carry[0])[1])
            return key, attempts, qpos, simulation.in_contact(initial.replace(qpos=qpos))

        start = (key, jnp.zeros((), jnp.int32), initial.qpos, jnp.ones((), bool))
        return jax.lax.while_loop(lambda carry: carry[3] & (carry[1] < max_attempts), attempt, start)[2]

    return draw


def uniform(key: Array, low: float, high: float, shape: tuple[int, ...] = ()) -> Array:
    """float32, uniform in [low, high)."""
    return jax.random.uniform(key, shape, jnp.float32, low, high)
