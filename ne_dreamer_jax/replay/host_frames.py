"""Images of replay in the host's memory, for environments whose images can't be drawn again from less.

Replay on the device keeps a ticket in the place of each image. Compiled programs trade images for tickets (`put`) and
tickets for images (`get`) by calling back to the host::

    frames = HostFrames(rows, envs, images)
    tickets = frames.put("image", frames.tickets(position), images)   # int32 [N], uint8 [N, H, W, C]
    images = frames.get("image", tickets)                             # of tickets that `put` has returned

A `get` comes after the `put` whose result its tickets are taken from, and before a `put` in a later iteration of the
same loop or in a later program. This memory is no part of the loop's state: it is saved and loaded beside it, and one
run at a time uses it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback

from ne_dreamer_jax.types import Array, ArraySpec

_PIECE = 2**14
"""Bytes of one argument of a callback. JAX copies arguments of some 100 kB and more in the CPU client's threads, and
waits for ever where all of them are in callbacks (github.com/jax-ml/jax/issues/24255)."""


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
        self._allocating = threading.Lock()  # several devices may store their first images at the same time

    @property
    def nbytes(self) -> int:
        """Bytes of all images."""
        return sum(math.prod(s.shape) * s.dtype.itemsize for s in self._shapes.values())

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Name -> the ring itself, made when it is first asked for; the system hands out pages as they are written."""
        with self._allocating:
            if self._arrays is None:
                self._arrays = {name: np.zeros(s.shape, s.dtype) for name, s in self._shapes.items()}
            return self._arrays

    @property
    def shapes(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Of `arrays`."""
        return dict(self._shapes)

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Goes on with what `arrays` was: takes these arrays over, without a copy where they can be written to."""
        with self._allocating:
            self._arrays = {name: np.require(arrays[name], s.dtype, ["C", "W"]) for name, s in self._shapes.items()}

    def tickets(self, row: Array) -> Array:
        """Those of a row (int32 []), int32 [N]."""
        return row * self.envs + jnp.arange(self.envs, dtype=jnp.int32)

    def put(self, name: str, tickets: Array, images: Array) -> Array:
        """Stores images ``[n, ...]`` under tickets int32 [n], and returns the tickets once they are stored."""
        shape = images.shape

        def store(tickets: Any, images: Any) -> np.ndarray:
            stored = _joined(tickets)
            row, env = np.divmod(stored, self.envs)
            self.arrays[name][row, env] = _joined(images).reshape(shape)
            return stored

        stored = jax.ShapeDtypeStruct(tickets.shape, tickets.dtype)
        return io_callback(store, stored, _pieces(tickets), _pieces(images))

    def get(self, name: str, tickets: Array) -> Array:
        """The images ``[..., H, W, C]`` of tickets int32 [...]."""
        lead, stored = tickets.shape, self._shapes[name]

        def fetch(pieces: Any) -> np.ndarray:
            row, env = np.divmod(_joined(pieces).reshape(lead), self.envs)
            return self.arrays[name][row, env]

        return io_callback(fetch, jax.ShapeDtypeStruct((*lead, *stored.shape[2:]), stored.dtype), _pieces(tickets))


def _pieces(x: Array) -> list[Array]:
    """An array's numbers in a row, cut so that none is too large to be an argument of a callback."""
    flat, length = x.reshape(-1), max(1, _PIECE // x.dtype.itemsize)
    return [flat[start : start + length] for start in range(0, flat.size, length)]


def _joined(pieces: Any) -> np.ndarray:
    """The numbers of `_pieces` in a row, copied."""
    return np.concatenate([np.asarray(piece) for piece in pieces])
