"""Models and tasks of one's own, against C MuJoCo stepped in dm_control's order."""

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ne_dreamer_jax.envs import conformance, dmc
from ne_dreamer_jax.envs.dmc.simulation import STATE, start_of
from tests.marks import slow_but

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


SUB_STEPS = dict(zip(MODELS, (1, 3, 1, 2, 3), strict=True))


@pytest.mark.parametrize("kind", slow_but(MODELS, "RK4, sensors of acceleration", "contact"))
def test_steps_sensors_and_restarts_are_mujocos(kind):
    model, n_sub_steps = MODELS[kind](), SUB_STEPS[kind]
    simulation = dmc.Simulation.of(model, n_sub_steps * model.opt.timestep)
    assert simulation.n_sub_steps == n_sub_steps
    rng = np.random.default_rng(0)
    qvel = 0.3 * rng.normal(size=model.nv)
    initial = simulation.initial()
    first = start_of(initial.replace(qvel=jnp.asarray(qvel, jnp.float32)))
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
    said = []
    conformance.check(env, jax.random.key(0), echo=said.append)
    assert len(said) >= 3, "what takes seconds is said before it is done"


LINKED = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="goal" mocap="true" pos="0.3 0 0.4"><geom size="0.03" contype="0" conaffinity="0"/></body>
    <body name="a" pos="0 0 1">
      <joint name="a" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.4" contype="0" conaffinity="0"/>
    </body>
    <body name="b" pos="1 0 1">
      <joint name="b" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.4" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <equality><joint joint1="a" joint2="b"/></equality>
  <actuator><general joint="a" ctrlrange="-1 1" dyntype="filter" dynprm="0.05"/></actuator>
  <size nuserdata="2"/>
</mujoco>"""

# Each field that a state consists of -> a value other than the model's own.
SET = {
    "time": lambda x: x + 1.5,
    "qpos": lambda x: x + 0.3,
    "qvel": lambda x: x + 0.2,
    "act": lambda x: x + 0.5,
    "qacc_warmstart": lambda x: x + 0.1,
    "ctrl": lambda x: x + 0.4,
    "qfrc_applied": lambda x: x + 0.2,
    "xfrc_applied": lambda x: x + 0.1,
    "eq_active": lambda x: ~x,
    "mocap_pos": lambda x: x + jnp.array([[-0.5, 0.1, 0.3]]),
    "mocap_quat": lambda x: jnp.array([[0.6, 0.8, 0.0, 0.0]]),
    "userdata": lambda x: x + 3.0,
}


def linked_task(fields=(), draws=False, **changes):
    """Two arms joined by an equality, and a body that the task moves; every field of its state is observed."""
    simulation = dmc.Simulation.of(mujoco.MjModel.from_xml_string(LINKED), 0.02)
    initial = simulation.initial()

    def reset(key):
        scale = jax.random.uniform(key, minval=0.5, maxval=1.5) if draws else jnp.ones(())
        new = {name: SET[name](getattr(initial, name)) for name in fields}
        return initial.replace(**{k: v if v.dtype == bool else v * scale for k, v in new.items()}), ()

    def observe(data, _):
        state = {name: jnp.ravel(getattr(data, name)).astype(jnp.float32) for name in STATE}
        return {**state, "goal": data.xpos[1], "forces": data.qacc}

    task = dmc.Task(simulation, 0.2, reset, lambda data, _: data.qpos[1], observe)
    return task._replace(**changes)


def test_whatever_a_reset_sets_holds_in_training_and_as_in_mujoco():
    """Episodes that begin as in training and by auto-reset, each with one field of its own, beside C MuJoCo's."""
    plain = linked_task()
    initial = plain.simulation.initial()

    def reset(key):
        which = jax.random.randint(key, (), 0, len(STATE), jnp.int32)
        fields = {
            name: jnp.where(which == i, SET[name](getattr(initial, name)), getattr(initial, name))
            for i, name in enumerate(STATE)
        }
        return initial.replace(**fields), which

    task = plain._replace(reset=reset, episode=jnp.zeros((), jnp.int32))
    env, num_envs, tried = dmc.from_task(task, obs="vector", action_repeat=1), 24, set()
    step = jax.jit(jax.vmap(env.step))
    state = jax.vmap(env.prepare)(jax.random.split(jax.random.key(0), num_envs))
    for _ in range(2):
        state, first = step(state, jnp.ones((num_envs, 1)))
        assert first.is_first.all()
        references = []
        for i, which in enumerate(np.asarray(state.core.episode)):
            field, data = STATE[which], mujoco.MjData(task.simulation.mj_model)
            tried.add(field)
            wanted = np.asarray(SET[field](getattr(initial, field)))
            np.testing.assert_array_equal(getattr(state.physics, field)[i], wanted)
            if field == "time":
                data.time = wanted
            else:
                getattr(data, field)[:] = wanted
            references.append(data)
        for _ in range(10):
            state, timestep = step(state, jnp.ones((num_envs, 1)))
            for i, data in enumerate(references):
                data.ctrl[:] = 1
                mujoco.mj_step(task.simulation.mj_model, data, 2)
                np.testing.assert_allclose(timestep.obs["qpos"][i], data.qpos, atol=1e-5, err_msg=STATE[which])
        assert timestep.is_last.all()
        for i, data in enumerate(references):
            mujoco.mj_kinematics(task.simulation.mj_model, data)
            np.testing.assert_allclose(timestep.obs["goal"][i], data.xpos[1], atol=1e-5)
    assert tried == set(STATE)


OWN = {
    "all that a reset may set, drawn anew": lambda: linked_task(STATE, draws=True),
    "forces read at the start": lambda: linked_task(draws=True, observe=lambda data, _: {"f": data.qacc}),
    "coasting": lambda: linked_task(["qvel"], draws=True, coast=3),
    "ends early": lambda: linked_task(["qvel"], draws=True, terminal=lambda data, _: data.time > 0.1),
    "draws beside the state": lambda: linked_task(
        reset=lambda key: (linked_task().simulation.initial(), {"aim": jax.random.normal(key, (2,))}),
        episode={"aim": jnp.zeros(2)},
        observe=lambda data, episode: {"aim": episode["aim"], "q": data.qpos},
    ),
    "sensors of accelerations": lambda: own_task(swinging())._replace(time_limit=0.3),
    "contact": lambda: own_task(MODELS["contact"]())._replace(time_limit=0.3),
}


@pytest.mark.parametrize("kind", slow_but(OWN, "all that a reset may set, drawn anew", "coasting"))
def test_episodes_of_own_tasks_are_the_same_however_they_begin(kind):
    conformance.check(dmc.from_task(OWN[kind](), obs="vector"), jax.random.key(0))


def test_conformance_notices_a_beginning_that_leaves_something_of_the_old_episode():
    env = dmc.from_task(linked_task(STATE, draws=True), obs="vector")

    def prepare(key):
        state = env.prepare(key)
        physics = state.physics.replace(qpos=state.physics.qpos + 1.0)
        return state._replace(core=state.core._replace(physics=physics), needs_reset=jnp.zeros((), bool))

    with pytest.raises(AssertionError, match="begun by prepare and step as by reset"):
        conformance.check(env._replace(prepare=prepare), jax.random.key(0))


def test_a_reset_may_settle_what_it_returns():
    task = linked_task(["qpos"])
    settling = task._replace(reset=jax.jit(lambda key: (task.simulation.settle(task.reset(key)[0]), ())))
    dmc.from_task(settling, obs="vector")


def test_a_task_may_end_an_episode_at_any_control_step():
    """Above 0.11 s, which no multiple of the repeat's 0.08 s is: the step stops there, and nothing more is earned."""
    task = linked_task(["qvel"], terminal=lambda data, _: data.time > 0.11, reward=lambda data, _: jnp.ones(()))
    env = dmc.from_task(task, obs="vector", action_repeat=4)
    step = jax.jit(env.step)
    state = env.prepare(jax.random.key(0))
    for _ in range(2):
        seen = []
        for _ in range(3):
            state, timestep = step(state, jnp.ones(1))
            seen.append((bool(timestep.is_first), bool(timestep.is_terminal), float(timestep.reward)))
            assert bool(timestep.is_last) == bool(timestep.is_terminal)
        assert seen == [(True, False, 0.0), (False, False, 4.0), (False, True, 2.0)]
        assert float(state.physics.time) == pytest.approx(0.12)


@pytest.mark.slow
def test_python_numbers_serve_as_rewards_and_observations():
    env = dmc.from_task(linked_task(reward=lambda *_: 2.5, observe=lambda *_: {"x": 1.0}), obs="vector")
    state, timestep = env.step(env.prepare(jax.random.key(0)), jnp.zeros(1))
    state, timestep = env.step(state, jnp.zeros(1))
    assert (float(timestep.reward), float(timestep.obs["x"])) == (5.0, 1.0)
    assert timestep.obs["x"].dtype == jnp.float32


def test_an_action_of_another_shape_or_dtype_is_refused():
    env = dmc.from_task(own_task(swinging()), obs="vector")
    state = env.prepare(jax.random.key(0))
    for action, got in (
        (jnp.zeros(2), r"float32\[2\]"),
        (jnp.zeros(()), r"float32\[\]"),
        (jnp.zeros(1, int), r"int32\[1\]"),
    ):
        with pytest.raises(ValueError, match=r"action: expected float32\[1\], got " + got):
            env.step(state, action)


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
    "no array": ({"observe": lambda data, _: {"x": "far"}}, r"task.observe: expected 'x' to be an array of numbers"),
    "no dict": ({"observe": lambda data, _: data.qpos}, r"task.observe: expected a dict of names and arrays"),
    "a matrix": (
        {"observe": lambda data, _: {"x": data.xmat}},
        r"expected 'x' to have at most one axis, got \[3, 3, 3\]",
    ),
    "a second image": (
        {"observe": lambda data, _: {"image": data.qpos}},
        r"another name than 'image', which the pixels",
    ),
    "no pair": ({"reset": lambda key: dmc.load("pendulum", "swingup").reset(key)[0]}, r"task.reset: expected a pair"),
    "no data": ({"reset": lambda key: (key, ())}, r"task.reset: expected a pair of an mjx.Data and what the episode"),
    "draws without an example": (
        {"reset": lambda key: (own_task(swinging()).reset(key)[0], jax.random.normal(key))},
        r"expected it to draw what task.episode is an example of, PyTreeDef\(\(\)\), got PyTreeDef\(\*\)",
    ),
    "draws of another shape": (
        {"reset": lambda key: (own_task(swinging()).reset(key)[0], jnp.zeros(3)), "episode": jnp.zeros(2)},
        r"what the episode draws: expected float32\[2\], got float32\[3\]",
    ),
    "a field of another shape": (
        {"reset": lambda key: (own_task(swinging()).simulation.initial().replace(qvel=jnp.zeros(7)), ())},
        r"task.reset: its mjx.Data.*qvel: expected float32\[2\], got float32\[7\]",
    ),
    "what follows from the state": (
        {"reset": lambda key: (own_task(swinging()).simulation.initial().replace(xpos=jnp.ones((3, 3))), ())},
        r"expected it to set fields among time, qpos, .*; got xpos set too",
    ),
    "an end that is no flag": (
        {"terminal": lambda data, _: data.qpos[0]},
        r"task.terminal: expected bool\[\], got float32\[\]",
    ),
    "no pose": ({"pose": lambda data, _: data.qpos}, r"task.pose: expected an mjx.Data"),
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
