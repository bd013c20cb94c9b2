"""Replay: a ring on the device (`ring`), what stands in it for an image (`storage`), images on the host."""

from ne_dreamer_jax.replay.offline import Episode, from_episodes
from ne_dreamer_jax.replay.ring import (
    Replay,
    add,
    can_sample,
    capacity_for,
    check_capacity,
    init,
    nbytes,
    random_batch,
    sample,
    write_latents,
)

__all__ = [
    "Episode",
    "Replay",
    "add",
    "can_sample",
    "capacity_for",
    "check_capacity",
    "from_episodes",
    "init",
    "nbytes",
    "random_batch",
    "sample",
    "write_latents",
]
