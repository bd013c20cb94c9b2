"""From an MjModel to the constants that drawing needs. Runs on the host, once per task.

What is drawn is what MuJoCo's own renderer draws by default: geoms, sites and string tendons of groups 0 to 2. What
can't be drawn is refused here, by name.
"""

from __future__ import annotations

import dataclasses

import jax
import mujoco
import numpy as np

from ne_dreamer_jax.render import camera, floor, texture
from ne_dreamer_jax.render.rays import Vec
from ne_dreamer_jax.render.scene import SAMPLES, Floor, Group, Headlight, Kind, Light, Scene, String
from ne_dreamer_jax.system.compilation import computed_now

_DRAWN_GROUPS = 3  # groups 0, 1 and 2 are visible by default
_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)
_SPHERE, _CAPSULE = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_BOX, _PLANE = int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_PLANE)
_KINDS = {
    _SPHERE: Kind.ROUND,
    _CAPSULE: Kind.ROUND,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): Kind.CYLINDER,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): Kind.ELLIPSOID,
    _BOX: Kind.BOX,
    _PLANE: Kind.PLANE,
}
_SITE = int(mujoco.mjtWrap.mjWRAP_SITE)
_SIZES_USED = {_SPHERE: (1, 0, 0), _CAPSULE: (1, 1, 0)}  # of three, where not all
_NEAR, _FAR = 0.01, 20.0  # in extents of the model: MuJoCo's default, and the least in the Control Suite
_STRING_SEGMENTS = 8  # MuJoCo takes 28
_FIXED, _TRACK = int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED), int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK)
_TRACKCOM = int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)
_SPOT, _DIRECTIONAL = int(mujoco.mjtLightType.mjLIGHT_SPOT), int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)


def build(model: mujoco.MjModel, camera_id: int | str, height: int = 64, width: int = 64) -> Scene:
    """The constants of ``model`` seen through one of its cameras, for pictures of ``height`` by ``width`` pixels.

    Args:
      camera_id: the camera's id, or its name.

    Raises:
      ValueError: the model uses something that is not drawn (the message names it), or there is no such camera.
    """
    camera_id = _camera_id(model, camera_id)
    floor_id = _floor_id(model)
    _refuse_unsupported(model, camera_id, floor_id)
    axes = model.cam_mat0[camera_id].reshape(3, 3)
    tan = float(np.tan(np.deg2rad(model.cam_fovy[camera_id]) / 2))
    pixel_size = 2 * tan / height
    rows, columns = np.mgrid[0:height, 0:width]

    def rays(x: float, y: float) -> np.ndarray:
        right, up = (columns + x - width / 2) * pixel_size, (height / 2 - rows - y) * pixel_size
        return axes @ np.stack([right.ravel(), up.ravel(), -np.ones(height * width)])

    center = rays(0.5, 0.5)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ground = None if floor_id is None else _floor(model, data, floor_id)
    views = [np.eye(3)]
    if ground is not None and ground.reflectance > 0:
        normal = np.array([ground.normal.x, ground.normal.y, ground.normal.z])
        views.append(np.eye(3) - 2 * np.outer(normal, normal))
    center_rays = np.stack([view @ center for view in views], 1)
    sample_rays = np.stack([np.stack([view @ rays(x, y) for x, y in SAMPLES], 1) for view in views], 1)
    groups = _groups(model, floor_id)
    specular, shininess = _common_material(model, groups)
    scene = Scene(
        height=height,
        width=width,
        camera=camera_id,
        right=_floats(axes[:, 0]),
        up=_floats(axes[:, 1]),
        backwards=_floats(axes[:, 2]),
        center_rays=Vec(*center_rays.astype(np.float32)),
        sample_rays=Vec(*sample_rays.astype(np.float32)),
        pixel_size=pixel_size,
        sky=Vec(*texture.skybox(model, center, axes[:, 0] * pixel_size, -axes[:, 1] * pixel_size).astype(np.float32)),
        groups=groups,
        strings=tuple(_string(model, i) for i in _drawn_tendons(model)),
        specular=specular,
        shininess=shininess,
        headlight=_headlight(model),
        lights=tuple(_light(model, i) for i in range(model.nlight) if model.light_active[i]),
        shadow_clip=float(model.stat.extent * model.vis.map.shadowclip),
        shadow_scale=float(model.vis.map.shadowscale),
        floor=ground,
    )
    stands_still = model.cam_mode[camera_id] == _FIXED and not any(light.body for light in scene.lights)
    if scene.floor is None or not stands_still:
        return scene
    place = lambda: (camera.camera_position(scene, data), camera.place_lights(scene, data))
    view = computed_now(lambda: floor.view(scene, *place()))
    return dataclasses.replace(scene, floor_view=jax.tree.map(np.asarray, view))


def _camera_id(model: mujoco.MjModel, camera: int | str) -> int:
    names = [model.camera(i).name for i in range(model.ncam)]
    if not names:
        raise ValueError("expected a model with a camera, to be drawn through; got one without")
    if isinstance(camera, str) and camera in names:
        return names.index(camera)
    if isinstance(camera, str) or not 0 <= camera < model.ncam:
        raise ValueError(
            f"expected the name of a camera or an id from 0 to {model.ncam - 1}, got {camera!r}; the model has {names}"
        )
    return camera


def _floats(vector: np.ndarray) -> Vec:
    return Vec(float(vector[0]), float(vector[1]), float(vector[2]))


def _material(model: mujoco.MjModel, material: int, rgba: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Colour, specular and shininess exponent; a colour of the object's own beats its material's."""
    if material < 0:
        return rgba, 0.5, 64.0
    color = model.mat_rgba[material] if np.array_equal(rgba, _DEFAULT_RGBA) else rgba
    return color, float(model.mat_specular[material]), 128 * float(model.mat_shininess[material])


def _drawn(model: mujoco.MjModel, what: str) -> list[int]:
    """Ids of the geoms or sites (``what``) that are seen at all."""
    group, rgba, material = (getattr(model, f"{what}_{field}") for field in ("group", "rgba", "matid"))
    return [
        i for i in range(len(group)) if group[i] < _DRAWN_GROUPS and _material(model, material[i], rgba[i])[0][3] > 0
    ]


def _floor_id(model: mujoco.MjModel) -> int | None:
    """The first textured or reflective plane, or else the first plane."""
    planes = [i for i in _drawn(model, "geom") if model.geom_type[i] == _PLANE and _stands(model, model.geom_bodyid[i])]
    special = [i for i in planes if _is_special(model, int(model.geom_matid[i]))]
    return next(iter(special + planes), None)


def _stands(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body never moves."""
    return bool(model.body_weldid[body] == 0 and model.body_mocapid[body] < 0)


def _is_special(model: mujoco.MjModel, material: int) -> bool:
    return material >= 0 and (model.mat_reflectance[material] > 0 or bool((model.mat_texid[material] >= 0).any()))


def _groups(model: mujoco.MjModel, floor_id: int | None) -> tuple[Group, ...]:
    groups = []
    for kind in Kind:
        geoms = [i for i in _drawn(model, "geom") if _KINDS[int(model.geom_type[i])] is kind and i != floor_id]
        sites = [i for i in _drawn(model, "site") if _KINDS[int(model.site_type[i])] is kind]
        if not geoms and not sites:
            continue
        types = [int(model.geom_type[i]) for i in geoms] + [int(model.site_type[i]) for i in sites]
        mask = np.array([_SIZES_USED.get(t, (1, 1, 1)) for t in types], np.float32)
        colors = [_material(model, model.geom_matid[i], model.geom_rgba[i])[0] for i in geoms]
        colors += [_material(model, model.site_matid[i], model.site_rgba[i])[0] for i in sites]
        groups.append(
            Group(
                kind=kind,
                geoms=np.array(geoms, np.int32),
                sites=np.array(sites, np.int32),
                size=(np.concatenate([model.geom_size[geoms], model.site_size[sites]]) * mask).astype(np.float32),
                size_mask=mask,
                rgba=np.array(colors, np.float32),
            )
        )
    return tuple(groups)


def _common_material(model: mujoco.MjModel, groups: tuple[Group, ...]) -> tuple[float, float]:
    """Specular and shininess, which all objects but the floor share."""
    looks = {}
    for group in groups:
        for what, ids in (("geom", group.geoms), ("site", group.sites)):
            for i in ids:
                material, rgba = getattr(model, f"{what}_matid")[i], getattr(model, f"{what}_rgba")[i]
                looks[_material(model, material, rgba)[1:]] = f"{what} {getattr(model, what)(i).name!r}"
    if len(looks) > 1:
        (first, one), (second, other) = list(looks.items())[:2]
        raise ValueError(
            f"{one} and {other} can't be drawn together: expected one specular and shininess for all objects, "
            f"got {first} and {second}"
        )
    return next(iter(looks), (0.5, 64.0))


def _drawn_tendons(model: mujoco.MjModel) -> list[int]:
    """Ids of the tendons that are seen: those that run through space, not those that only couple joints."""
    return [
        i
        for i in range(model.ntendon)
        if model.tendon_group[i] < _DRAWN_GROUPS
        and model.wrap_type[model.tendon_adr[i]] != int(mujoco.mjtWrap.mjWRAP_JOINT)
        and _material(model, model.tendon_matid[i], model.tendon_rgba[i])[0][3] > 0
    ]


def _string(model: mujoco.MjModel, tendon: int) -> String:
    first, second = model.wrap_objid[model.tendon_adr[tendon] :][:2]
    gravity = np.linalg.norm(model.opt.gravity)
    up_x, up_y, up_z = -model.opt.gravity / gravity
    red, green, blue, _ = _material(model, model.tendon_matid[tendon], model.tendon_rgba[tendon])[0]
    taut_red, taut_green, taut_blue, _ = model.vis.rgba.constraint
    return String(
        sites=(int(first), int(second)),
        radius=float(model.tendon_width[tendon]),
        length=float(model.tendon_range[tendon][1]),
        segments=_STRING_SEGMENTS,
        up=(float(up_x), float(up_y), float(up_z)),
        rgb=(float(red), float(green), float(blue)),
        taut_rgb=(float(taut_red), float(taut_green), float(taut_blue)),
        margin=float(model.tendon_margin[tendon]),
        impedance=tuple(float(number) for number in model.tendon_solimp_lim[tendon]),
    )


def _floor(model: mujoco.MjModel, data: mujoco.MjData, floor_id: int) -> Floor:
    material = int(model.geom_matid[floor_id])
    rgba, specular, shininess = _material(model, material, model.geom_rgba[floor_id])
    x, y, normal = data.geom_xmat[floor_id].reshape(3, 3).T
    size = model.geom_size[floor_id]
    return Floor(
        center=_floats(data.geom_xpos[floor_id]),
        x=_floats(x),
        y=_floats(y),
        normal=_floats(normal),
        size=(float(size[0]), float(size[1]), float(size[2])),
        rgb=_floats(rgba),
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
    tracks_com = model.light_mode[i] == _TRACKCOM
    direction = model.light_dir0[i] / np.linalg.norm(model.light_dir0[i])
    # The shadow map's sides lie as MuJoCo lays them: across x, or across y for a light along x.
    side = np.cross(direction, (-1.0, 0.0, 0.0) if abs(direction[0]) < 0.9 else (0.0, 1.0, 0.0))
    side /= np.linalg.norm(side)
    constant, linear, quadratic = model.light_attenuation[i]
    return Light(
        ambient=float(model.light_ambient[i][0]),
        diffuse=float(model.light_diffuse[i][0]),
        specular=float(model.light_specular[i][0]),
        directional=model.light_type[i] == _DIRECTIONAL,
        casts_shadow=bool(model.light_castshadow[i]),
        position=_floats(model.light_poscom0[i] if tracks_com else model.light_pos0[i]),
        direction=_floats(direction),
        side=_floats(side),
        up=_floats(np.cross(direction, side)),
        body=int(model.light_bodyid[i]),
        tracks_com=bool(tracks_com),
        cutoff=float(model.light_cutoff[i]),
        exponent=float(model.light_exponent[i]),
        attenuation=(float(constant), float(linear), float(quadratic)),
    )


def _refuse_unsupported(model: mujoco.MjModel, camera_id: int, floor_id: int | None) -> None:
    """Raises ValueError that names the first thing in the model which can't be drawn."""

    def refuse(what: str, why: str) -> None:
        raise ValueError(f"{what} can't be drawn: {why}")

    def keeps_direction(mode: int, body: int) -> bool:
        return mode in (_TRACK, _TRACKCOM) or (mode == _FIXED and _stands(model, body))

    seen = f"camera {model.camera(camera_id).name!r}"
    if not keeps_direction(model.cam_mode[camera_id], model.cam_bodyid[camera_id]):
        refuse(seen, "it turns; only cameras fixed to the world, track and trackcom keep their direction")
    if model.cam_projection[camera_id] != int(mujoco.mjtProjection.mjPROJ_PERSPECTIVE):
        refuse(seen, "it is orthographic")
    if model.cam_sensorsize[camera_id].any():
        refuse(seen, "its view is set by sensor size and focal length; use fovy")
    near, far = model.vis.map.znear, model.vis.map.zfar
    if near > _NEAR or far < _FAR:
        refuse(
            "this view",
            f"MuJoCo cuts off what is nearer or farther than visual/map says, which is not done here; expected znear "
            f"of at most {_NEAR:g} and zfar of at least {_FAR:g}, got {near:g} and {far:g}",
        )
    if model.nskin:
        refuse("a skin", "skins are not supported")
    if model.nflex:
        refuse("a flex", "flexes are not supported")
    for what in ("geom", "site"):
        for i in _drawn(model, what):
            name = f"{what} {getattr(model, what)(i).name!r}"
            shape, material = int(getattr(model, f"{what}_type")[i]), int(getattr(model, f"{what}_matid")[i])
            if shape not in _KINDS:
                refuse(name, f"its type is {mujoco.mjtGeom(shape).name}; expected a primitive shape")
            if _material(model, material, getattr(model, f"{what}_rgba")[i])[0][3] < 1:
                refuse(name, "it is translucent; set its alpha to 1, or to 0 to hide it")
            if material >= 0 and model.mat_emission[material] > 0:
                refuse(name, "its material emits light")
            if _is_special(model, material) and not (what == "geom" and i == floor_id):
                reflects = shape in (_BOX, _PLANE) and model.mat_reflectance[material] > 0
                if reflects or (model.mat_texid[material] >= 0).any():
                    refuse(name, "it is textured or reflects; only one plane that stands still, the floor, may")
    for i in _drawn_tendons(model):
        path = model.wrap_type[model.tendon_adr[i] :][: model.tendon_num[i]]
        hangs = model.tendon_limited[i] and model.tendon_range[i][0] == 0 and model.tendon_stiffness[i] == 0
        if list(path) != [_SITE, _SITE] or not hangs or not np.any(model.opt.gravity):
            refuse(f"tendon {model.tendon(i).name!r}", "only strings (between two sites, limited from 0) are supported")
    for i in range(model.nlight):
        name = f"light {model.light(i).name!r}"
        if not model.light_active[i]:
            continue
        if any(np.ptp(getattr(model, f"light_{part}")[i]) for part in ("ambient", "diffuse", "specular")):
            refuse(name, "it is coloured; only grey light is supported")
        if model.light_type[i] not in (_SPOT, _DIRECTIONAL):
            refuse(name, f"its type is {mujoco.mjtLightType(model.light_type[i]).name}; expected spot or directional")
        if not keeps_direction(model.light_mode[i], model.light_bodyid[i]):
            refuse(name, "it turns; only lights fixed to the world, track and trackcom keep their direction")
    headlight = model.vis.headlight
    if headlight.active and any(np.ptp(part) for part in (headlight.ambient, headlight.diffuse, headlight.specular)):
        refuse("the headlight", "it is coloured; only grey light is supported")
