"""From an MjModel to the constants that drawing needs. Runs on the host, once per task.

What is drawn is what MuJoCo's own renderer draws by default: geoms, sites and string tendons of groups 0 to 2. What
can't be drawn is refused here, by name.
"""

from __future__ import annotations

import dataclasses
import enum
from typing import Any

import mujoco
import numpy as np

from ne_dreamer_jax.render import texture

_DRAWN_GROUPS = 3  # groups 0, 1 and 2 are visible by default
# Where the four samples of a pixel lie (x right, y down), as in the usual rotated grid of 4x multisampling.
SAMPLES = ((0.375, 0.875), (0.875, 0.625), (0.125, 0.375), (0.625, 0.125))
_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)


class Kind(enum.Enum):
    """Shapes that share one intersection routine."""

    ROUND = "sphere or capsule"
    CYLINDER = "cylinder"
    ELLIPSOID = "ellipsoid"
    BOX = "box"
    PLANE = "plane"


_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): Kind.ROUND,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): Kind.ROUND,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): Kind.CYLINDER,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): Kind.ELLIPSOID,
    int(mujoco.mjtGeom.mjGEOM_BOX): Kind.BOX,
    int(mujoco.mjtGeom.mjGEOM_PLANE): Kind.PLANE,
}


@dataclasses.dataclass(frozen=True)
class Group:
    """Drawn objects of one kind: first geoms, then sites. n = len(geoms) + len(sites)."""

    kind: Kind
    geoms: np.ndarray  # int32, ids of geoms
    sites: np.ndarray  # int32, ids of sites
    size: np.ndarray  # float32 [n, 3], as in the model; what a shape doesn't use is zero
    size_mask: np.ndarray  # float32 [n, 3], 1 where the shape uses the number
    rgba: np.ndarray  # float32 [n, 4], the material's colour already applied
    specular: np.ndarray  # float32 [n]
    shininess: np.ndarray  # float32 [n], the exponent


@dataclasses.dataclass(frozen=True)
class Light:
    """One light of the scene. Grey: ambient, diffuse and specular are single numbers."""

    ambient: float
    diffuse: float
    specular: float
    directional: bool
    casts_shadow: bool
    position: np.ndarray  # float32 [3]; in the frame that ``body`` and ``tracks_com`` name
    direction: np.ndarray  # float32 [3], unit, world frame
    body: int  # the light moves with this body's (or its subtree's centre of mass') position; 0 stands still
    tracks_com: bool
    cutoff: float  # degrees, spot lights only
    exponent: float
    attenuation: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Headlight:
    """The directional light that looks along the camera. Grey."""

    ambient: float
    diffuse: float
    specular: float


@dataclasses.dataclass(frozen=True)
class Floor:
    """The one plane that may be textured and reflective. It belongs to the world body and never moves."""

    center: np.ndarray  # float32 [3]
    axes: np.ndarray  # float32 [3, 3], columns are the plane's x, y and normal
    size: np.ndarray  # float32 [3], half sides (0: infinite) and spacing of the grid on which it is lit
    rgb: np.ndarray  # float32 [3]
    specular: float
    shininess: float
    reflectance: float
    checker: texture.Checker | None


@dataclasses.dataclass(frozen=True)
class Scene:
    """Everything about a task's pictures that no state changes. N = height * width pixels, 4 samples each."""

    height: int
    width: int
    camera: int
    camera_axes: np.ndarray  # float32 [3, 3], columns are right, up and backwards; constant by construction
    center_rays: np.ndarray  # float32 [3, N], world directions through the pixels' centres
    sample_rays: np.ndarray  # float32 [3, 4, N], through their samples
    pixel_size: float  # of the image plane at distance 1
    sky: np.ndarray  # float32 [3, N], in [0, 1]
    groups: tuple[Group, ...]
    floor: Floor | None
    headlight: Headlight
    lights: tuple[Light, ...]
    shadow_clip: float  # half width of a directional light's shadow map, metres
    shadow_scale: float  # of a spot light's cone, as a fraction of its cutoff


def build(model: mujoco.MjModel, camera_id: int, height: int = 64, width: int = 64) -> Scene:
    """The constants of ``model`` seen through one of its cameras, for pictures of ``height`` by ``width`` pixels.

    Raises:
      ValueError: the model uses something that is not drawn (the message names it), or there is no such camera.
    """
    if not 0 <= camera_id < model.ncam:
        names = [model.camera(i).name for i in range(model.ncam)]
        raise ValueError(f"expected a camera id from 0 to {model.ncam - 1}, got {camera_id}; the model has {names}")
    _refuse_unsupported(model, camera_id)
    axes = model.cam_mat0[camera_id].reshape(3, 3)
    tan = float(np.tan(np.deg2rad(model.cam_fovy[camera_id]) / 2))
    rows, columns = np.mgrid[0:height, 0:width]

    def rays(x: float, y: float) -> np.ndarray:
        right, up = (2 * (columns + x) - width) / height * tan, (1 - 2 * (rows + y) / height) * tan
        return axes @ np.stack([right.ravel(), up.ravel(), -np.ones(height * width)])

    floor_id = _floor_id(model)
    center = rays(0.5, 0.5)
    pixel_size = 2 * tan / height
    return Scene(
        height=height,
        width=width,
        camera=camera_id,
        camera_axes=axes.astype(np.float32),
        center_rays=center.astype(np.float32),
        sample_rays=np.stack([rays(x, y) for x, y in SAMPLES], 1).astype(np.float32),
        pixel_size=pixel_size,
        sky=texture.skybox(model, center, axes[:, 0] * pixel_size, -axes[:, 1] * pixel_size).astype(np.float32),
        groups=_groups(model, floor_id),
        floor=None if floor_id is None else _floor(model, floor_id),
        headlight=_headlight(model),
        lights=tuple(_light(model, i) for i in range(model.nlight) if model.light_active[i]),
        shadow_clip=float(model.stat.extent * model.vis.map.shadowclip),
        shadow_scale=float(model.vis.map.shadowscale),
    )


def _material(model: mujoco.MjModel, material: int, rgba: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Colour, specular and shininess exponent; a colour of the object's own beats its material's."""
    if material < 0:
        return rgba, 0.5, 64.0
    own = not np.array_equal(rgba, _DEFAULT_RGBA)
    color = rgba if own else model.mat_rgba[material]
    return color, float(model.mat_specular[material]), 128 * float(model.mat_shininess[material])


def _drawn(group: np.ndarray, rgba: np.ndarray, material: np.ndarray, model: mujoco.MjModel) -> np.ndarray:
    """Ids of the geoms or sites that are seen at all."""
    alpha = [_material(model, m, color)[0][3] for m, color in zip(material, rgba, strict=True)]
    return np.flatnonzero((group < _DRAWN_GROUPS) & (np.array(alpha) > 0))


def _floor_id(model: mujoco.MjModel) -> int | None:
    """The first reflective or textured plane, or the first plane at all."""
    drawn = _drawn(model.geom_group, model.geom_rgba, model.geom_matid, model)
    planes = [int(i) for i in drawn if model.geom_type[i] == int(mujoco.mjtGeom.mjGEOM_PLANE)]
    special = [i for i in planes if model.geom_matid[i] >= 0 and _is_special(model, model.geom_matid[i])]
    return next(iter(special + planes), None)


def _is_special(model: mujoco.MjModel, material: int) -> bool:
    return model.mat_reflectance[material] > 0 or (model.mat_texid[material] >= 0).any()


def _groups(model: mujoco.MjModel, floor_id: int | None) -> tuple[Group, ...]:
    geoms = _drawn(model.geom_group, model.geom_rgba, model.geom_matid, model)
    sites = _drawn(model.site_group, model.site_rgba, model.site_matid, model)
    groups = []
    for kind in Kind:
        mine = np.array([i for i in geoms if _KINDS[int(model.geom_type[i])] is kind and i != floor_id], np.int32)
        marks = np.array([i for i in sites if _KINDS[int(model.site_type[i])] is kind], np.int32)
        if mine.size + marks.size == 0:
            continue
        looks = [_material(model, model.geom_matid[i], model.geom_rgba[i]) for i in mine]
        looks += [_material(model, model.site_matid[i], model.site_rgba[i]) for i in marks]
        types = [int(model.geom_type[i]) for i in mine] + [int(model.site_type[i]) for i in marks]
        mask = np.array([_SIZES_USED.get(t, (1, 1, 1)) for t in types], np.float32)
        groups.append(
            Group(
                kind=kind,
                geoms=mine,
                sites=marks,
                size=(np.concatenate([model.geom_size[mine], model.site_size[marks]]) * mask).astype(np.float32),
                size_mask=mask,
                rgba=np.array([look[0] for look in looks], np.float32),
                specular=np.array([look[1] for look in looks], np.float32),
                shininess=np.array([look[2] for look in looks], np.float32),
            )
        )
    return tuple(groups)


_SIZES_USED = {int(mujoco.mjtGeom.mjGEOM_SPHERE): (1, 0, 0), int(mujoco.mjtGeom.mjGEOM_CAPSULE): (1, 1, 0)}


def _floor(model: mujoco.MjModel, floor_id: int) -> Floor:
    material = int(model.geom_matid[floor_id])
    rgba, specular, shininess = _material(model, material, model.geom_rgba[floor_id])
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.geom_quat[floor_id])
    size = model.geom_size[floor_id]
    return Floor(
        center=model.geom_pos[floor_id].astype(np.float32),
        axes=axes.reshape(3, 3).astype(np.float32),
        size=size.astype(np.float32),
        rgb=np.asarray(rgba[:3], np.float32),
        specular=specular,
        shininess=shininess,
        reflectance=float(model.mat_reflectance[material]) if material >= 0 else 0.0,
        checker=texture.checker(model, material, size),
    )


def _headlight(model: mujoco.MjModel) -> Headlight:
    light = model.vis.headlight
    on = float(light.active)
    return Headlight(on * float(light.ambient[0]), on * float(light.diffuse[0]), on * float(light.specular[0]))


def _light(model: mujoco.MjModel, i: int) -> Light:
    body = int(model.light_bodyid[i])
    tracks_com = model.light_mode[i] == int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)
    position = model.light_poscom0[i] if tracks_com else model.light_pos0[i]
    return Light(
        ambient=float(model.light_ambient[i][0]),
        diffuse=float(model.light_diffuse[i][0]),
        specular=float(model.light_specular[i][0]),
        directional=model.light_type[i] == int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL),
        casts_shadow=bool(model.light_castshadow[i]),
        position=position.astype(np.float32),
        direction=(model.light_dir0[i] / np.linalg.norm(model.light_dir0[i])).astype(np.float32),
        body=body,
        tracks_com=bool(tracks_com),
        cutoff=float(model.light_cutoff[i]),
        exponent=float(model.light_exponent[i]),
        attenuation=(
            float(model.light_attenuation[i][0]),
            float(model.light_attenuation[i][1]),
            float(model.light_attenuation[i][2]),
        ),
    )


def _refuse_unsupported(model: mujoco.MjModel, camera_id: int) -> None:
    """Raises ValueError that names the first thing in the model which can't be drawn."""

    def refuse(what: str, why: str) -> None:
        raise ValueError(f"{what} can't be drawn: {why}")

    tracking = (int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK), int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM))
    camera = f"camera {model.camera(camera_id).name!r}"
    mode, body = model.cam_mode[camera_id], model.cam_bodyid[camera_id]
    if mode not in tracking and not (mode == int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED) and model.body_weldid[body] == 0):
        refuse(camera, "its orientation changes; only cameras fixed to the world, track and trackcom keep theirs")
    if model.cam_projection[camera_id] != int(mujoco.mjtProjection.mjPROJ_PERSPECTIVE):
        refuse(camera, "it is orthographic")
    if model.cam_sensorsize[camera_id].any():
        refuse(camera, "its view is set by sensor size and focal length; use fovy")
    if model.nskin:
        refuse(f"skin {model.skin(0).name!r}", "skins are not supported")
    if model.nflex:
        refuse(f"flex {model.flex(0).name!r}", "flexes are not supported")
    for kind, named, count in (("geom", model.geom, model.ngeom), ("site", model.site, model.nsite)):
        types, rgba, material = (getattr(model, f"{kind}_{field}") for field in ("type", "rgba", "matid"))
        drawn: Any = _drawn(getattr(model, f"{kind}_group"), rgba, material, model) if count else []
        for i in drawn:
            name = f"{kind} {named(i).name!r}"
            if int(types[i]) not in _KINDS:
                refuse(name, f"its type is {mujoco.mjtGeom(types[i]).name}; expected a primitive shape")
            if _material(model, material[i], rgba[i])[0][3] < 1:
                refuse(name, "it is translucent; set its alpha to 1, or to 0 to hide it")
            if material[i] >= 0:
                if model.mat_emission[material[i]] > 0:
                    refuse(name, "its material emits light")
                if (model.mat_texid[material[i]] >= 0).any() and types[i] != int(mujoco.mjtGeom.mjGEOM_PLANE):
                    refuse(name, "it is textured; only the floor may be")
                if model.mat_reflectance[material[i]] > 0 and types[i] == int(mujoco.mjtGeom.mjGEOM_BOX):
                    refuse(name, "it is a reflective box; only the floor may reflect")
    for i in range(model.nlight):
        name = f"light {model.light(i).name!r}"
        if not model.light_active[i]:
            continue
        if any(np.ptp(getattr(model, f"light_{part}")[i]) for part in ("ambient", "diffuse", "specular")):
            refuse(name, "it is coloured; only grey light is supported")
        if model.light_type[i] not in (
            int(mujoco.mjtLightType.mjLIGHT_SPOT),
            int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL),
        ):
            refuse(name, f"its type is {mujoco.mjtLightType(model.light_type[i]).name}; expected spot or directional")
        mode, body = model.light_mode[i], model.light_bodyid[i]
        if mode not in tracking and not (
            mode == int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED) and model.body_weldid[body] == 0
        ):
            refuse(name, "its direction changes; only lights fixed to the world, track and trackcom keep theirs")
    headlight = model.vis.headlight
    if headlight.active and any(np.ptp(part) for part in (headlight.ambient, headlight.diffuse, headlight.specular)):
        refuse("the headlight", "it is coloured; only grey light is supported")
