"""The smallest DrQ-v2, and data for it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.replay import ring as replay
from ne_dreamer_jax.types import ArraySpec, Batch, ContinuousAction, EnvSpec, Latent

IMAGE = EnvSpec({"image": ArraySpec((16, 17, 3), jnp.uint8)}, ContinuousAction(2))
VECTOR = EnvSpec({"vector": ArraySpec((3,), jnp.float32)}, ContinuousAction(2))
BOTH = EnvSpec({**IMAGE.observation, **VECTOR.observation}, ContinuousAction(2))

CONFIG = DrQv2Config(batch_size=6, channels=2, features=4, units=8, learning_rate=1e-2, random_steps=10)


def nothing(rows: int) -> Latent:
    """Latents without elements."""
    return Latent(jnp.zeros((rows, 0)), jnp.zeros((rows, 0, 1)))


def batch(spec: EnvSpec, config: DrQv2Config = CONFIG, seed: int = 0) -> Batch:
    """Noise, with an end in the middle of the second sequence and at the acted-upon step of the third."""
    made = replay.random_batch(spec, config, jax.random.key(seed))
    ends = np.zeros(made.reward.shape, bool)
    ends[1, config.frame_stack] = ends[2, config.frame_stack - 1] = True
    first = np.concatenate([np.zeros((len(ends), 1), bool), ends[:, :-1]], axis=1)
    return made._replace(is_first=jnp.asarray(first), is_last=jnp.asarray(ends), is_terminal=jnp.asarray(ends))


def copy(tree: Any) -> Any:
    """For a function that donates."""
    return jax.tree.map(jnp.copy, tree)
