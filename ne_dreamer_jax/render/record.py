"""What a picture is drawn from, as one short vector that can be kept in the picture's place."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.render.rays import Array
from ne_dreamer_jax.render.scene import Scene

_FIELDS = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "xpos", "subtree_com")


def record(scene: Scene, data: Any) -> Array:
    """All that ``draw(scene, data)`` reads of a state but overrides: float32 [P], a few hundred bytes.

    ``data`` is as ``draw`` takes it. ``draw(scene, recorded(scene, record(scene, data)))`` is the same picture.
    """
    parts = [jnp.asarray(getattr(data, name), jnp.float32)[rows].reshape(-1) for name, rows in _read(scene).items()]
    return jnp.concatenate(parts)


def recorded(scene: Scene, vector: Array) -> Any:
    """The inverse of `record`: what ``draw`` takes, with zeros in the rows that it does not read."""
    fields: dict[str, Array | None] = dict.fromkeys(_FIELDS)
    start = 0
    for name, rows in _read(scene).items():
        shape = (3, 3) if name.endswith("xmat") else (3,)
        stop = start + len(rows) * int(np.prod(shape))
        values = jnp.concatenate([jnp.zeros((1, *shape)), vector[start:stop].reshape(-1, *shape)])
        place = np.zeros(rows[-1] + 1, np.int32)
        place[rows] = 1 + np.arange(len(rows))
        fields[name] = values[place]
        start = stop
    return SimpleNamespace(**fields)


def _read(scene: Scene) -> dict[str, np.ndarray]:
    """Field -> the rows of it that are read, each once and in order; fields without any are left out."""
    geoms = [row for group in scene.groups for row in group.geoms]
    sites = [row for group in scene.groups for row in group.sites]
    ends = [row for string in scene.strings for row in string.sites]
    lights = [light for light in scene.lights if light.body]
    rows = {
        "geom_xpos": geoms,
        "geom_xmat": geoms,
        "site_xpos": sites + ends,
        "site_xmat": sites,
        "cam_xpos": [scene.camera],
        "xpos": [light.body for light in lights if not light.tracks_com],
        "subtree_com": [light.body for light in lights if light.tracks_com],
    }
    return {name: np.unique(np.asarray(rows[name], np.int32)) for name in _FIELDS if rows[name]}
