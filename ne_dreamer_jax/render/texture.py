"""Textures: the sky as a constant picture, and the floor's checker.

Follows OpenGL: mipmaps halved with a linear filter, and trilinear filtering between them.
"""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np


@dataclasses.dataclass(frozen=True)
class Checker:
    """A two-colour checker texture laid on the floor: 2x2 squares a period, perhaps with an edge mark."""

    texels: int  # a period's side
    colors: np.ndarray  # float32 [2, 3], where ``pattern`` is 0 and 1
    pattern: np.ndarray  # float32 [texels, texels], 0 or 1
    scale: np.ndarray  # float32 [2], periods a metre along the plane's x and minus y
    offset: np.ndarray  # float32 [2], texture coordinates of the plane's centre


def mipmaps(image: np.ndarray) -> list[np.ndarray]:
    """Float64 ``[h, w, c]`` and its halvings down to one texel, each sampled linearly at its texels' centres."""
    levels = [np.asarray(image, np.float64)]
    while max(levels[-1].shape[:2]) > 1:
        level = levels[-1]
        for axis in (0, 1):
            old = level.shape[axis]
            new = max(1, old // 2)
            position = (np.arange(new) + 0.5) * old / new - 0.5
            low = np.floor(position).astype(int)
            shape = [1, 1, 1]
            shape[axis] = new
            fraction = (position - low).reshape(shape)
            below = np.take(level, np.clip(low, 0, old - 1), axis)
            above = np.take(level, np.clip(low + 1, 0, old - 1), axis)
            level = below * (1 - fraction) + above * fraction
        levels.append(level)
    return levels


def skybox(model: mujoco.MjModel, rays: np.ndarray, step_x: np.ndarray, step_y: np.ndarray) -> np.ndarray:
    """The sky in the directions ``rays`` [3, N]: colours in [0, 1], float64 [3, N]; black if the model has none.

    ``step_x`` and ``step_y`` [3] lead from a ray to its neighbours' in the picture. MuJoCo's skybox is a cube map,
    turned by 90 degrees about x.
    """
    skies = np.flatnonzero(model.tex_type == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX))
    if not skies.size:
        return np.zeros_like(rays)
    sky = skies[0]
    side, channels = int(model.tex_width[sky]), int(model.tex_nchannel[sky])
    faces = model.tex_data[model.tex_adr[sky] :][: model.tex_height[sky] * side * channels]
    faces = np.resize(faces, (6, side, side, channels))[..., :3] / 255
    levels = [np.stack(level) for level in zip(*(mipmaps(face) for face in faces), strict=True)]
    face = _cube_face(rays)
    u, v = _cube_coordinates(rays, face)
    steps = [_cube_coordinates(rays + step[:, None], face) for step in (step_x, step_y)]
    footprint = side * np.max(
        [np.abs(after - before) for s in steps for after, before in zip(s, (u, v), strict=True)], 0
    )
    lod, blend = level_of_detail(footprint, len(levels))
    color = np.zeros_like(rays.T)
    for n, level in enumerate(levels):
        weight = np.where(lod == n, 1 - blend, 0) + np.where(lod + 1 == n, blend, 0)
        color += weight[:, None] * _bilinear(level, face, u, v)
    return color.T


def level_of_detail(footprint: np.ndarray, num_levels: int) -> tuple[np.ndarray, np.ndarray]:
    """The finer of two mipmap levels and the weight of the coarser, for a footprint in texels of level 0.

    Mesa's software renderer places the blend between two levels in the upper half of the interval.
    """
    lod = np.maximum(np.log2(np.maximum(footprint, 1e-9)), 0) + 0.25
    level = np.minimum(np.floor(lod), num_levels - 1)
    blend = np.where(level < num_levels - 1, np.maximum(0, 2 * (lod - level) - 1), 0)
    return level.astype(int), blend


def _cube_face(rays: np.ndarray) -> np.ndarray:
    s, t, r = rays[0], rays[2], -rays[1]
    major = np.argmax(np.abs(np.stack([s, t, r])), 0)
    return 2 * major + (np.choose(major, [s, t, r]) <= 0)


def _cube_coordinates(rays: np.ndarray, face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates in [0, 1] on the given faces, as the OpenGL specification lays cube maps out."""
    s, t, r = rays[0], rays[2], -rays[1]
    across = np.choose(face, [-r, r, s, s, s, -s])
    down = np.choose(face, [-t, -t, r, -r, -t, -t])
    major = np.abs(np.choose(face, [s, s, t, t, r, r]))
    return (across / major + 1) / 2, (down / major + 1) / 2


def _bilinear(faces: np.ndarray, face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    side = faces.shape[1]
    x, y = u * side - 0.5, v * side - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]

    def texel(row: np.ndarray, column: np.ndarray) -> np.ndarray:
        return faces[face, np.clip(row, 0, side - 1), np.clip(column, 0, side - 1)]

    upper = texel(y0, x0) * (1 - fx) + texel(y0, x0 + 1) * fx
    lower = texel(y0 + 1, x0) * (1 - fx) + texel(y0 + 1, x0 + 1) * fx
    return upper * (1 - fy) + lower * fy


def checker(model: mujoco.MjModel, material: int, size: np.ndarray) -> Checker | None:
    """The texture of a plane of half sides ``size`` [3] with this material; None where it has none.

    Raises:
      ValueError: the texture is not a flat one of exactly two colours.
    """
    if material < 0:
        return None
    texture = int(model.mat_texid[material][int(mujoco.mjtTextureRole.mjTEXROLE_RGB)])
    if texture < 0:
        return None
    name = f"texture {model.tex(texture).name!r} of the floor"
    if (
        model.tex_type[texture] != int(mujoco.mjtTexture.mjTEXTURE_2D)
        or model.tex_width[texture] != model.tex_height[texture]
    ):
        raise ValueError(f"{name} can't be drawn: expected a square 2d texture")
    side, channels = int(model.tex_width[texture]), int(model.tex_nchannel[texture])
    image = model.tex_data[model.tex_adr[texture] :][: side * side * channels].reshape(side, side, channels)[..., :3]
    colors = np.unique(image.reshape(-1, 3), axis=0)
    if len(colors) != 2:
        raise ValueError(f"{name} can't be drawn: expected a checker of two colours, got {len(colors)} colours")
    repeat = np.asarray(model.mat_texrepeat[material], np.float64)
    if not model.mat_texuniform[material]:
        repeat = repeat / size[:2]
    return Checker(
        texels=side,
        colors=(colors / 255).astype(np.float32),
        pattern=(image == colors[1]).all(-1).astype(np.float32),
        scale=(repeat / 2).astype(np.float32),
        offset=(repeat * size[:2] / 2).astype(np.float32),
    )
