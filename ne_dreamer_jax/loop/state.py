"""What a run is between two chunks, and what a chunk reports."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from ne_dreamer_jax.agents import guard
from ne_dreamer_jax.types import Array, Metrics, PolicyState


class Counters(NamedTuple):
    """How far a run has come, as int32 []."""

    vector_step: Array  # agent steps of each environment
    credit: Array  # what updates are paid with, see `Budget`
    skipped: Array  # updates skipped in a row, because their numbers were not finite


class Episodes(NamedTuple):
    """The running episode of each environment."""

    ret: Array  # float32 [N], sum of rewards so far
    length: Array  # int32 [N], agent steps so far


class LoopState(NamedTuple):
    """Everything that a run is, images on the host apart: saved and restored as a whole."""

    train: Any  # the agent's train state: `types.TrainState`
    env: Any  # environment states, [N, ...]
    policy: PolicyState  # [N, ...]; its prev_action is what the environments are stepped with next
    replay: Any
    episodes: Episodes
    counters: Counters
    key: Array  # typed key []


class Finished(NamedTuple):
    """Sums over the episodes that ended in a chunk."""

    episodes: Array  # float32 []
    returns: Array  # float32 []
    lengths: Array  # float32 [], agent steps

    @classmethod
    def none(cls) -> Finished:
        """No episode yet."""
        return cls(*(jnp.zeros((), jnp.float32) for _ in range(3)))


class Report(NamedTuple):
    """What happened in a chunk, as sums and counts."""

    updates: Array  # int32 []
    learning: Metrics  # name -> sum over the updates, float32 []
    finished: Finished
    faults: Array  # int32 [], episodes that environments cut because their simulation broke down
    bad_actions: Array  # int32 [], episodes that they cut because an action was not finite

    def means(self) -> dict[str, float]:
        """Means over updates and over finished episodes, and the counts; what nothing was counted of is left out.

        For a report whose arrays are on the host.
        """
        values = {"episodes": float(self.finished.episodes)}
        values |= {"faults": float(self.faults), "bad_actions": float(self.bad_actions)}
        if self.finished.episodes:
            values["return"] = float(self.finished.returns / self.finished.episodes)
            values["length"] = float(self.finished.lengths / self.finished.episodes)
        if self.updates:
            values |= {n: float(v) / int(self.updates) for n, v in self.learning.items() if not guard.is_count(n)}
        # What was not finite is told where something was.
        values |= {n: float(v) for n, v in self.learning.items() if guard.is_count(n) and v}
        return values
