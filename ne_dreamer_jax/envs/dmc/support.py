"""What of a model MJX simulates as MuJoCo does, and the refusal of the rest in the words of MJCF.

MJX itself refuses little. Most of what it lacks it passes over, as if the model did not ask for it. So the fields of
``mujoco.MjModel`` and ``mujoco.MjOption`` are classed here one by one: a field is simulated, or has no part in the
dynamics and sensors, or is refused where it has an effect. Whether MJX simulates a field was found by comparison with
MuJoCo 3.17, and is held by tests.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import numpy as np
from mujoco.mjx._src import collision_driver


def _words(text: str) -> list[str]:
    return text.split()


SIMULATED = _words("""
opt.timestep opt.impratio opt.tolerance opt.ls_tolerance opt.gravity opt.wind opt.magnetic opt.density opt.viscosity
opt.cone opt.jacobian opt.disableflags opt.iterations
opt.ls_iterations
nq nv nu na nbody njnt ngeom nsite ncam nmesh nhfield npair neq ntendon nwrap nsensor nsensordata nmocap nactuator nout
qpos0 qpos_spring flg_gravcomp ngravcomp
actuator_acc0 actuator_actadr actuator_actlimited actuator_actnum actuator_actrange actuator_biasprm
actuator_ctrllimited actuator_ctrlrange actuator_dynprm actuator_forcelimited actuator_forcerange actuator_gainprm
actuator_gear actuator_lengthrange actuator_trnid
body_dofadr body_dofnum body_geomadr body_geomnum body_gravcomp body_inertia body_invweight0 body_ipos body_iquat
body_jntadr body_jntnum body_mass body_mocapid body_parentid body_pos body_quat body_rootid body_subtreemass body_weldid
cam_bodyid cam_fovy cam_intrinsic cam_mat0 cam_mode cam_pos cam_pos0 cam_poscom0 cam_quat cam_resolution cam_sensorsize
cam_targetbodyid
dof_armature dof_bodyid dof_damping dof_frictionloss dof_invweight0 dof_jntid dof_parentid dof_solimp dof_solref
eq_active0 eq_data eq_obj1id eq_obj2id eq_objtype eq_solimp eq_solref nexclude exclude_signature
geom_bodyid geom_conaffinity geom_condim geom_contype geom_dataid geom_friction geom_margin geom_pos geom_priority
geom_quat geom_rbound geom_size geom_type geom_solimp geom_solmix geom_solref
hfield_adr hfield_data hfield_ncol hfield_nrow hfield_size nhfielddata
jnt_actfrclimited jnt_actfrcrange jnt_actgravcomp jnt_axis jnt_bodyid jnt_dofadr jnt_limited jnt_pos jnt_qposadr
jnt_range jnt_solimp jnt_solref jnt_stiffness jnt_type
mesh_graph mesh_graphadr mesh_vert mesh_vertadr mesh_vertnum nmeshvert nmeshgraph
pair_dim pair_friction pair_geom1 pair_geom2 pair_margin pair_signature pair_solimp pair_solref pair_solreffriction
sensor_adr sensor_datatype sensor_dim sensor_needstage sensor_objid sensor_refid
site_bodyid site_pos site_quat site_size
tendon_actfrclimited tendon_actfrcrange tendon_adr tendon_armature tendon_damping tendon_frictionloss tendon_invweight0
tendon_length0 tendon_lengthspring tendon_limited tendon_num tendon_range tendon_solimp_fri tendon_solimp_lim
tendon_solref_fri tendon_solref_lim tendon_stiffness wrap_objid wrap_prm wrap_type
""")
"""Fields that MJX simulates as MuJoCo does, apart from the values that `REFUSED` names.

MJX alone also obeys the numerics (``custom``) max_contact_points and max_geom_pairs, which a model has to ask for.
"""

NO_PART = _words("""
names name_* names_map nnames nnames_map paths npaths *_pathadr signature *_user nuser_* nuserdata vis stat
n?uffer nconmax njmax nemax narena
key_* nkey numeric_* nnumeric* text_* ntext* tuple_* ntuple*
light_* nlight mat_* nmat tex_* ntex* skin_* nskin* cam_ipd cam_output cam_projection *_group *_rgba geom_matid
site_matid
tendon_matid tendon_width site_dataid
nB nC nD nM nJfe nJfv nJmom nJten B_* D_* M_* mapD2M mapM2D mapM2M ten_J_* efm0_* efmC_* nefm*
ntree tree_body* tree_dof* body_treeid dof_treeid tendon_treeid tendon_treenum
*_sameframe body_simple dof_M0 dof_Madr dof_simplenum jnt_actuatorid tendon_actuatorid
actuator_ctrladr actuator_outadr actuator_outnum actuator_length0 actuator_cranklength
actuator_history actuator_historyadr sensor_history sensor_historyadr nhistory sensor_noise
body_bvh* body_conaffinity body_contype body_margin bvh_* nbvh* geom_aabb oct_* noct
opt.ccd_* opt.sdf_*
mesh_bvh* mesh_extrema mesh_face* mesh_normal* mesh_oct* mesh_poly* mesh_pos mesh_quat mesh_scale mesh_texcoord*
nmeshdegmax nmeshface nmeshnormal nmeshpoly* nmeshtexcoord npolygonmax geom_gap pair_gap
""")
"""Patterns of fields without a part in the dynamics and sensors that are not refused.

Names, drawing, what is left to the user, sizes of buffers, what MuJoCo has computed in advance for its own algorithms,
and what has a part only in what `REFUSED` names. MuJoCo ignores a sensor's noise; a gap adds contacts without a force.
"""

_DISABLE, _ENABLE, _SENSOR = mujoco.mjtDisableBit, mujoco.mjtEnableBit, mujoco.mjtSensor
_NO_FORCE = int(_ENABLE.mjENBL_ENERGY) | int(_ENABLE.mjENBL_FWDINV)
"""Flags of what MuJoCo computes beside the simulation. MJX refuses them."""


@dataclasses.dataclass(frozen=True)
class Refused:
    """Something that MJX lacks."""

    fields: str  # patterns of the fields of MjModel that ask for it, with a blank between them
    words: str  # what a user knows it by
    used: Callable[[mujoco.MjModel], Any]  # bool or, per element, bool [n]: where it has an effect
    element: str = ""  # what has it, as mjModel's accessors name them: "actuator", "geom", ...


class SimulatedOtherwise(UserWarning):
    """MJX simulates something of a model, but otherwise than MuJoCo does."""


def _off(model: mujoco.MjModel, *flags: Any) -> bool:
    return all(model.opt.disableflags & int(flag) for flag in flags)


def _type_is(field: str, *types: Any) -> Callable[[mujoco.MjModel], Any]:
    return lambda model: np.isin(getattr(model, field), [int(kind) for kind in types])


def _not_zero(field: str) -> Callable[[mujoco.MjModel], Any]:
    """Per element, whether any of its numbers is."""

    def used(model: mujoco.MjModel) -> Any:
        value = getattr(model, field)
        return (value != 0).any(axis=tuple(range(1, value.ndim)))

    return used


def _in_fluid(model: mujoco.MjModel) -> bool:
    return model.opt.density > 0 or model.opt.viscosity > 0


def _implicit(model: mujoco.MjModel) -> bool:
    return model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def _group_disabled(model: mujoco.MjModel) -> Any:
    return (model.opt.disableactuator >> np.clip(model.actuator_group, 0, 30)) & 1


def _muscle(model: mujoco.MjModel) -> Any:
    return (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE) | (
        model.actuator_biastype == mujoco.mjtBias.mjBIAS_MUSCLE
    )


def _clamped_damping(model: mujoco.MjModel) -> Any:
    of_gain = (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_AFFINE) & (model.actuator_gainprm[:, 2] != 0)
    of_bias = (model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE) & (model.actuator_biasprm[:, 2] != 0)
    return _implicit(model) & (model.actuator_forcelimited != 0) & (of_gain | of_bias)


def _passive_forces(model: mujoco.MjModel, springs: bool, dampers: bool) -> bool:
    """Whether the model has passive forces of these kinds, or of neither kind."""
    lifted = model.flg_gravcomp and not _off(model, _DISABLE.mjDSBL_GRAVITY)
    spring = model.jnt_stiffness.any() or model.tendon_stiffness.any()
    damper = model.dof_damping.any() or model.tendon_damping.any()
    return bool(lifted or _in_fluid(model) or (springs and spring) or (dampers and damper))


def _without_springs(model: mujoco.MjModel) -> bool:
    alone = _off(model, _DISABLE.mjDSBL_SPRING) and not _off(model, _DISABLE.mjDSBL_DAMPER)
    return alone and _passive_forces(model, springs=False, dampers=True)


def _without_dampers(model: mujoco.MjModel) -> bool:
    if not _off(model, _DISABLE.mjDSBL_DAMPER):
        return False
    euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER and not _off(model, _DISABLE.mjDSBL_EULERDAMP)
    alone = not _off(model, _DISABLE.mjDSBL_SPRING)
    return bool(alone and _passive_forces(model, springs=True, dampers=False)) or bool(
        euler and model.dof_damping.any()
    )


def _narrow(kind: str) -> Callable[[mujoco.MjModel], Any]:
    """Whether both limits act at once."""

    def used(model: mujoco.MjModel) -> Any:
        low, high = getattr(model, f"{kind}_range").T
        narrow = (getattr(model, f"{kind}_limited") != 0) & (high - low < 2 * getattr(model, f"{kind}_margin"))
        if kind == "jnt":
            narrow &= model.jnt_type != mujoco.mjtJoint.mjJNT_BALL
        return narrow & (not _off(model, _DISABLE.mjDSBL_LIMIT))

    return used


def _sensors(*kinds: str) -> Callable[[mujoco.MjModel], Any]:
    return _type_is("sensor_type", *(getattr(_SENSOR, f"mjSENS_{kind.upper()}") for kind in kinds))


def _contact_sensors_of_any(model: mujoco.MjModel) -> Any:
    """Those that ask for contacts by something else than geoms, for a net force, or for contacts in no order."""
    bodies = (int(mujoco.mjtObj.mjOBJ_BODY), int(mujoco.mjtObj.mjOBJ_XBODY), int(mujoco.mjtObj.mjOBJ_SITE))
    others = np.isin(model.sensor_objtype, bodies) | np.isin(model.sensor_reftype, bodies)
    data, reduce = model.sensor_intprm[:, 0], model.sensor_intprm[:, 1]
    found_alone = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)
    unordered = ((reduce == 0) & (data != found_alone)) | (reduce == 3)
    return _sensors("contact")(model) & (others | unordered)


def _touch_of_mesh(model: mujoco.MjModel) -> Any:
    touch = _sensors("touch")(model)
    used = np.zeros(model.nsensor, bool)
    used[touch] = model.site_type[model.sensor_objid[touch]] == mujoco.mjtGeom.mjGEOM_MESH
    return used


REFUSED = (
    # Options
    Refused("opt.noslip_*", "noslip iterations (option noslip_iterations)", lambda m: m.opt.noslip_iterations > 0),
    Refused("opt.disableactuator", "disabled groups (option actuatorgroupdisable)", _group_disabled, "actuator"),
    Refused(
        "opt.enableflags opt.o_*",
        "contacts' parameters for all (flag override)",
        lambda m: m.opt.enableflags & int(_ENABLE.mjENBL_OVERRIDE),
    ),
    Refused(
        "opt.enableflags opt.sleep_tolerance tree_sleep_policy dof_length",
        "sleeping bodies (flag sleep)",
        lambda m: m.opt.enableflags & int(_ENABLE.mjENBL_SLEEP),
    ),
    Refused(
        "opt.enableflags",
        "exact diagonals (flag diagexact)",
        lambda m: m.opt.enableflags & int(_ENABLE.mjENBL_DIAGEXACT),
    ),
    Refused("opt.disableflags", "springs disabled with other passive forces (flag spring)", _without_springs),
    Refused("opt.disableflags", "dampers disabled with other passive forces (flag damper)", _without_dampers),
    Refused("nplugin* plugin* *_plugin npluginattr npluginstate", "plugins", lambda m: m.nplugin > 0),
    Refused(
        "geom_fluid",
        "the ellipsoid model of fluids (geom fluidshape)",
        lambda m: _in_fluid(m) & (m.geom_fluid[:, 0] > 0),
        "geom",
    ),
    # Actuators
    Refused("actuator_delay", "delays (actuator delay)", lambda m: m.actuator_delay > 0, "actuator"),
    Refused(
        "actuator_damping actuator_dampingpoly",
        "damping (actuator damping)",
        lambda m: (m.actuator_damping != 0) | _not_zero("actuator_dampingpoly")(m),
        "actuator",
    ),
    Refused("actuator_armature", "armature (actuator armature)", _not_zero("actuator_armature"), "actuator"),
    Refused(
        "actuator_dyntype actuator_gaintype actuator_biastype",
        "dcmotors (dcmotor, general dyntype/gaintype/biastype dcmotor)",
        lambda m: (
            _type_is("actuator_dyntype", mujoco.mjtDyn.mjDYN_DCMOTOR)(m)
            | _type_is("actuator_gaintype", mujoco.mjtGain.mjGAIN_DCMOTOR)(m)
            | _type_is("actuator_biastype", mujoco.mjtBias.mjBIAS_DCMOTOR)(m)
        ),
        "actuator",
    ),
    Refused(
        "actuator_dyntype actuator_gaintype",
        "pid controllers (pid)",
        lambda m: (
            _type_is("actuator_dyntype", mujoco.mjtDyn.mjDYN_PID)(m)
            | _type_is("actuator_gaintype", mujoco.mjtGain.mjGAIN_PID)(m)
        ),
        "actuator",
    ),
    Refused(
        "actuator_dyntype actuator_gaintype actuator_biastype",
        "callbacks (general dyntype/gaintype/biastype user)",
        lambda m: (
            _type_is("actuator_dyntype", mujoco.mjtDyn.mjDYN_USER)(m)
            | _type_is("actuator_gaintype", mujoco.mjtGain.mjGAIN_USER)(m)
            | _type_is("actuator_biastype", mujoco.mjtBias.mjBIAS_USER)(m)
        ),
        "actuator",
    ),
    Refused(
        "actuator_trntype actuator_cranklength",
        "slider-cranks (actuator cranksite)",
        _type_is("actuator_trntype", mujoco.mjtTrn.mjTRN_SLIDERCRANK),
        "actuator",
    ),
    Refused(
        "actuator_trntype",
        "adhesion of bodies (adhesion, actuator body)",
        _type_is("actuator_trntype", mujoco.mjtTrn.mjTRN_BODY),
        "actuator",
    ),
    Refused(
        "actuator_ctrlnum actuator_ctrlspec actuator_trntype actuator_gaintype actuator_biastype",
        "several controls or forces of one actuator",
        lambda m: (
            (m.actuator_ctrlnum != 1)
            | (m.actuator_outnum != 1)
            | _type_is("actuator_trntype", mujoco.mjtTrn.mjTRN_SO3)(m)
        ),
        "actuator",
    ),
    Refused(
        "actuator_actearly",
        "early activation (actuator actearly)",
        lambda m: (m.actuator_actearly != 0) & (m.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE),
        "actuator",
    ),
    Refused(
        "opt.integrator",
        "muscles with the integrator implicitfast (muscle)",
        lambda m: _implicit(m) & _muscle(m),
        "actuator",
    ),
    Refused(
        "opt.integrator",
        "limited forces that depend on velocity with the integrator implicitfast (actuator forcerange)",
        _clamped_damping,
        "actuator",
    ),
    # Joints and tendons
    Refused("jnt_stiffnesspoly", "polynomial stiffness (joint stiffness)", _not_zero("jnt_stiffnesspoly"), "joint"),
    Refused(
        "dof_dampingpoly",
        "polynomial damping (joint damping)",
        lambda m: np.isin(np.arange(m.njnt), m.dof_jntid[_not_zero("dof_dampingpoly")(m)]),
        "joint",
    ),
    Refused(
        "tendon_stiffnesspoly", "polynomial stiffness (tendon stiffness)", _not_zero("tendon_stiffnesspoly"), "tendon"
    ),
    Refused("tendon_dampingpoly", "polynomial damping (tendon damping)", _not_zero("tendon_dampingpoly"), "tendon"),
    Refused("jnt_margin", "a margin of more than half the range (joint margin)", _narrow("jnt"), "joint"),
    Refused("tendon_margin", "a margin of more than half the range (tendon margin)", _narrow("tendon"), "tendon"),
    # Bodies and contacts
    Refused("flex_* flexedge_* flexvert_* nflex*", "flexible bodies (flex, flexcomp)", lambda m: m.nflex > 0),
    Refused(
        "eq_type",
        "constraints of flexible bodies or distances (equality flex, distance)",
        lambda m: m.eq_type > int(mujoco.mjtEq.mjEQ_TENDON),
        "equality",
    ),
    Refused(
        "geom_adhesion pair_adhesion flg_adhesion",
        "adhesive contacts (geom or pair adhesion)",
        lambda m: m.geom_adhesion.any() or m.pair_adhesion.any(),
    ),
    Refused(
        "geom_surfacevel flg_surfacevel", "moving surfaces (geom surfacevel)", _not_zero("geom_surfacevel"), "geom"
    ),
    # Sensors
    Refused("sensor_delay", "delays (sensor delay)", lambda m: m.sensor_delay > 0, "sensor"),
    Refused("sensor_interval", "intervals (sensor interval)", lambda m: m.sensor_interval[:, 0] > 0, "sensor"),
    Refused("sensor_type", "rangefinders (sensor rangefinder)", _sensors("rangefinder"), "sensor"),
    Refused("sensor_type", "tactile sensors (sensor tactile)", _sensors("tactile"), "sensor"),
    Refused(
        "sensor_type",
        "sensors of limits (sensor jointlimitpos and the like)",
        _sensors(
            *(f"{what}limit{which}" for what in ("joint", "tendon") for which in ("pos", "vel", "frc")),
        ),
        "sensor",
    ),
    Refused(
        "sensor_type",
        "distances of geoms (sensor distance, normal, fromto)",
        _sensors("geomdist", "geomnormal", "geomfromto"),
        "sensor",
    ),
    Refused("sensor_type", "sensors of what is inside a site (sensor insidesite)", _sensors("insidesite"), "sensor"),
    Refused(
        "sensor_type",
        "sensors of energy (sensor e_potential, e_kinetic)",
        _sensors("e_potential", "e_kinetic"),
        "sensor",
    ),
    Refused("sensor_type", "sensors of the user (sensor user)", _sensors("user"), "sensor"),
    Refused(
        "sensor_type sensor_intprm sensor_objtype sensor_reftype",
        "contacts of bodies or sites, unordered or summed (sensor contact; for geoms, with reduce mindist or maxforce)",
        _contact_sensors_of_any,
        "sensor",
    ),
    Refused(
        "sensor_cutoff",
        "cutoffs of accelerations (sensor framelinacc or frameangacc with cutoff)",
        lambda m: _sensors("framelinacc", "frameangacc")(m) & (m.sensor_cutoff > 0),
        "sensor",
    ),
    Refused(
        "site_type site_dataid",
        "touch in a mesh's volume (sensor touch of a site with a mesh)",
        _touch_of_mesh,
        "sensor",
    ),
)
"""What MJX passes over, or refuses in words of its own."""

CHOICES = (
    ("integrator", mujoco.mjtIntegrator, ("Euler", "RK4", "implicitfast")),
    ("solver", mujoco.mjtSolver, ("CG", "Newton")),
)
"""Options of which MJX knows some values: its field, the values, those that MJX knows."""

ALIKE = frozenset(
    {
        ("plane", "sphere"),
        ("plane", "capsule"),
        ("plane", "ellipsoid"),
        ("plane", "cylinder"),
        ("hfield", "sphere"),
        ("sphere", "sphere"),
        ("sphere", "capsule"),
        ("sphere", "box"),
        ("sphere", "mesh"),
        ("capsule", "capsule"),
    }
)
"""Kinds of geoms whose contacts MJX finds as MuJoCo does."""

_CONTACTS = """MJX finds contacts of these geoms otherwise than MuJoCo: {names} ({kinds}). Single bodies of 10 cm on \
such geoms were 1 mm to 8 cm off after 0.4 s, and 22 cm where one slid over a box's corner"""
_EQUALITIES = """MJX leaves out a term, the change of their directions, of connect and weld constraints: equality \
{names}. Two joined bodies that tumbled at about 0.3 rad/s were 0.1 mm off after 0.1 s"""


def fields() -> Iterator[str]:
    """The names of all fields of ``mujoco.MjModel`` and, after "opt.", of its ``MjOption``."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    for prefix, struct in (("", model), ("opt.", model.opt)):
        for name in dir(struct):
            if not name.startswith("_") and not callable(getattr(struct, name)) and name != "opt":
                yield prefix + name


def classes(field: str) -> set[str]:
    """What the tables say about a field, as ``fields`` names them: "simulated", "no part", "refused", or several.

    Empty if the field is in no table: nobody has looked at it yet.
    """
    choices = [f"opt.{name}" for name, _, _ in CHOICES]
    refused = [pattern for entry in REFUSED for pattern in entry.fields.split()]
    tables = {"simulated": SIMULATED + choices, "no part": NO_PART, "refused": refused}
    return {name for name, table in tables.items() if listed(field, table)}


def listed(field: str, patterns: Iterable[str]) -> bool:
    """Whether any of the patterns is of the field."""
    return any(fnmatchcase(field, pattern) for pattern in patterns)


def without_idle_flags(flags: int) -> int:
    """``opt.enableflags`` without those that only compute something beside the simulation, which MJX refuses."""
    return flags & ~_NO_FORCE


def can_touch(mj_model: mujoco.MjModel) -> bool:
    """Whether the model has geoms that collide with each other."""
    return not _off(mj_model, _DISABLE.mjDSBL_CONTACT) and any(True for _ in collision_driver.geom_pairs(mj_model))


def refuse_what_mjx_lacks(mj_model: mujoco.MjModel) -> None:
    """Refuses a model that asks for something that MJX lacks, or passes over in silence.

    Raises:
      ValueError: the message names it and, where they have names, the elements of the model that ask for it.
    """
    for option, kind, known in CHOICES:
        name = kind(getattr(mj_model.opt, option)).name.split("_", 1)[1]  # of mjSOL_PGS and the like
        if name.lower() not in [other.lower() for other in known]:
            raise ValueError(
                f"MJX can't simulate this model: expected its {option} to be {' or '.join(known)}, got {name}"
            )
    for entry in REFUSED:
        used = np.atleast_1d(entry.used(mj_model))
        if not used.any():
            continue
        where = ""
        if entry.element:
            names = _names(getattr(mj_model, entry.element), used.nonzero()[0])
            where = f" in {entry.element} {', '.join(names)}"
        raise ValueError(f"MJX can't simulate this model: it uses {entry.words}{where}, which MJX lacks")


def warn_of_differences(mj_model: mujoco.MjModel, stacklevel: int = 2) -> None:
    """Warns with `SimulatedOtherwise` of what MJX simulates, but otherwise than MuJoCo.

    That is contacts of geoms of kinds other than `ALIKE`, and equality constraints of the types connect and weld.

    Args:
      mj_model: isn't refused.
      stacklevel: of the caller to whom the warnings are given, as in ``warnings.warn``.
    """
    if _off(mj_model, _DISABLE.mjDSBL_CONSTRAINT):
        return
    if not _off(mj_model, _DISABLE.mjDSBL_CONTACT):
        geoms, kinds = set(), set()
        for one, other, _ in collision_driver.geom_pairs(mj_model):
            kind = tuple(mujoco.mjtGeom(mj_model.geom_type[i]).name.split("_")[1].lower() for i in (one, other))
            if kind not in ALIKE:
                geoms |= {int(one), int(other)}
                kinds.add(" with ".join(kind))
        if geoms:
            names = ", ".join(_names(mj_model.geom, sorted(geoms)))
            text = _CONTACTS.format(names=names, kinds=", ".join(sorted(kinds)))
            warnings.warn(text, SimulatedOtherwise, stacklevel=stacklevel + 1)
    turning = _type_is("eq_type", mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)(mj_model)
    if turning.any() and not _off(mj_model, _DISABLE.mjDSBL_EQUALITY):
        names = ", ".join(_names(mj_model.equality, turning.nonzero()[0]))
        warnings.warn(_EQUALITIES.format(names=names), SimulatedOtherwise, stacklevel=stacklevel + 1)


def _names(accessor: Callable[[int], Any], numbers: Iterable[int]) -> list[str]:
    return [accessor(int(number)).name or f"number {number}" for number in numbers]
