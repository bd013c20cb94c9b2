"""Images of replay in the host's memory, for environments whose images can't be drawn again from less.

Replay on the device keeps a ticket in the place of each image. Compiled programs trade images for tickets (`put`) and
tickets for images (`get`) by calling back to the host::

    frames = HostFrames(rows, envs, images)
    tickets = frames.put("image", frames.tickets(position), images)   # int32 [N], uint8 [N, H, W, C]
    images = frames.get("image", tickets)                             # of tickets that `put` has returned

What `get` returns is what `put` stored because tickets flow from one to the other: take them from `put`'s result. This
memory is no part of the loop's state: it is saved and loaded beside it, and one run at a time uses it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback

from ne_dreamer_jax.types import Array, ArraySpec, EnvSpec


def images_of(spec: EnvSpec) -> dict[str, ArraySpec]:
    """The observations that are images: uint8 [H, W, C]."""
    return {name: s for name, s in spec.observation.items() if s.dtype == jnp.uint8 and len(s.shape) == 3}


class HostFrames:
    """Rings of images, ``[C, N, H, W, ...]`` each, row for row those of a replay of C rows and N environments."""

    def __init__(self, rows: int, envs: int, images: Mapping[str, ArraySpec]) -> None:
        """Allocates nothing yet.

        Args:
          rows: C.
          envs: N.
          images: name -> shape and dtype of one image.
        """
        self.envs = envs
        self._shapes = {name: jax.ShapeDtypeStruct((rows, envs, *s.shape), s.dtype) for name, s in images.items()}
        self._arrays: dict[str, np.ndarray] | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of all images."""
        return sum(math.prod(s.shape) * s.dtype.itemsize for s in self._shapes.values())

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Name -> the ring itself. The system hands out its pages as they are written."""
        if self._arrays is None:
            self._arrays = {name: np.zeros(s.shape, s.dtype) for name, s in self._shapes.items()}
        return self._arrays

    def shapes(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Of `arrays`, placed in the host's memory, for `checkpoint.restore`."""
        host = jax.sharding.SingleDeviceSharding(jax.local_devices(backend="cpu")[0])
        return {name: jax.ShapeDtypeStruct(s.shape, s.dtype, sharding=host) for name, s in self._shapes.items()}

    def load(self, arrays: Mapping[str, Any]) -> None:
        """Takes over what `arrays` was."""
        for name, ring in self.arrays.items():
            ring[...] = np.asarray(arrays[name])

    def tickets(self, row: Array) -> Array:
        """Those of a row (int32 []), int32 [N]."""
        return row * self.envs + jnp.arange(self.envs, dtype=jnp.int32)

    def put(self, name: str, tickets: Array, images: Array) -> Array:
        """Stores images ``[n, ...]`` under tickets int32 [n], and returns the tickets once they are stored."""

        def store(tickets: Any, images: Any) -> np.ndarray:
            row, env = np.divmod(np.asarray(tickets), self.envs)
            self.arrays[name][row, env] = np.asarray(images)
            return np.asarray(tickets)

        return io_callback(store, jax.ShapeDtypeStruct(tickets.shape, tickets.dtype), tickets, images)

    def get(self, name: str, tickets: Array) -> Array:
        """The images ``[..., H, W, C]`` of tickets int32 [...]."""

        def fetch(tickets: Any) -> np.ndarray:
            row, env = np.divmod(np.asarray(tickets), self.envs)
            return self.arrays[name][row, env]

        shape, dtype = self._shapes[name].shape, self._shapes[name].dtype
        return io_callback(fetch, jax.ShapeDtypeStruct((*tickets.shape, *shape[2:]), dtype), tickets)
