"""What replay holds in the place of an image: its pixels, what it is drawn from, or a ticket for the host's memory.

The ring knows none of these: it stores what `Storage.encode_obs` gives and `Storage.decode_obs` takes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple

import jax

from ne_dreamer_jax.replay.host_frames import HostFrames
from ne_dreamer_jax.system.parallel import SPLIT, per_shard
from ne_dreamer_jax.types import Array, EnvSpec, images_of

REDRAWN = 64
"""Frames drawn together out of replay, so that what lies between state and picture stays small."""

Obs = Mapping[str, Array]


class Storage(NamedTuple):
    """A way to keep observations."""

    encode_obs: Callable[[Any, Obs, Array], Obs]
    """(environment states [N], observations [N, ...], row int32 [] of the ring) -> what the ring stores [N, ...]."""
    decode_obs: Callable[[Obs], Obs]
    """The inverse, for observations [B, T, ...] out of replay."""
    host_bytes: int = 0
    """What it takes of the host's memory, beside the ring."""
    frames: HostFrames | None = None
    """Where it keeps images beside the ring; to be saved and loaded with it."""


def make(kind: Literal["pixels", "states", "host"], spec: EnvSpec, pictures: Any, rows: int, num_envs: int) -> Storage:
    """The storage of this kind.

    Args:
      spec: of the environment.
      pictures: ``VectorEnv.pictures``.
      rows: C, of the ring.
      num_envs: N.

    Raises:
      ValueError: the environment has no images, or none that can be drawn again.
    """
    if kind == "pixels":
        return pixels()
    if kind == "states":
        if pictures is None:
            raise ValueError(
                "loop.storage: expected 'pixels' for an environment without images that can be drawn again from its "
                "state, got 'states'."
            )
        return states(spec, pictures)
    if not images_of(spec):
        raise ValueError("loop.storage: expected 'pixels' for an environment without images, got 'host'.")
    return host(HostFrames(rows, num_envs, images_of(spec)))


def pixels() -> Storage:
    """Observations as they are."""
    return Storage(lambda env_state, obs, row: obs, lambda obs: obs)


def states(spec: EnvSpec, pictures: Any) -> Storage:
    """What the image is drawn from: drawn again, to the bit, whenever it is sampled."""
    (name,) = images_of(spec)

    def encode(env_state: Any, obs: Obs, row: Array) -> Obs:
        return {**obs, name: pictures.record(env_state)}

    def redraw(records: Array) -> Array:
        flat = records.reshape(-1, records.shape[-1])
        drawn = jax.lax.map(pictures.redraw, flat, batch_size=min(REDRAWN, len(flat)))
        return drawn.reshape(*records.shape[:2], *drawn.shape[1:])

    return Storage(encode, lambda obs: {**obs, name: per_shard(redraw, (SPLIT,), SPLIT)(obs[name])})


def host(frames: HostFrames) -> Storage:
    """Tickets for images in the host's memory."""

    def encode(env_state: Any, obs: Obs, row: Array) -> Obs:
        tickets = frames.tickets(row)
        put = {name: per_shard(partial(frames.put, name), (SPLIT, SPLIT), SPLIT) for name in frames.shapes}
        return {**obs, **{name: put[name](tickets, obs[name]) for name in put}}

    def decode(obs: Obs) -> Obs:
        get = {name: per_shard(partial(frames.get, name), (SPLIT,), SPLIT) for name in frames.shapes}
        return {**obs, **{name: get[name](obs[name]) for name in get}}

    return Storage(encode, decode, frames.nbytes, frames)
