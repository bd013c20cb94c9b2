"""Learning from what replay holds, without an environment."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp

from ne_dreamer_jax.agents import guard
from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.loop.learn import Learning, draw_batch, learn_what_is_due
from ne_dreamer_jax.replay import ring, storage
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import Array, Metrics

BLOCK = 1_024
"""Updates whose metrics are added up before they join those of the others, as a long float32 sum rounds to one side."""


def train_offline(
    agent: Agent, state: Any, replay: ring.Replay, key: Array, updates: int, write_latents: bool = True
) -> tuple[Any, ring.Replay, Metrics]:
    """So many updates on batches out of replay, as one compiled program.

    Args:
      agent: of ``make_agent``.
      state: its train state; donated, as is ``replay``.
      replay: such as ``replay.from_episodes`` gives.
      key: consumed, for the batches.
      updates: how many, at least one.
      write_latents: whether posterior latents are written back into replay.

    Returns:
      The new train state, replay, and the metrics, float32 []: means over the updates that were made, NaN where none
      was, as those whose numbers are not finite are skipped; ``skipped_updates`` and ``non_finite/...`` count these.

    Raises:
      ValueError: replay holds too few steps for a sequence, or no update is asked for.
    """
    length = agent.config.batch_length
    if updates < 1 or updates != int(updates):
        raise ValueError(f"updates: expected a whole number of at least 1, got {updates}")
    if not bool(ring.can_sample(replay, length)):
        raise ValueError(
            f"replay: expected more than agent.batch_length {length} steps, got {int(replay.size)}; take shorter "
            "sequences or more data"
        )
    program = _program(_Learner(agent), write_latents)
    return program(state, replay, key, jnp.asarray(updates, jnp.int32))


class _Learner:
    """An agent, by which its program is found again: the same update and the same settings."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Learner):
            return False
        ours, theirs = self.agent, other.agent
        return ours.train_step is theirs.train_step and ours.config == theirs.config and ours.spec == theirs.spec

    def __hash__(self) -> int:
        return id(self.agent.train_step)


@lru_cache(maxsize=8)
def _program(learner: _Learner, write_latents: bool) -> Callable[..., tuple[Any, ring.Replay, Metrics]]:
    """Compiled once for an agent, however often it learns; those of the last eight agents are kept."""
    agent, kept = learner.agent, storage.pixels()

    def run(state: Any, replay: ring.Replay, key: Array, updates: Array) -> tuple[Any, ring.Replay, Metrics]:
        batch = jax.eval_shape(partial(draw_batch, agent, kept), replay, key)
        shapes = jax.eval_shape(agent.train_step, state, batch)[2]
        sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        before, zero = state.update, jnp.zeros((), jnp.int32)

        def block(number: Array, carry: tuple[Learning, Metrics]) -> tuple[Learning, Metrics]:
            learning, totals = carry
            due = jnp.minimum(updates - number * BLOCK, BLOCK)
            learning = learn_what_is_due(agent, kept, write_latents, due, learning._replace(sums=sums))
            return learning, jax.tree.map(jnp.add, totals, learning.sums)

        learning = Learning(state, replay, key, sums, zero)
        learning, totals = jax.lax.fori_loop(0, -(-updates // BLOCK), block, (learning, sums))
        state, replay = learning.train, learning.replay
        made = (state.update - before).astype(jnp.float32)
        return state, replay, {name: x if guard.is_count(name) else x / made for name, x in totals.items()}

    return jax.jit(in_32_bits(run), donate_argnums=(0, 1))
