"""What a task's pictures are made of: the constants that ``build`` takes from an MjModel and ``draw`` closes over."""

from __future__ import annotations

import dataclasses
import enum
from typing import Any, NamedTuple

import numpy as np

from ne_dreamer_jax.render.rays import Array, Vec
from ne_dreamer_jax.render.texture import Checker

# Where the four samples of a pixel lie (x right, y down): the rotated grid of 4x multisampling. Their mean is the
# pixel's centre.
SAMPLES = ((0.375, 0.875), (0.875, 0.625), (0.125, 0.375), (0.625, 0.125))


class Kind(enum.Enum):
    """Shapes that share one intersection routine."""

    ROUND = "sphere or capsule"
    CYLINDER = "cylinder"
    ELLIPSOID = "ellipsoid"
    BOX = "box"
    PLANE = "plane"


@dataclasses.dataclass(frozen=True)
class Group:
    """Drawn objects of one kind: first geoms, then sites. n = len(geoms) + len(sites)."""

    kind: Kind
    geoms: np.ndarray  # int32, ids of geoms
    sites: np.ndarray  # int32, ids of sites
    size: np.ndarray  # float32 [n, 3], as in the model; what a shape doesn't use is zero
    size_mask: np.ndarray  # float32 [n, 3], 1 where the shape uses the number
    rgba: np.ndarray  # float32 [n, 4], the material's colour already applied


@dataclasses.dataclass(frozen=True)
class Light:
    """One light of the scene. Grey: ambient, diffuse and specular are single numbers."""

    ambient: float
    diffuse: float
    specular: float
    directional: bool
    casts_shadow: bool
    position: Vec  # of floats; relative to what it moves with
    direction: Vec  # of floats; unit, world frame
    side: Vec  # of floats; with ``up`` the axes of the shadow map, unit, orthogonal to ``direction``
    up: Vec
    body: int  # it moves with this body's position (or its subtree's centre of mass'); 0 stands still
    tracks_com: bool
    cutoff: float  # degrees, spot lights only
    exponent: float
    attenuation: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class String:
    """A tendon that hangs between two sites."""

    sites: tuple[int, int]
    radius: float
    length: float  # at which it is taut, metres
    segments: int  # straight pieces that it is drawn with
    up: tuple[float, float, float]  # unit, against gravity
    rgb: tuple[float, float, float]
    taut_rgb: tuple[float, float, float]  # the colour of an active constraint
    margin: float  # of the length limit
    impedance: tuple[float, ...]  # of the length limit: MuJoCo's five solimp numbers


class Headlight(NamedTuple):
    """The directional light that looks along the camera. Grey."""

    ambient: float
    diffuse: float
    specular: float


class FloorView(NamedTuple):
    """The floor as one camera sees it, without shadows and reflections. N pixels."""

    sample_distance: Array  # float32 [4, N], along the pixel's four rays; MISS beside the floor
    direction: Vec  # [N], the ray by which the floor is looked at: the pixel's centre, or the middle of what is seen
    distance: Array  # float32 [N], along it
    point: Vec  # [N], where it meets the floor
    headlight: Vec  # [N], colour in [0, 1] that the headlight gives it
    lights: tuple[Vec, ...]  # [N] each, that the scene's lights do


@dataclasses.dataclass(frozen=True)
class Floor:
    """The one plane that may be textured and reflective. It belongs to the world body and never moves."""

    center: Vec  # of floats, as all these
    x: Vec
    y: Vec
    normal: Vec
    size: tuple[float, float, float]  # half sides (0: infinite), and the spacing of the grid on which it is lit
    rgb: Vec
    specular: float
    shininess: float
    reflectance: float
    checker: Checker | None


@dataclasses.dataclass(frozen=True)
class Scene:
    """Everything about a task's pictures that no state changes.

    N = height * width pixels, 4 samples each. V views: the camera's, and its mirror image's in a floor that reflects.
    """

    height: int
    width: int
    camera: int
    right: Vec  # of floats; the camera's axes in the world frame, which no state changes
    up: Vec
    backwards: Vec
    center_rays: Vec  # float32 [V, N], world directions through the pixels' centres
    sample_rays: Vec  # float32 [V, 4, N], through their samples
    pixel_size: float  # of the image plane at distance 1
    sky: Vec  # float32 [N], in [0, 1]
    groups: tuple[Group, ...]
    strings: tuple[String, ...]
    specular: float  # of all drawn objects but the floor
    shininess: float  # the exponent
    headlight: Headlight
    lights: tuple[Light, ...]
    shadow_clip: float  # half width of a directional light's shadow map, metres
    shadow_scale: float  # of a spot light's cone, as a fraction of its cutoff
    floor: Floor | None
    floor_view: Any = None  # FloorView of numpy arrays where neither the camera nor a light ever moves
