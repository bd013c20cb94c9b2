"""Textures: the sky as a constant picture, and the floor's checker.

Follows OpenGL as Mesa's software renderer does it: eight bits a value, mipmaps halved with a linear filter, trilinear
filtering.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np

from ne_dreamer_jax.render.rays import Array, Vec


@dataclasses.dataclass(frozen=True)
class Checker:
    """A texture of two colours (a checker, perhaps with a mark along its edges) that repeats over the floor."""

    side: int  # texels along a period
    low: Vec  # colours in [0, 1], Python floats
    high: Vec
    atlas: np.ndarray  # int32 [side * (side + side // 2)]: see ``_atlas``
    scale: tuple[float, float]  # periods a metre along the plane's x, and along its y
    offset: tuple[float, float]  # texture coordinates of the plane's centre; the second runs against y


def mipmaps(image: np.ndarray) -> list[np.ndarray]:
    """uint8 ``[h, w, c]`` and its halvings down to one texel, each sampled linearly at its texels' centres; float64.

    Values stay whole: a texture has eight bits at every level, and each halving, along y and then x, rounds to them.
    """
    levels = [np.asarray(image, np.float64)]
    while max(levels[-1].shape[:2]) > 1:
        level = levels[-1]
        for axis in (0, 1):
            old = level.shape[axis]
            new = max(1, old // 2)
            position = (np.arange(new) + 0.5) * old / new - 0.5
            low = np.floor(position).astype(int)
            fraction = np.expand_dims(position - low, tuple({0, 1, 2} - {axis}))
            below = np.take(level, np.clip(low, 0, old - 1), axis)
            above = np.take(level, np.clip(low + 1, 0, old - 1), axis)
            level = np.floor(below * (1 - fraction) + above * fraction + 0.5)
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
    texels = model.tex_data[model.tex_adr[sky] :][: model.tex_height[sky] * side * channels]
    faces = np.resize(texels, (6, side, side, channels))[..., :3]
    levels = [np.stack(level) for level in zip(*(mipmaps(face) for face in faces), strict=True)]
    face = _cube_face(rays)
    u, v = _cube_coordinates(rays, face)
    footprint = np.zeros_like(u)
    for step in (step_x, step_y):
        u_next, v_next = _cube_coordinates(rays + step[:, None], face)
        footprint = np.maximum(footprint, side * np.maximum(np.abs(u_next - u), np.abs(v_next - v)))
    detail = np.maximum(np.log2(footprint), 0) + _DETAIL_BIAS
    finer = np.minimum(np.floor(detail), len(levels) - 2)
    blend = np.clip(2 * (detail - finer) - 1, 0, 1)
    color = np.zeros_like(rays.T)
    for n, level in enumerate(levels):
        weight = np.where(finer == n, 1 - blend, 0) + np.where(finer + 1 == n, blend, 0)
        if weight.any():
            color += weight[:, None] * _bilinear(level, face, u, v)
    return color.T / 255


_DETAIL_BIAS = 0.25
"""Mesa blends two levels only in the upper half of the interval between them, and shifts that by a quarter."""


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
      ValueError: the texture is not a flat, square one of two colours.
    """
    texture = -1 if material < 0 else int(model.mat_texid[material][int(mujoco.mjtTextureRole.mjTEXROLE_RGB)])
    if texture < 0:
        return None
    name = f"texture {model.tex(texture).name!r} of the floor"
    side, channels = int(model.tex_width[texture]), int(model.tex_nchannel[texture])
    if model.tex_type[texture] != int(mujoco.mjtTexture.mjTEXTURE_2D) or model.tex_height[texture] != side:
        raise ValueError(f"{name} can't be drawn: expected a square 2d texture")
    image = model.tex_data[model.tex_adr[texture] :][: side * side * channels].reshape(side, side, channels)[..., :3]
    colors = np.unique(image.reshape(-1, 3), axis=0)
    if len(colors) != 2:
        raise ValueError(f"{name} can't be drawn: expected two colours (a checker), got {len(colors)}")
    low, high = colors.astype(np.float64)
    repeat = np.asarray(model.mat_texrepeat[material], np.float64)
    if not model.mat_texuniform[material]:
        repeat = repeat / np.where(size[:2] > 0, size[:2], 1)
    return Checker(
        side=side,
        low=Vec(*(low / 255).tolist()),
        high=Vec(*(high / 255).tolist()),
        atlas=_atlas([((level - low) @ (high - low)) / ((high - low) @ (high - low)) for level in mipmaps(image)]),
        scale=(float(repeat[0] / 2), float(repeat[1] / 2)),
        offset=(float(repeat[0] * size[0] / 2), float(repeat[1] * size[1] / 2)),
    )


def _atlas(levels: list[np.ndarray]) -> np.ndarray:
    """All mipmaps in one table: the finest at its left, the others below each other at its right.

    A level of side s begins at row ``side - 2 * s`` there. Each entry packs four texels of eight bits: the one at its
    place, its right and lower neighbours (around the edge) and the one between these. A bilinear lookup reads one.
    """
    side = len(levels[0])
    atlas = np.zeros((side, side + side // 2), np.int64)
    for n, level in enumerate(levels):
        texels = np.round(np.clip(level, 0, 1) * 255).astype(np.int64)
        right, below = np.roll(texels, -1, 1), np.roll(texels, -1, 0)
        packed = texels | right << 8 | below << 16 | np.roll(right, -1, 0) << 24
        row, column = (0, 0) if n == 0 else (side - 2 * len(level), side)
        atlas[row : row + len(level), column : column + len(level)] = packed
    return atlas.astype(np.uint32).view(np.int32).ravel()


def look_up(texture: Checker, u: Array, v: Array, footprint: Array) -> Vec:
    """The texture's colour at coordinates ``u``, ``v`` (in periods), filtered over ``footprint`` finest texels."""
    side, top = texture.side, texture.side.bit_length() - 1
    detail = jnp.maximum(jnp.log2(jnp.maximum(footprint, 1e-6)), 0.0) + _DETAIL_BIAS
    finer = jnp.clip(jnp.floor(detail), 0, top - 1)
    blend = jnp.clip(2 * (detail - finer) - 1, 0.0, 1.0)
    u, v = u - jnp.floor(u), v - jnp.floor(v)
    atlas = jnp.asarray(texture.atlas)

    def sample(level: Array) -> Array:
        size = jnp.right_shift(jnp.int32(side), level)
        length = size.astype(jnp.float32)
        x, y = u * length - 0.5, v * length - 0.5
        column, row = jnp.floor(x), jnp.floor(y)
        fx, fy = x - column, y - row
        column = jnp.where(column < 0, column + length, column).astype(jnp.int32)
        row = jnp.where(row < 0, row + length, row).astype(jnp.int32)
        start = jnp.where(level == 0, 0, (side - 2 * size) * (side + side // 2) + side)
        packed = atlas.at[start + row * (side + side // 2) + column].get(mode="promise_in_bounds")
        here, right, below, across = (((packed >> bits) & 255).astype(jnp.float32) for bits in (0, 8, 16, 24))
        upper, lower = here + (right - here) * fx, below + (across - below) * fx
        return upper + (lower - upper) * fy

    fine = finer.astype(jnp.int32)
    level = sample(fine)
    level = (level + (sample(fine + 1) - level) * blend) * (1 / 255)
    low, high = texture.low, texture.high
    return Vec(low.x + level * (high.x - low.x), low.y + level * (high.y - low.y), low.z + level * (high.z - low.z))
