"""Models and tasks of one's own, against C MuJoCo stepped in dm_control's order."""

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ne_dreamer_jax.envs import conformance, dmc
from ne_dreamer_jax.envs.dmc.simulation import integrated

pytestmark = pytest.mark.usefixtures("quick_compilation")

SENSORS = """
  <sensor>
    <accelerometer site="tip"/> <force site="tip"/> <torque site="tip"/> <actuatorfrc actuator="motor"/>
    <gyro site="tip"/> <framepos objtype="site" objname="tip"/> <subtreelinvel body="arm"/>
  </sensor>"""

SWINGING = """
<mujoco>
  <option timestep="0.01" integrator="{integrator}"/>
  <worldbody>
    <light pos="0 -1 2" dir="0 1 -2"/>
    <camera name="side" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>
    <body name="arm">
      <joint name="{joint}" type="{joint}" damping="0.05"/>
      <geom name="rod" type="capsule" size="0.04" fromto="0 0 0 0 0 -0.5" rgba="0.8 0.2 0.2 {alpha}"/>
      <site name="tip" pos="0.1 0 -0.5" euler="20 30 0" rgba="0 0 0 0"/>
    </body>
    <body pos="0.6 0 0">
      <joint name="wheel" axis="0 1 0" damping="0.01"/>
      <geom type="cylinder" size="0.1 0.02" euler="90 0 0" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><general name="motor" joint="wheel" gainprm="0.3" dyntype="{dynamics}" {ctrlrange}/></actuator>{sensors}
</mujoco>"""

FALLING = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="arm" pos="0 0 0.048">
      <freejoint/>
      <geom type="sphere" size="0.05"/>
      <site name="tip" type="sphere" size="0.06"/>
    </body>
    <body pos="0.6 0 0.5">
      <joint name="wheel" axis="0 1 0" damping="0.01"/>
      <geom type="cylinder" size="0.1 0.02" euler="90 0 0" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="wheel" ctrlrange="-1 1"/></actuator>{sensors}
</mujoco>"""


def swinging(integrator="Euler", joint="hinge", dynamics="none", sensors=SENSORS, alpha=1, limited=True):
    ctrlrange = 'ctrlrange="-1 1"' if limited else ""
    return mujoco.MjModel.from_xml_string(
        SWINGING.format(
            integrator=integrator, joint=joint, dynamics=dynamics, sensors=sensors, alpha=alpha, ctrlrange=ctrlrange
        )
    )


MODELS = {
    "Euler": lambda: swinging(),
    "implicitfast, ball joint": lambda: swinging("implicitfast", "ball"),
    "RK4, sensors of acceleration": lambda: swinging("RK4"),
    "RK4, ball joint, filtered actuator": lambda: swinging("RK4", "ball", "integrator", ""),
    "contact": lambda: mujoco.MjModel.from_xml_string(
        FALLING.format(sensors=SENSORS.replace("<gyro", '<touch site="tip"/> <gyro'))
    ),
}


class Reference:
    """C MuJoCo as dm_control's physics runs it (dm_control.mujoco.engine.Physics, legacy stepping)."""

    def __init__(self, model, qpos, qvel):
        self.model, self.data = model, mujoco.MjData(model)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        flags = model.opt.disableflags
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        mujoco.mj_forward(model, self.data)
        model.opt.disableflags = flags

    def advance(self, control, n_sub_steps):
        self.data.ctrl[:] = control
        if self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            mujoco.mj_step(self.model, self.data, n_sub_steps)
        else:
            mujoco.mj_step2(self.model, self.data)
            if n_sub_steps > 1:
                mujoco.mj_step(self.model, self.data, n_sub_steps - 1)
        mujoco.mj_step1(self.model, self.data)


def assert_like(data, reference):
    for field in ("time", "qpos", "qvel", "act", "xpos", "sensordata"):
        expected = getattr(reference.data, field)
        np.testing.assert_allclose(getattr(data, field), expected, rtol=2e-4, atol=2e-4, err_msg=field)


@pytest.mark.parametrize(("kind", "n_sub_steps"), list(zip(MODELS, (1, 3, 1, 2, 3), strict=True)))
def test_steps_sensors_and_restarts_are_mujocos(kind, n_sub_steps):
    model = MODELS[kind]()
    simulation = dmc.Simulation.of(model, n_sub_steps * model.opt.timestep)
    assert simulation.n_sub_steps == n_sub_steps
    rng = np.random.default_rng(0)
    qvel = 0.3 * rng.normal(size=model.nv)
    initial = simulation.initial()
    first = integrated(initial.replace(qvel=jnp.asarray(qvel, jnp.float32)))
    advance = jax.jit(simulation.advance)
    never, always = jnp.zeros((), bool), jnp.ones((), bool)

    # A restart, out of a state far from where it leads.
    moved = initial.replace(qvel=initial.qvel + 2.0, qacc_warmstart=initial.qacc_warmstart + 1.0)
    moved = advance(moved, jnp.ones(model.nu), never, first)
    data = advance(moved, jnp.zeros(model.nu), always, first)
    reference = Reference(model, model.qpos0, qvel)
    assert_like(data, reference)
    for _ in range(8):
        control = rng.uniform(-1, 1, model.nu)
        data = advance(data, jnp.asarray(control, jnp.float32), never, first)
        reference.advance(control, n_sub_steps)
        assert_like(data, reference)
    assert not model.nsensor or np.ptp(reference.data.sensordata) > 0.1
    if kind == "contact":
        assert reference.data.ncon == 1


def own_task(model, camera=0):
    simulation = dmc.Simulation.of(model, 0.02)
    initial = simulation.initial()

    def reset(key):
        return initial.replace(qvel=jax.random.normal(key, initial.qvel.shape)), ()

    return dmc.Task(
        simulation,
        time_limit=1.0,
        reset=reset,
        reward=lambda data, _: jnp.exp(-jnp.abs(data.qpos[0])),
        observe=lambda data, _: {"velocity": data.qvel, "tip": data.site_xpos[0]},
        camera=camera,
    )


def test_a_task_of_ones_own_makes_a_conforming_environment():
    env = dmc.from_task(own_task(swinging()), obs="both", image_size=16)
    assert set(env.spec.observation) == {"image", "velocity", "tip"}
    conformance.check(env, jax.random.key(0))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (('<option timestep="0.01"', '<option timestep="0.01" noslip_iterations="3"'), "uses noslip iterations"),
        (
            ('integrator="Euler"', 'integrator="implicit"'),
            "expected its integrator to be Euler or RK4 or implicitfast, got IMPLICIT",
        ),
        (('<option timestep="0.01"', '<option timestep="0.01" solver="PGS"'), "expected its solver to be CG or Newton"),
        (
            ('type="capsule"', 'type="capsule" fluidshape="ellipsoid"'),
            None,  # without a fluid it has no effect
        ),
        (
            (
                'type="capsule"',
                'type="capsule" fluidshape="ellipsoid"',
                'timestep="0.01"',
                'timestep="0.01" density="9"',
            ),
            "uses the ellipsoid model of fluids",
        ),
        (("<accelerometer", '<touch site="tip"/> <accelerometer'), "no two geoms that could touch"),
    ],
)
def test_what_mjx_cannot_simulate_is_named(edit, message):
    text = SWINGING.format(
        integrator="Euler", joint="hinge", dynamics="none", sensors=SENSORS, alpha=1, ctrlrange='ctrlrange="-1 1"'
    )
    for old, new in zip(edit[::2], edit[1::2], strict=True):
        assert old in text
        text = text.replace(old, new)
    model = mujoco.MjModel.from_xml_string(text)
    if message is None:
        dmc.Simulation.of(model)
        return
    with pytest.raises(ValueError, match=f"MJX can't simulate this model: .*{message}"):
        dmc.Simulation.of(model)


def test_a_control_timestep_that_is_no_multiple_is_refused():
    with pytest.raises(ValueError, match=r"multiple of 0\.01 s, got 0\.025"):
        dmc.Simulation.of(swinging(), 0.025)


def test_an_actuator_without_a_range_is_refused_by_its_name():
    with pytest.raises(ValueError, match=r"a ctrlrange for each actuator.*got none for \['motor'\]"):
        dmc.from_task(own_task(swinging(limited=False)), obs="vector")


def test_what_is_no_model_is_refused():
    with pytest.raises(ValueError, match=r"expected a mujoco.MjModel, such as .* got '/a/path.xml'"):
        dmc.Simulation.of("/a/path.xml")


SHAPES = {
    "no reward": ({"reward": lambda data, _: data.qpos[:1]}, r"task.reward: expected a single number"),
    "no dict": ({"observe": lambda data, _: data.qpos}, r"task.observe: expected a dict of names and arrays"),
    "a matrix": (
        {"observe": lambda data, _: {"x": data.xmat}},
        r"expected 'x' to have at most one axis, got \[3, 3, 3\]",
    ),
    "a second image": (
        {"observe": lambda data, _: {"image": data.qpos}},
        r"another name than 'image', which the pixels",
    ),
    "no camera of this name": ({"camera": "sde"}, r"the name of a camera or an id from 0 to 0, got 'sde'.*\['side'\]"),
    "no camera of this number": ({"camera": 1}, r"an id from 0 to 0, got 1"),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_a_tasks_parts_have_the_shapes_that_it_says(kind):
    changes, message = SHAPES[kind]
    with pytest.raises(ValueError, match=message):
        dmc.from_task(own_task(swinging())._replace(**changes), obs="both", image_size=16)


@pytest.mark.parametrize(
    ("part", "message"), [("actuator", "a model with an actuator"), ("camera", "a model with a camera, to be drawn")]
)
def test_what_a_model_lacks_is_named(part, message):
    text = FALLING.format(sensors="").replace("<worldbody>", '<worldbody><camera pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>')
    whole = text[: text.index("<actuator>")] + "</mujoco>" if part == "actuator" else FALLING.format(sensors="")
    with pytest.raises(ValueError, match=message):
        dmc.from_task(own_task(mujoco.MjModel.from_xml_string(whole)), image_size=16)


def test_a_camera_has_a_name():
    from ne_dreamer_jax import render

    model = swinging()
    assert render.build(model, "side", 16, 16).camera == render.build(model, 0, 16, 16).camera == 0


@pytest.mark.parametrize("view", ['znear="0.5"', 'zfar="3"'])
def test_a_view_that_is_cut_off_is_refused(view):
    from ne_dreamer_jax import render

    text = SWINGING.format(
        integrator="Euler", joint="hinge", dynamics="none", sensors="", alpha=1, ctrlrange='ctrlrange="-1 1"'
    ).replace("<worldbody>", f"<visual><map {view}/></visual><worldbody>")
    with pytest.raises(ValueError, match=r"this view can't be drawn: .* expected znear of at most 0.01 and zfar of at"):
        render.build(mujoco.MjModel.from_xml_string(text), 0, 16, 16)


def test_what_cannot_be_drawn_is_named_and_does_not_matter_without_pixels():
    task = own_task(swinging(alpha=0.5))
    with pytest.raises(ValueError, match="geom 'rod' can't be drawn: it is translucent"):
        dmc.from_task(task)
    dmc.from_task(task, obs="vector")


def test_the_model_given_is_left_as_it_was():
    model = swinging()
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    simulation = dmc.Simulation.of(model)
    assert model.opt.enableflags != simulation.mj_model.opt.enableflags


# Other domains of the Control Suite: file -> what can't be done with it.
OTHERS = {
    "dog.xml": ("MJX", "noslip"),
    "fish.xml": ("MJX", "ELLIPSOID.*BOX.*collisions"),
    "humanoid.xml": (None, ""),
    "humanoid_CMU.xml": (None, ""),
    "lqr.xml": ("render", "geom 'origin'.*translucent"),
    "manipulator.xml": ("render", "geom 'wall1'.*textured or reflects"),
    "point_mass.xml": (None, ""),
    "stacker.xml": ("render", "geom 'wall1'.*textured or reflects"),
    "swimmer.xml": ("render", "light 'light_1'.*turns"),
}


@pytest.mark.parametrize("filename", OTHERS)
def test_other_domains_load_or_say_what_they_lack(filename):
    lacks, message = OTHERS[filename]

    def load():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # MuJoCo's advice about these models
            return dmc.Simulation.load(filename)

    if lacks == "MJX":
        with pytest.raises(ValueError, match=message):
            load()
        return
    from ne_dreamer_jax import render

    model = load().mj_model
    if lacks is None:
        render.build(model, 0, 16, 16)
        return
    with pytest.raises(ValueError, match=message):
        render.build(model, 0, 16, 16)
