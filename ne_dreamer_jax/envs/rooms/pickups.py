"""Objects that are taken by walking into them, and the end after the tenth: what two of the tasks share."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ne_dreamer_jax.envs.rooms.movement import within_reach
from ne_dreamer_jax.types import Array

LAST = 10  # pick-ups of an episode
GRACE_FRAMES = 13  # from the frame of the tenth to the end: 0.2 s, counted from the frame before


class Taken(NamedTuple):
    """Which objects lie there still, and how many were taken."""

    there: Array  # bool [N]
    total: Array  # int32 []
    tenth: Array  # int32 [], clock before the frame of the tenth; -1 before that


def untouched(there: Array) -> Taken:
    """At the start; ``there`` [N] is False where an object is none."""
    return Taken(there, jnp.zeros((), jnp.int32), jnp.full((), -1, jnp.int32))


def take(taken: Taken, position: Array, items: Array, clock: Array) -> tuple[Taken, Array]:
    """What a player at ``position`` picks up in the frame after ``clock``: the new state, and which ones, bool [N]."""
    now = taken.there & within_reach(position, items)
    total = taken.total + jnp.sum(now).astype(jnp.int32)
    tenth = jnp.where((taken.tenth < 0) & (total >= LAST), clock, taken.tenth)
    return Taken(taken.there & ~now, total, tenth), now


def over(taken: Taken, clock: Array) -> Array:
    """Whether the episode ends with the frame after ``clock``."""
    return (taken.tenth >= 0) & (clock + 1 >= taken.tenth + GRACE_FRAMES)
