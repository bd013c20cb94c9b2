"""Sample, update, and write the new latents back."""

from __future__ import annotations

from typing import Any

import jax

from ne_dreamer_jax.agents import guard
from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.replay import ring
from ne_dreamer_jax.replay.storage import Storage
from ne_dreamer_jax.types import Array, Batch, Metrics


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


def learn_what_is_due(
    agent: Agent, storage: Storage, write_latents: bool, due: Array, train: Any, replay: Any, key: Array, sums: Metrics
) -> tuple[Any, Any, Metrics]:
    """So many updates (int32 []), one after another; ``sums`` with their metrics added."""

    def update(carry: tuple[Any, Any, Array, Metrics]) -> tuple[Any, Any, Array, Metrics]:
        train, replay, key, sums = carry
        key, sample_key = jax.random.split(key)
        train, replay, metrics = learn(agent, storage, write_latents, train, replay, sample_key)
        return train, replay, key, {name: sums[name] + metrics[name] for name in sums}

    train, replay, _, sums = jax.lax.fori_loop(0, due, lambda _, carry: update(carry), (train, replay, key, sums))
    return train, replay, sums
