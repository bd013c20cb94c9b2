"""Rooms as boxes to bump into and faces to see."""

from __future__ import annotations

import numpy as np

Rectangle = tuple[float, float, float, float]  # x from, x to, y from, y to


def around(room: Rectangle) -> list[Rectangle]:
    """The four walls around a room's free space, as boxes."""
    x0, x1, y0, y1 = room
    t = 40.0  # thick enough for nobody to pass through
    return [
        (x0 - t, x0, y0 - t, y1 + t),
        (x1, x1 + t, y0 - t, y1 + t),
        (x0 - t, x1 + t, y0 - t, y0),
        (x0 - t, x1 + t, y1, y1 + t),
    ]


def inside(room: Rectangle) -> np.ndarray:
    """The faces that are seen from inside a room, float32 [4, 4]."""
    x0, x1, y0, y1 = room
    return np.array([(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)], np.float32)


def polygon(sides: int, apothem: float) -> tuple[np.ndarray, np.ndarray]:
    """A regular arena, a flat side towards +x: faces [sides, 4], and planes [sides, 3] of `movement.Solids`."""
    angles = 2 * np.pi * np.arange(sides) / sides
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    radius = apothem / np.cos(np.pi / sides)
    corners = radius * np.stack([np.cos(angles - np.pi / sides), np.sin(angles - np.pi / sides)], axis=1)
    ends = np.concatenate([corners, np.roll(corners, -1, axis=0)], axis=1)
    return ends.astype(np.float32), np.concatenate([normals, np.full((sides, 1), apothem)], axis=1).astype(np.float32)
