"""Where cameras and lights are in a given state. MJX's data holds cameras but no lights."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from ne_dreamer_jax.render.rays import Vec
from ne_dreamer_jax.render.scene import Light, Scene


class PlacedLight(NamedTuple):
    """A light and where it is in the world (scalars)."""

    light: Light
    position: Vec


def camera_position(scene: Scene, data: Any) -> Vec:
    """Where the scene's camera is (scalars, metres)."""
    return Vec.of(jnp.asarray(data.cam_xpos, jnp.float32)[scene.camera])


def place_lights(scene: Scene, data: Any) -> list[PlacedLight]:
    """The scene's lights, moved along with what they track."""
    placed = []
    for light in scene.lights:
        position = light.position
        if light.body:
            followed = data.subtree_com if light.tracks_com else data.xpos
            position = position + Vec.of(jnp.asarray(followed, jnp.float32)[light.body])
        placed.append(PlacedLight(light, position))
    return placed
