"""Sample, update, and write the new latents back."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.agents import guard
from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.replay import ring
from ne_dreamer_jax.replay.storage import Storage
from ne_dreamer_jax.types import Array, Batch, Metrics


class Learning(NamedTuple):
    """What updates change."""

    train: Any  # the agent's train state
    replay: Any
    key: Array
    sums: Metrics  # of the updates' metrics
    skipped: Array  # int32 [], updates skipped in a row, the last one included


@jax.named_scope("replay")
def draw_batch(agent: Agent, storage: Storage, replay: Any, key: Array) -> Batch:
    """B sequences of T steps out of replay, with observations as the agent takes them."""
    batch = ring.sample(replay, key, agent.config.batch_size, agent.config.batch_length)
    return batch._replace(obs=storage.decode_obs(batch.obs))


def learn(
    agent: Agent, storage: Storage, write_latents: bool, train: Any, replay: Any, key: Array
) -> tuple[Any, Any, Metrics]:
    """One update.

    Args:
      write_latents: whether the posterior latents of the batch replace those in replay.
      train: the agent's train state.
      key: consumed, for the batch.

    Returns:
      The new train state, replay, and the update's metrics as they are added up (`guard.counted`).
    """
    batch = draw_batch(agent, storage, replay, key)
    update = train.update
    train, latents, metrics = agent.train_step(train, batch)
    if write_latents:  # but not those of an update that was skipped
        replay = ring.write_latents(replay, batch.index, latents, where=train.update > update)
    return train, replay, guard.counted(metrics)


def learn_what_is_due(agent: Agent, storage: Storage, write_latents: bool, due: Array, before: Learning) -> Learning:
    """So many updates (int32 []), one after another."""

    def update(learning: Learning) -> Learning:
        key, sample_key = jax.random.split(learning.key)
        train, replay, metrics = learn(agent, storage, write_latents, learning.train, learning.replay, sample_key)
        sums = {name: learning.sums[name] + metrics[name] for name in learning.sums}
        skipped = jnp.where(train.update > learning.train.update, 0, learning.skipped + 1)
        return Learning(train, replay, key, sums, skipped)

    return jax.lax.fori_loop(0, due, lambda _, learning: update(learning), before)
