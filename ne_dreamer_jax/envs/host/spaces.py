"""From what other people's environments observe and take to what agents see and do, in plain numpy.

Spaces are known by what they have, as each library brings its own classes: ``n`` makes one discrete (or, without
``nvec``, binary), ``low`` and ``high`` a box, ``spaces`` a dict or tuple.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

CHANNELS = (1, 2, 3, 4)
"""Of images; a first axis of such a size, and a last one that is none, makes them channels first."""
LARGEST_ONE_HOT = 65_536


class Described(NamedTuple):
    """What a learner has to know of an environment; goes from a worker to the main process."""

    observations: dict[str, tuple[tuple[int, ...], str]]  # name -> shape and dtype, "uint8" or "float32"
    actions: int  # how many there are, or how many components they have
    discrete: bool
    step_seconds: float | None  # simulated time of an agent step, where the environment has such


Reader = Callable[[Any], np.ndarray]


def leaves(space: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Names and spaces of all parts of a space; nested names are joined by ``/``, the only part's name is empty."""
    inner = getattr(space, "spaces", None)
    if inner is None and isinstance(space, Mapping):
        inner = space
    if inner is None:
        yield name, space
        return
    for key, part in inner.items() if isinstance(inner, Mapping) else enumerate(inner):
        yield from leaves(part, f"{name}/{key}" if name else str(key))


def flat(value: Any, name: str = "") -> dict[str, Any]:
    """An observation's parts by the names that `leaves` gives them."""
    if isinstance(value, Mapping | tuple | list):
        entries = value.items() if isinstance(value, Mapping) else enumerate(value)
        return {k: v for key, part in entries for k, v in flat(part, f"{name}/{key}" if name else str(key)).items()}
    return {name: value}


def observation(name: str, space: Any, image_size: int | None) -> tuple[str, tuple[int, ...], str, Reader]:
    """The name, shape and dtype of a part of the observation as an agent sees it, and what makes it of a value.

    Images (uint8 of rank 3, or of rank 2 without channels) become ``[image_size, image_size, C]``; all else becomes a
    float32 vector, a single number one without axes: numbers flattened, choices as one-hot vectors.

    Raises:
      ValueError: an observation that no encoder takes; the message says what to make of it.
    """
    where = f"observation {name!r}" if name else "the observation"
    if hasattr(space, "nvec"):
        return _choices(name, np.asarray(space.nvec).reshape(-1), where)
    if hasattr(space, "n") and not hasattr(space, "low"):
        if np.ndim(space.n) or getattr(space, "shape", ()) not in ((), None):  # MultiBinary
            return _vector(name, tuple(space.shape))
        return _choices(name, np.array([int(space.n)]), where, int(getattr(space, "start", 0)))
    shape, dtype = getattr(space, "shape", None), getattr(space, "dtype", None)
    if shape is None or dtype is None or (not np.issubdtype(dtype, np.number) and dtype != np.bool_):
        raise ValueError(
            f"{where}: expected a Box, Discrete, MultiDiscrete, MultiBinary, or a Dict or Tuple of these, got {space}; "
            "leave it out or turn it into numbers by a wrapper (gymnasium.wrappers.TransformObservation)"
        )
    shape, dtype = tuple(shape), np.dtype(dtype)
    if len(shape) < 2 or (len(shape) == 2 and dtype != np.uint8):
        return _vector(name, shape)
    if len(shape) > 3 or dtype != np.uint8:
        raise ValueError(
            f"{where}: expected images as uint8 [height, width, channels], or vectors, got {dtype.name} "
            f"{list(shape)}; convert it by a wrapper (gymnasium.wrappers.TransformObservation, FlattenObservation)"
        )
    if len(shape) == 3 and shape[2] not in CHANNELS:
        first = " with the channels first" if shape[0] in CHANNELS else ""
        raise ValueError(
            f"{where}: expected images as uint8 [height, width, channels], with 1 to 4 channels, got {list(shape)}"
            f"{first}; move them by a wrapper: gymnasium.wrappers.TransformObservation(env, "
            "lambda image: image.transpose(1, 2, 0), space)"
        )
    channels = shape[2] if len(shape) == 3 else 1
    size = shape[:2] if image_size is None else (image_size, image_size)

    def read(value: Any) -> np.ndarray:
        image = np.asarray(value)
        if image.shape != shape or image.dtype != np.uint8:
            raise ValueError(
                f"{where}: expected uint8 {list(shape)}, as its space says, got {image.dtype} {list(image.shape)}"
            )
        return resized(image, size)

    return name or "image", (*size, channels), "uint8", read


def resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """uint8 [H, W] or [H, W, C] as ``[*size, C]``: means of areas where it shrinks, pixels repeated where it grows."""
    if image.ndim == 2:
        image = image[..., None]
    if image.shape[:2] == size:
        return image
    from PIL import Image

    shrinks = size[0] < image.shape[0] or size[1] < image.shape[1]
    how = Image.Resampling.BOX if shrinks else Image.Resampling.NEAREST
    planes = [np.asarray(Image.fromarray(plane).resize(size[::-1], how)) for plane in np.moveaxis(image, 2, 0)]
    return np.stack(planes, axis=2)


def action(space: Any) -> tuple[int, bool, Callable[[np.ndarray], Any]]:
    """How many actions or components, whether they are discrete, and what makes the environment's own of ours.

    Components in [-1, 1] are scaled to the box's bounds and clipped there.

    Raises:
      ValueError: neither discrete nor a bounded box of numbers.
    """
    if hasattr(space, "n") and not hasattr(space, "low") and not np.ndim(space.n) and not getattr(space, "shape", ()):
        start = int(getattr(space, "start", 0))
        return int(space.n), True, lambda chosen: start + int(chosen)
    if not (hasattr(space, "low") and hasattr(space, "high")):
        raise ValueError(
            f"expected a Discrete action space or a bounded Box of floats, got {space}; turn it into one by a wrapper "
            "(gymnasium.wrappers.TransformAction)"
        )
    shape, dtype = tuple(space.shape), np.dtype(space.dtype)
    if not np.issubdtype(dtype, np.floating):
        raise ValueError(f"expected a Discrete action space or a Box of floats, got a box of {dtype.name}: {space}")
    low, high = (np.broadcast_to(np.asarray(bound, np.float64), shape) for bound in (space.low, space.high))
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
        raise ValueError(
            f"expected an action space with finite bounds, got low {low} and high {high}; bound it by a wrapper "
            "(gymnasium.wrappers.RescaleAction, ClipAction)"
        )

    def scaled(chosen: np.ndarray) -> np.ndarray:
        unit = np.clip(np.asarray(chosen, np.float64), -1.0, 1.0).reshape(shape)
        return np.clip(low + 0.5 * (unit + 1.0) * (high - low), low, high).astype(dtype)

    return int(np.prod(shape, dtype=np.int64)), False, scaled


def _vector(name: str, shape: tuple[int, ...]) -> tuple[str, tuple[int, ...], str, Reader]:
    flattened = (int(np.prod(shape, dtype=np.int64)),) if shape else ()

    def read(value: Any) -> np.ndarray:
        with np.errstate(over="ignore"):  # what is too large for float32 is infinite, and reported as such
            vector = np.asarray(value).astype(np.float32)
        return vector.reshape(-1) if shape or vector.size != 1 else vector.reshape(())

    return name or "vector", flattened, "float32", read


def _choices(name: str, sizes: np.ndarray, where: str, start: int = 0) -> tuple[str, tuple[int, ...], str, Reader]:
    """One-hot vectors of choices among ``sizes``, one after the other."""
    if sizes.sum() > LARGEST_ONE_HOT:
        raise ValueError(
            f"{where}: expected at most {LARGEST_ONE_HOT:,} values as a one-hot vector, got {sizes.sum():,}; turn it "
            "into numbers by a wrapper (gymnasium.wrappers.TransformObservation)"
        )
    offsets = np.cumsum(sizes) - sizes

    def read(value: Any) -> np.ndarray:
        chosen = np.asarray(value).reshape(-1).astype(np.int64) - start
        if chosen.shape != sizes.shape or (chosen < 0).any() or (chosen >= sizes).any():
            raise ValueError(f"{where}: expected values in {start} to {start} + {sizes.tolist()}, got {value}")
        vector = np.zeros(int(sizes.sum()), np.float32)
        vector[offsets + chosen] = 1.0
        return vector

    return name or "vector", (int(sizes.sum()),), "float32", read
