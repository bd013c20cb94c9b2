"""What MJX lacks is refused by name, what it does otherwise is warned of, and the rest is as C MuJoCo has it."""

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ne_dreamer_jax.envs import dmc
from ne_dreamer_jax.envs.dmc import names as dmc_names
from ne_dreamer_jax.envs.dmc import support
from ne_dreamer_jax.envs.dmc.simulation import start_of
from tests.marks import slow_but

pytestmark = pytest.mark.usefixtures("quick_compilation")

PENDULUM = """
<mujoco>
  <compiler autolimits="true"/>
  <option timestep="0.005" {option}>{flags}</option>{assets}
  <worldbody>
    <body name="upper" pos="0 0 1" {body}>
      <joint name="shoulder" axis="0 1 0" {joint}/>
      <geom name="arm" type="capsule" size="0.04" fromto="0 0 0 0 0 -0.4" {geom}/>
      <body name="lower" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" {elbow}/>
        <geom name="forearm" type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3"/>
        <site name="hand" pos="0 0 -0.3" {site}/>
      </body>
    </body>
    <site name="wall" pos="0.4 0 0.9"/>{world}
  </worldbody>
  <tendon>
    <fixed name="cord" {tendon}><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-0.5"/></fixed>
  </tendon>
  {rest}
  <actuator>{actuators}</actuator>
  <sensor><jointpos joint="shoulder"/><jointvel joint="elbow"/>{sensors}</sensor>
</mujoco>"""

PARTS = ("option", "flags", "assets", "body", "joint", "geom", "elbow", "site", "world", "tendon", "rest", "sensors")
MOTOR = '<motor name="motor" joint="shoulder" ctrlrange="-2 2"/>'


def motor(attributes, element="motor"):
    return {"actuators": f'<{element} name="motor" ctrlrange="-2 2" {attributes}/>'}


def general(attributes):
    return motor(f'joint="shoulder" {attributes}', "general")


def sensor(text):
    return {"sensors": text}


def flag(text):
    return {"flags": f"<flag {text}/>"}


def pendulum(**parts):
    return mujoco.MjModel.from_xml_string(PENDULUM.format(**{**dict.fromkeys(PARTS, ""), "actuators": MOTOR, **parts}))


FLOOR = '<geom name="floor" type="plane" size="2 2 1" {0}/>'
BALL = '<body name="ball" pos="1 0 0.099"><freejoint/><geom name="ball" type="sphere" size="0.1" {0}/></body>'
BOX = '<body name="box" pos="1 0 0.2"><freejoint/><geom name="{0}" type="box" size="0.1 0.1 0.1"/></body>'
TETRAHEDRON = '<asset><mesh name="tetrahedron" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset>'
LIQUID = 'density="20"'

# What is asked for, and the words of the refusal.
REFUSALS = [
    ({"option": 'noslip_iterations="3"'}, r"noslip iterations \(option noslip_iterations\)"),
    ({"option": 'actuatorgroupdisable="0"'}, r"\(option actuatorgroupdisable\) in actuator motor"),
    (flag('override="enable"'), r"flag override"),
    (flag('sleep="enable"'), r"flag sleep"),
    (flag('diagexact="enable"'), r"flag diagexact"),
    (flag('spring="disable"') | {"joint": 'damping="0.4"'}, r"springs disabled .*\(flag spring\)"),
    (flag('spring="disable"') | {"body": 'gravcomp="1"'}, r"springs disabled .*\(flag spring\)"),
    (flag('damper="disable"') | {"joint": 'stiffness="3"'}, r"dampers disabled .*\(flag damper\)"),
    (flag('damper="disable"') | {"joint": 'damping="0.4"'}, r"dampers disabled .*\(flag damper\)"),
    (flag('damper="disable" spring="disable"') | {"joint": 'damping="0.4"'}, r"dampers disabled .*\(flag damper\)"),
    (
        {"option": LIQUID, "geom": 'fluidshape="ellipsoid"'},
        r"the ellipsoid model of fluids \(geom fluidshape\) in geom arm",
    ),
    (motor('joint="shoulder" delay="0.05" nsample="12"'), r"delays \(actuator delay\) in actuator motor"),
    (general('dyntype="filterexact" dynprm="0.05" actearly="true"'), r"\(actuator actearly\) in actuator motor"),
    (motor('joint="shoulder" damping="0.5"', "position"), r"\(actuator damping\) in actuator motor"),
    (motor('joint="shoulder" armature="0.5"', "position"), r"\(actuator armature\) in actuator motor"),
    (motor('joint="shoulder" motorconst="0.05" resistance="1"', "dcmotor"), r"dcmotors .* in actuator motor"),
    (motor('joint="shoulder" kp="1" ki="1"', "pid"), r"pid controllers \(pid\) in actuator motor"),
    (general('dyntype="user" actdim="2"'), r"callbacks .* in actuator motor"),
    (general('gaintype="user"'), r"callbacks .* in actuator motor"),
    (general('biastype="user"'), r"callbacks .* in actuator motor"),
    (motor('cranksite="hand" slidersite="wall" cranklength="0.5"'), r"\(actuator cranksite\) in actuator motor"),
    (
        {"actuators": '<adhesion name="glue" body="lower" ctrlrange="0 1"/>'},
        r"\(adhesion, actuator body\) in actuator glue",
    ),
    (
        {
            "option": 'integrator="implicitfast"',
            "actuators": '<muscle name="biceps" joint="shoulder" ctrlrange="0 1" lengthrange="-1 1"/>',
        },
        r"muscles with the integrator implicitfast \(muscle\) in actuator biceps",
    ),
    (
        motor('joint="shoulder" kv="3" forcerange="-0.5 0.5"', "velocity") | {"option": 'integrator="implicitfast"'},
        r"implicitfast \(actuator forcerange\) in actuator motor",
    ),
    ({"joint": 'stiffness="1 5 9"'}, r"polynomial stiffness \(joint stiffness\) in joint shoulder,"),
    ({"elbow": 'damping="0.05 0.5"'}, r"polynomial damping \(joint damping\) in joint elbow,"),
    ({"tendon": 'stiffness="1 5 9"'}, r"polynomial stiffness \(tendon stiffness\) in tendon cord,"),
    ({"tendon": 'damping="0.1 0.5"'}, r"polynomial damping \(tendon damping\) in tendon cord,"),
    ({"joint": 'range="-10 10" margin="0.3"'}, r"\(joint margin\) in joint shoulder,"),
    ({"tendon": 'range="-0.1 0.1" margin="0.3"'}, r"\(tendon margin\) in tendon cord,"),
    (
        {
            "world": '<flexcomp name="rope" type="grid" count="3 1 1" spacing="0.1 1 1" dim="1" radius="0.01" mass="1">'
            "<edge equality='true'/></flexcomp>"
        },
        r"flexible bodies \(flex, flexcomp\)",
    ),
    ({"geom": 'adhesion="5"'}, r"adhesive contacts \(geom or pair adhesion\)"),
    (
        {
            "world": FLOOR.format("") + BALL.format(""),
            "rest": '<contact><pair geom1="floor" geom2="ball" adhesion="5"/></contact>',
        },
        r"adhesive contacts \(geom or pair adhesion\)",
    ),
    ({"world": FLOOR.format('surfacevel="1 0 0 0 0 0"')}, r"moving surfaces \(geom surfacevel\) in geom floor"),
    (sensor('<jointpos name="late" joint="elbow" delay="0.05" nsample="12"/>'), r"delays \(sensor delay\) in .* late,"),
    (sensor('<jointpos name="rare" joint="elbow" interval="0.05 0" nsample="2"/>'), r"\(sensor interval\) in .* rare,"),
    (sensor('<rangefinder name="ray" site="hand"/>'), r"\(sensor rangefinder\) in sensor ray,"),
    (
        {"assets": TETRAHEDRON, "sensors": '<tactile name="skin" geom="arm" mesh="tetrahedron"/>'},
        r"\(sensor tactile\) in sensor skin,",
    ),
    ({"joint": 'range="-9 9"', "sensors": '<jointlimitpos joint="shoulder"/>'}, r"\(sensor jointlimitpos and the like"),
    ({"tendon": 'range="-9 9"', "sensors": '<tendonlimitfrc tendon="cord"/>'}, r"\(sensor jointlimitpos and the like"),
    (sensor('<distance geom1="arm" geom2="forearm" cutoff="1"/>'), r"\(sensor distance, normal, fromto\)"),
    (sensor('<insidesite site="hand" objtype="body" objname="upper"/>'), r"\(sensor insidesite\)"),
    (sensor("<e_kinetic/>"), r"\(sensor e_potential, e_kinetic\)"),
    (sensor('<user dim="2" needstage="pos"/>'), r"\(sensor user\)"),
    (sensor('<contact body1="upper" data="found" reduce="mindist"/>'), r"\(sensor contact; .* reduce mindist"),
    (sensor('<contact geom1="arm" data="found force"/>'), r"\(sensor contact; .* reduce mindist"),
    (sensor('<contact geom1="arm" data="force" reduce="netforce"/>'), r"\(sensor contact; .* reduce mindist"),
    (
        sensor('<framelinacc objtype="body" objname="lower" cutoff="0.2"/>'),
        r"\(sensor framelinacc or frameangacc with cutoff\)",
    ),
    (
        {
            "assets": TETRAHEDRON,
            "site": 'type="mesh" mesh="tetrahedron"',
            "world": FLOOR.format("") + BALL.format(""),
            "sensors": '<touch name="touch" site="hand"/>',
        },
        r"\(sensor touch of a site with a mesh\) in sensor touch",
    ),
    (
        {
            "assets": '<extension><plugin plugin="mujoco.pid"><instance name="pid"/></plugin></extension>',
            "actuators": '<plugin name="motor" plugin="mujoco.pid" joint="shoulder" instance="pid"/>',
        },
        "plugins",
    ),
]


@pytest.mark.parametrize(("parts", "message"), REFUSALS, ids=[message for _, message in REFUSALS])
def test_what_mjx_lacks_is_refused_by_name(parts, message):
    model = pendulum(**parts)
    with pytest.raises(ValueError, match=f"MJX can't simulate this model: it uses .*{message}"):
        dmc.Simulation.of(model)


# Without an effect nothing is refused.
IDLE = {
    "other groups, flags, buffers, noise, gaps, no fluid": {
        "option": 'actuatorgroupdisable="3"',
        "geom": 'gap="0.1" fluidshape="ellipsoid"',
        **flag('fwdinv="enable" energy="enable" invdiscrete="enable" damper="disable" spring="disable"'),
        **motor('joint="shoulder" nsample="12"'),
        **sensor('<jointpos joint="elbow" nsample="2" noise="3"/>'),
    },
    "no dampers, implicitfast": {
        "option": 'integrator="implicitfast"',
        "joint": 'damping="0.4"',
        **flag('damper="disable"'),
    },
    "no springs, no limits, limited servo": {
        "joint": 'stiffness="3" range="-10 10" margin="0.3"',
        **flag('spring="disable" limit="disable"'),
        **motor('joint="shoulder" kv="3" forcerange="-0.5 0.5"', "velocity"),
    },
}


@pytest.mark.parametrize("kind", IDLE)
def test_what_has_no_effect_is_not_refused(kind):
    assert_like_mujoco(pendulum(**IDLE[kind]), steps=10)


def test_every_refusal_has_a_case():
    def refused(parts):
        model = pendulum(**parts)
        return {entry.words for entry in support.REFUSED if np.any(entry.used(model))}

    tried = set().union(*(refused(parts) for parts, message in REFUSALS if message != "plugins"))
    # These name what MJCF reaches through others alone.
    beyond = {"plugins", "several controls or forces of one actuator"}
    missing = {entry.words for entry in support.REFUSED} - tried - beyond
    assert missing <= {"constraints of flexible bodies or distances (equality flex, distance)"}


def test_every_field_of_a_model_is_classed():
    unknown = [field for field in support.fields() if not support.classes(field)]
    assert not unknown, f"new in MuJoCo; does MJX simulate them? {unknown}"
    assert not support.classes("geom_stickiness")
    assert not support.classes("opt.turbulence")


def test_no_entry_of_the_tables_is_of_a_field_that_is_gone():
    fields = list(support.fields())
    patterns = support.SIMULATED + support.NO_PART
    patterns += [pattern for entry in support.REFUSED for pattern in entry.fields.split()]
    assert [pattern for pattern in patterns if not any(support.listed(field, [pattern]) for field in fields)] == []


def assert_like_mujoco(model, steps=25, seed=0):
    """Holds that positions, velocities, activations and sensors are C MuJoCo's in a free run, in dm_control's order.

    In 64 bits, so that little is left to the solver's accuracy; MJX's Runge-Kutta with tendons takes 32 alone.
    """
    wide = model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
    with jax.enable_x64(wide):
        return run_like_mujoco(model, steps, seed, np.float64 if wide else np.float32)


def run_like_mujoco(model, steps, seed, dtype):
    rng = np.random.default_rng(seed)
    qvel = 0.3 * rng.normal(size=model.nv)
    simulation = dmc.Simulation.of(model)
    initial = simulation.initial()
    start = start_of(initial.replace(qvel=jnp.asarray(qvel, dtype)))
    advance = jax.jit(simulation.advance)
    data = advance(initial, jnp.zeros(model.nu, dtype), jnp.ones((), bool), start)
    reference = mujoco.MjData(model)
    reference.qvel[:] = qvel
    mujoco.mj_step1(model, reference)
    for _ in range(steps):
        control = rng.uniform(*model.actuator_ctrlrange.T)
        data = advance(data, jnp.asarray(control, dtype), jnp.zeros((), bool), start)
        reference.ctrl[:] = control
        if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            mujoco.mj_step(model, reference)
        else:
            mujoco.mj_step2(model, reference)
        mujoco.mj_step1(model, reference)
    for field in ("qpos", "qvel", "act", "xpos", "sensordata"):
        ours, theirs = np.asarray(getattr(data, field)), getattr(reference, field)
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5, err_msg=field)
    return reference


SERVOS = """
<position joint="elbow" ctrlrange="-2 2" kp="2" kv="0.3"/>
<intvelocity joint="elbow" ctrlrange="-1 1" actrange="-1 1" kp="2"/>
<damper joint="shoulder" ctrlrange="0 1" kv="1"/> <position joint="shoulder" ctrlrange="-1 1" timeconst="0.1"/>
<position site="hand" refsite="wall" gear="1 0 0 0 0.1 0" ctrlrange="-1 1" kp="2"/>
<motor tendon="cord" ctrlrange="-2 2"/>"""
STIFF = {
    "body": 'gravcomp="0.7"',
    "joint": 'armature="0.1" stiffness="2" springref="20" damping="0.2" ref="10" frictionloss="0.1" range="-30 30" '
    'margin="0.01" actuatorfrcrange="-2 2" actuatorgravcomp="true"',
    "elbow": 'range="-1 1"',
    "tendon": 'armature="0.1" stiffness="3" damping="0.3" springlength="-0.01 0.01" range="-0.05 0.05" '
    'frictionloss="0.1" actuatorfrcrange="-0.5 0.5"',
}
LIMITED = '<motor joint="shoulder" gear="3" ctrlrange="-2 2" forcerange="-1 1"/>'
MUSCLES = '<muscle joint="shoulder" ctrlrange="0 1" lengthrange="-1 1"/>'
MUSCLES += '<muscle tendon="cord" ctrlrange="0 1" lengthrange="-3 3"/>'
FILTER = '<general joint="elbow" dyntype="filterexact" dynprm="0.05" ctrlrange="-2 2" actrange="-0.5 0.5"/>'
SLIDING = 'condim="{0}" friction="{1} 0.05 0.01"'
ON_FLOOR = 'contype="0" conaffinity="2"'
CONTACTS = {
    "world": FLOOR.format('friction="0.7" margin="0.01" contype="3"')
    + BALL.format(SLIDING.format(6, 0.4) + ' priority="1" solref="0.01 0.7"')
    + '<body pos="1.21 0 0.1" euler="85 0 20"><freejoint/>'
    '<geom name="log" type="capsule" size="0.1 0.1" solmix="3"/></body>'
    + '<body pos="1.9 0 0.099" euler="90 0 20"><freejoint/><geom type="cylinder" size="0.1 0.08" condim="1" '
    + ON_FLOOR
    + "/></body>"
    + '<body pos="-1 0 0.08" euler="40 10 0"><freejoint/>'
    '<geom type="ellipsoid" size="0.1 0.12 0.08" condim="4" ' + ON_FLOOR + "/></body>",
    "rest": '<contact><pair geom1="ball" geom2="log" condim="4" friction="0.5 0.4 0.01 0.001 0.001" margin="0.02"/>'
    '<exclude body1="upper" body2="lower"/></contact>',
}
ROUTED = {
    "world": '<body name="target" mocap="true" pos="0.3 0 0.2"><geom type="sphere" size="0.1"/></body>'
    '<site name="side" pos="0.3 0 0.7"/>'
    '<geom name="post" type="cylinder" size="0.06 0.1" euler="90 0 0" pos="0.1 0 0.75" contype="0" conaffinity="0"/>',
    "rest": '<equality><joint joint1="shoulder" joint2="elbow" polycoef="0.1 0.5 0.3 0 0"/></equality>'
    '<tendon><spatial name="wire" stiffness="20" springlength="0.1" damping="1"><site site="wall"/>'
    '<geom geom="post" sidesite="side"/><site site="hand"/></spatial></tendon>',
}
SENSORS = """
<accelerometer site="hand"/> <velocimeter site="hand"/> <gyro site="hand"/> <force site="hand"/> <torque site="hand"/>
<magnetometer site="hand"/> <tendonpos tendon="cord"/> <tendonvel tendon="cord"/> <actuatorpos actuator="motor"/>
<actuatorvel actuator="motor"/> <actuatorfrc actuator="motor"/> <jointactuatorfrc joint="shoulder"/>
<framepos objtype="geom" objname="arm" reftype="site" refname="hand"/> <framequat objtype="body" objname="lower"/>
<framexaxis objtype="site" objname="hand"/> <framelinvel objtype="site" objname="hand" reftype="body" refname="upper"/>
<frameangvel objtype="geom" objname="arm"/> <framelinacc objtype="body" objname="lower"/> <clock/>
<frameangacc objtype="site" objname="hand"/> <subtreecom body="upper"/> <subtreelinvel body="upper"/>
<subtreeangmom body="upper"/> <framepos objtype="body" objname="lower" cutoff="0.2"/>
<jointvel joint="elbow" cutoff="0.1"/>
<accelerometer site="hand" cutoff="0.5"/> <camprojection site="hand" camera="eye"/>
<contact geom1="ball" num="2" data="found force dist pos normal" reduce="mindist"/> <contact num="1" data="found"/>"""
SENSING = {
    "world": FLOOR.format("")
    + BALL.format("")
    + '<camera name="eye" pos="0 -2 1" xyaxes="1 0 0 0 0.3 1" resolution="64 48"/>',
    "sensors": SENSORS,
}

ALIKE = {
    "joints, tendons, actuators": STIFF | {"actuators": SERVOS + LIMITED, "option": 'cone="elliptic"'},
    "the same, implicitfast": STIFF | {"actuators": SERVOS, "option": 'integrator="implicitfast"'},
    "muscles, without warm starts": {"actuators": MUSCLES, **flag('warmstart="disable"')},
    "filtered, RK4": {"actuators": FILTER, "option": 'integrator="RK4"'},
    "fluid": {"option": 'wind="3 1 0" density="20" viscosity="0.3"'},
    "contacts": CONTACTS,
    "elliptic contacts, CG": CONTACTS
    | {"option": 'cone="elliptic" impratio="3" solver="CG" jacobian="sparse" tolerance="1e-14" iterations="500"'},
    "routes and couplings": ROUTED,
    "sensors": SENSING,
}


@pytest.mark.parametrize(
    "kind", slow_but(ALIKE, "joints, tendons, actuators", "contacts", "routes and couplings", "sensors")
)
def test_what_is_not_refused_is_simulated_as_mujoco_does(kind):
    reference = assert_like_mujoco(pendulum(**ALIKE[kind]))
    if "contacts" in kind:
        assert reference.ncon >= 4


HEIGHTS = '<asset><hfield name="hills" nrow="2" ncol="2" size="1 1 0.1 0.1" elevation="0 1 1 0"/></asset>'
DICE = '<asset><mesh name="die" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1 .1 .1 .1"/></asset>'
OTHERWISE = [
    ({"world": FLOOR.format("") + BOX.format("crate")}, r"contacts of these geoms .*: floor, .*crate .*plane with box"),
    ({"world": BOX.format("crate"), "geom": 'contype="1"'}, r"contacts .*: .*crate .*capsule with box"),
    (
        {
            "assets": DICE,
            "world": FLOOR.format("") + BOX.format("die").replace("box", "mesh").replace("size", 'mesh="die" size'),
        },
        r"contacts .*: floor, .*die .*plane with mesh",
    ),
    (
        {"assets": HEIGHTS, "world": '<geom name="ground" type="hfield" hfield="hills" pos="0 0 -1"/>'},
        r"ground.*hfield with capsule",
    ),
    (
        {"rest": '<equality><connect name="pin" body1="lower" anchor="0 0 0"/></equality>'},
        r"connect and weld .*equality pin",
    ),
    ({"rest": '<equality><weld body1="lower"/></equality>'}, r"connect and weld .*equality number 0"),
]


@pytest.mark.parametrize(("parts", "message"), OTHERWISE, ids=[message for _, message in OTHERWISE])
def test_what_is_simulated_otherwise_is_warned_of_once_and_by_name(parts, message):
    with pytest.warns(support.SimulatedOtherwise, match=message) as caught:
        dmc.Simulation.of(pendulum(**parts))
    assert len(caught) == 1
    assert caught[0].filename == __file__


@pytest.mark.parametrize("off", ["contact", "constraint"])
def test_what_is_switched_off_is_not_warned_of(off):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dmc.Simulation.of(pendulum(world=FLOOR.format("") + BOX.format("crate"), **flag(f'{off}="disable"')))


def test_no_domain_has_anything_that_is_simulated_otherwise():
    from ne_dreamer_jax.envs import registry

    tasks = [dmc_names.split(name) for name in registry.names() if name.startswith("dmc/")]
    assert len(tasks) == 20
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for domain, task in tasks:
            dmc.load(domain, task)
