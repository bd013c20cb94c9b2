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
    """A task as its domain's file defines it."""

    simulation: Simulation
    time_limit: float  # seconds
    reset: Callable[[Array], tuple[mjx.Data, Episode]]  # key -> the first state, not settled
    reward: Callable[[mjx.Data, Episode], Array]  # float32 []
    observe: Callable[[mjx.Data, Episode], dict[str, Array]]  # dm_control's observations, float32
    camera: int = 0  # the camera whose pixels agents see
    overrides: Callable[[Episode], Any] = lambda episode: None  # what the episode changes in the drawn scene


def random_joints(mj_model: mujoco.MjModel) -> Callable[[Array], Array]:
    """Returns a function ``key -> qpos``: limited joints uniform in their range, unlimited hinges in [-pi, pi).

    Unlimited slides keep their default. Equal in distribution to dm_control's
    ``randomize_limited_and_rotational_joints``.

    Raises:
      ValueError: the model has ball or free joints.
    """
    hinge = mj_model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    if not (hinge | (mj_model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE)).all():
        raise ValueError("expected a model with hinge and slide joints only, got one with ball or free joints")
    limited = mj_model.jnt_limited.astype(bool)
    low = np.where(limited, mj_model.jnt_range[:, 0], np.where(hinge, -np.pi, mj_model.qpos0))
    high = np.where(limited, mj_model.jnt_range[:, 1], np.where(hinge, np.pi, mj_model.qpos0))
    return lambda key: jax.random.uniform(key, low.shape, jnp.float32, low.astype("float32"), high.astype("float32"))


def uniform(key: Array, low: float, high: float, shape: tuple[int, ...] = ()) -> Array:
    """float32, uniform in [low, high)."""
    return jax.random.uniform(key, shape, jnp.float32, low, high)
