"""The Control Suite tasks against dm_control on C MuJoCo."""

import functools
import math
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks import dmc_equality as equality
from ne_dreamer_jax import envs
from ne_dreamer_jax.envs import conformance
from ne_dreamer_jax.envs.dmc import Task, environment
from ne_dreamer_jax.envs.dmc import names as dmc_names
from ne_dreamer_jax.envs.dmc import simulation as stepping
from ne_dreamer_jax.envs.dmc.simulation import mjx
from tests.marks import slow_but

NAMES = [name for name in envs.names() if name.startswith("dmc/")]
QUICK = "dmc/cartpole_swingup"  # compiles in seconds, and its random actions earn something


class Compiled:
    """An environment with its functions compiled once for all tests."""

    def __init__(self, name: str):
        self.env = envs.make(name, obs="vector")
        self.reset, self.step = jax.jit(jax.vmap(self.env.reset)), jax.jit(jax.vmap(self.env.step))


@functools.cache
def compiled(name: str) -> Compiled:
    return Compiled(name)


@functools.cache
def task_of(name: str) -> Task:
    return equality.load_task(name)


# What is read off a state: no physics is compiled, so every task is tested by default.


@pytest.mark.parametrize("name", NAMES)
def test_rewards_and_observations_of_dm_controls_states_are_dm_controls(name):
    task = task_of(name)
    recording = equality.record(name, 40, restart_every=10, action_repeat=1)
    initial = task.simulation.initial()

    def read(fields, episode):
        data = initial.replace(**fields)
        return task.reward(data, episode), task.observe(data, episode)

    end, episode = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (recording.end, recording.episode))
    reward, obs = jax.jit(jax.vmap(read))(end, episode)
    assert set(obs) == set(recording.obs)
    assert reward.dtype == jnp.float32
    np.testing.assert_allclose(reward, recording.reward, rtol=1e-4, atol=1e-5)
    for key, expected in recording.obs.items():
        assert obs[key].dtype == jnp.float32
        np.testing.assert_allclose(obs[key], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_the_model_its_timing_and_its_names_are_dm_controls(name):
    task, theirs = task_of(name), equality.load_dm_control(name, seed=0)
    simulation, model = task.simulation, theirs.physics.model.ptr
    theirs.reset()
    assert simulation.n_sub_steps == theirs._n_sub_steps
    assert simulation.control_timestep == pytest.approx(theirs.control_timestep())
    core = environment.make_core(task, "vector", action_repeat=1, image_size=1)
    assert math.ceil(round(task.time_limit / simulation.control_timestep, 6)) == math.ceil(theirs._step_limit)
    assert {key: value.shape for key, value in core.spec.observation.items()} == {
        key: value.shape for key, value in theirs.observation_spec().items()
    }
    assert core.spec.action.shape == theirs.action_spec().shape

    per_episode = {"reacher": ["geom_pos", "geom_aabb", "geom_rbound"], "finger": ["site_pos"]}
    dropped_contacts = {
        "finger": ["geom_contype", "geom_conaffinity", "body_contype", "body_conaffinity"],
        "quadruped": ["exclude_signature"],
    }
    domain, _ = dmc_names.split(name)
    exempt = {"paths", *per_episode.get(domain, []), *dropped_contacts.get(domain, [])}
    compared = 0
    for field in dir(model):
        value = getattr(model, field) if not field.startswith(("_", "name")) and field not in exempt else None
        if isinstance(value, np.ndarray) and value.dtype.kind in "iufb" and "_bvh" not in field and "bvh_" not in field:
            np.testing.assert_allclose(getattr(simulation.mj_model, field), value, rtol=1e-6, err_msg=field)
            compared += 1
    assert compared > 200
    for option in (
        "timestep",
        "integrator",
        "solver",
        "iterations",
        "tolerance",
        "ls_iterations",
        "cone",
        "disableflags",
    ):
        assert getattr(simulation.mj_model.opt, option) == getattr(model.opt, option)


@pytest.mark.parametrize(
    ("name", "slack", "margin", "poses"),
    [("dmc/finger_spin", np.pi, 0.008, 3000), ("dmc/quadruped_run", 0.1, 0.05, 300)],  # the finger seldom touches
)
def test_contacts_that_are_left_out_are_out_of_reach(name, slack, margin, poses):
    """With joints past their limits and a margin around all geoms, MuJoCo finds the same pairs in both models."""
    ours, theirs = task_of(name).simulation.mj_model, equality.load_dm_control(name, seed=0).physics.model.ptr
    hinges = theirs.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    low, high = theirs.jnt_range[hinges].T
    rng, touching = np.random.default_rng(0), 0
    for _ in range(poses):
        # The arcsine law prefers the limits.
        angles = low - slack + (high - low + 2 * slack) * rng.beta(0.5, 0.5, low.shape)
        found = []
        for model in (ours, theirs):
            data = mujoco.MjData(model)
            model.geom_margin[:] = margin / 2  # of each geom of a pair
            data.qpos[theirs.jnt_qposadr[hinges]] = angles
            mujoco.mj_fwdPosition(model, data)
            model.geom_margin[:] = 0
            found.append({tuple(pair) for pair in data.contact.geom})
        assert found[0] == found[1]
        touching += len(found[0])
    assert touching > 20, "the poses must bring some geoms together, or nothing is tested"


# Physics.


@pytest.mark.parametrize("name", slow_but(NAMES, QUICK))
def test_one_step_from_dm_controls_state_gives_its_reward_and_observation(name):
    steps = 40 if name == QUICK else 500
    reward, obs = equality.one_step_errors(equality.Player(task_of(name)), equality.record(name, steps))
    # A contact that begins within the step amplifies rounding; the bulk has to be exact.
    assert np.quantile(reward, 0.95) < 1e-4
    for key, errors in obs.items():
        assert np.median(errors) < 1e-4, key
        assert np.quantile(errors, 0.9) < 1e-3, key


@pytest.mark.slow
def test_a_line_search_that_ends_gives_the_bits_of_one_that_takes_all_its_turns(monkeypatch):
    name = "dmc/hopper_hop"
    recording, played = equality.record(name, 100), []
    for replaced in (stepping._INSTEAD, stepping._INSTEAD[:1]):  # the second leaves MJX its own search
        monkeypatch.setattr(stepping, "_INSTEAD", replaced)
        player = equality.Player(equality.load_task(name))
        played.append(player.play(recording.start, recording.episode, recording.action[None]))
    jax.tree.map(np.testing.assert_array_equal, *played)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dmc/walker_walk", "dmc/hopper_hop"])
def test_the_shorter_line_search_costs_next_to_no_accuracy(name):
    recording, errors = equality.record(name, 100), {}
    for fast in (False, True):
        task = equality.load_task(name, fast)
        assert (task.simulation.model.opt.ls_iterations < task.simulation.mj_model.opt.ls_iterations) == fast
        _, obs = equality.one_step_errors(equality.Player(task), recording)
        errors[fast] = np.stack(list(obs.values()))
    assert np.quantile(errors[True], 0.95) < 2 * np.quantile(errors[False], 0.95)
    assert errors[True].max() < 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({name.split("_")[0]: name for name in NAMES}.values()))
def test_in_64_bits_one_step_is_dm_controls(name):
    """So that what is left in 32 bits is rounding: the same physics, domain by domain."""
    code = (
        "import jax\n"
        "jax.config.update('jax_enable_x64', True)\n"
        "from benchmarks import dmc_equality as equality\n"
        f"row = equality.measure({name!r}, steps=500, free_steps=0, runs=50, resets=0, episodes=0)\n"
        "print(row.reward_error, row.obs_error)"
    )
    run = subprocess.run([sys.executable, "-c", code], check=True, timeout=600, capture_output=True, text=True)
    reward, obs = map(float, run.stdout.split())
    assert reward < 1e-7
    assert obs < 1e-7


def test_contacts_of_short_capsules_have_mujocos_normals():
    """The ball beside a wall of the cup, which is 5 cm long: MJX alone tilts this normal by 4e-4."""
    simulation = task_of("dmc/ball_in_cup_catch").simulation
    data = mujoco.MjData(simulation.mj_model)
    data.qpos[:] = [0.0, 0.0, 0.0, 0.3]
    wall = simulation.mj_model.geom("cup_part_0").id
    mujoco.mj_kinematics(simulation.mj_model, data)
    ball = simulation.mj_model.geom("ball").id
    # Into the wall's side, a third of the way along it.
    along = data.geom_xmat[wall].reshape(3, 3)[:, 2]
    place = data.geom_xpos[wall] + simulation.mj_model.geom_size[wall, 1] / 3 * along
    place = place + np.array([0.03, 0, 0]) - data.geom_xpos[ball]
    data.qpos[2:] += place[[0, 2]]
    mujoco.mj_forward(simulation.mj_model, data)
    pair = [set(contact.geom) == {ball, wall} for contact in data.contact]
    assert sum(pair) == 1
    expected = data.contact.frame[pair.index(True)].reshape(3, 3)[0]
    start = simulation.initial().replace(qpos=jnp.asarray(data.qpos, jnp.float32))
    contact = jax.jit(simulation.settle)(start)._impl.contact
    found = [set(np.asarray(geom)) == {ball, wall} for geom in contact.geom]
    np.testing.assert_allclose(contact.frame[found.index(True)][0], expected, atol=1e-5)


@pytest.mark.parametrize("name", slow_but(["dmc/pendulum_swingup", QUICK], QUICK))
def test_a_whole_episode_runs_along_with_dm_control(name):
    """Same start, same actions: the same 500 rewards and observations, and the last flag on the same step."""
    recording = equality.record(name, 500, seed=1, restart_every=501)
    ours = compiled(name)
    state, _ = ours.reset(jax.random.key(0)[None])
    first = {key: jnp.asarray(value[:1], jnp.float32) for key, value in recording.start.items()}
    never = jnp.zeros(1, bool)
    simulation = task_of(name).simulation
    settled = jax.jit(jax.vmap(simulation.advance))(state.physics, jnp.zeros((1, 1)), ~never, first)
    state = state._replace(core=state.core._replace(physics=settled))
    for number in range(500):
        state, timestep = ours.step(state, jnp.asarray(recording.action[number][None], jnp.float32))
        assert bool(timestep.is_last[0]) == (number == 499)
        np.testing.assert_allclose(timestep.reward[0], recording.reward[number], atol=2e-3)
        for key, value in timestep.obs.items():
            np.testing.assert_allclose(value[0], recording.obs[key][number], rtol=1e-2, atol=1e-2)
    assert not timestep.is_terminal[0]


def test_a_repeat_that_does_not_divide_the_time_limit_shortens_the_last_step():
    """1,000 control steps in strides of 300: three whole ones and one of 100."""
    env = envs.make("dmc/pendulum_swingup", obs="vector", action_repeat=300)
    step = jax.jit(env.step)
    state, _ = env.reset(jax.random.key(0))
    last, ends = [], []
    for _ in range(5):
        state, timestep = step(state, jnp.zeros(1))
        last.append(bool(timestep.is_last))
        ends.append(float(state.physics.time))
    assert last == [False, False, False, True, False]
    np.testing.assert_allclose(ends, [6, 12, 18, 20, 0], rtol=1e-3)
    assert timestep.is_first


# Environments.


@pytest.mark.parametrize("name", slow_but(NAMES, "dmc/pendulum_swingup"))
def test_every_task_conforms(name):
    conformance.check(envs.make(name, obs="vector"), jax.random.key(0))


def test_training_begins_with_the_models_own_data():
    """Quadruped's equality constraints, which a state of zeros would turn off."""
    env = envs.make("dmc/quadruped_walk", obs="vector")
    physics = env.prepare(jax.random.key(0)).physics
    assert physics.eq_active.shape == (4,)
    assert physics.eq_active.all()


def test_physics_that_stops_being_finite_ends_the_episode_and_the_next_is_sound():
    ours = compiled(QUICK)
    state, _ = ours.reset(jax.random.split(jax.random.key(0), 2))
    broken = state.physics.replace(qvel=state.physics.qvel.at[0, 1].set(jnp.nan))
    state, timestep = ours.step(state._replace(core=state.core._replace(physics=broken)), jnp.zeros((2, 1)))
    np.testing.assert_array_equal(timestep.is_last, [True, False])
    np.testing.assert_array_equal(timestep.is_terminal, [False, False])
    np.testing.assert_array_equal(state.faults, [1, 0])
    assert float(timestep.reward[0]) == 0
    for value in timestep.obs.values():
        assert np.isfinite(value).all()
    for number in range(3):
        state, timestep = ours.step(state, jnp.zeros((2, 1)))
        np.testing.assert_array_equal(timestep.is_first, [number == 0, False])
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state.physics, timestep)))
    np.testing.assert_array_equal(state.faults, [1, 0])


def test_env_state_gives_the_mjx_data():
    ours = compiled(QUICK)
    assert isinstance(ours.env.reset(jax.random.key(0))[0].physics, mjx.Data)


@pytest.mark.slow
def test_actions_of_plus_and_minus_one_reach_the_ends_of_unequal_control_ranges():
    ours = compiled("dmc/quadruped_walk")
    low, high = task_of("dmc/quadruped_walk").simulation.mj_model.actuator_ctrlrange.T
    assert (high != -low).any()
    state, _ = ours.reset(jax.random.split(jax.random.key(0), 4))
    state, _ = ours.step(state, jnp.array([-1.0, 1.0, 0.0, 3.0])[:, None] * jnp.ones((4, 12)))
    np.testing.assert_allclose(state.physics.ctrl, [low, high, (low + high) / 2, high], atol=1e-6)


# First states.


def check_resets(name: str, num_resets: int) -> None:
    p_values = equality.reset_p_values(
        equality.our_resets(task_of(name), num_resets), equality.their_resets(name, num_resets)
    )
    assert len(p_values) > 0
    # 20 tasks with up to 18 dimensions each; seeds are fixed, so this either always holds or never.
    assert p_values.min() > 1e-3, p_values


@pytest.mark.parametrize(
    "name",
    [
        "dmc/acrobot_swingup",
        "dmc/cartpole_balance",
        "dmc/cartpole_swingup",
        "dmc/hopper_hop",
        "dmc/pendulum_swingup",
        "dmc/reacher_hard",
        "dmc/walker_run",
    ],
)
def test_first_states_are_distributed_as_dm_controls(name):
    check_resets(name, 200)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_thousand_first_states_are_distributed_as_dm_controls(name):
    check_resets(name, 1000)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dmc/ball_in_cup_catch", "dmc/finger_turn_easy", "dmc/quadruped_walk"])
def test_first_states_touch_nothing_and_are_judged_as_mujoco_judges_them(name):
    """MuJoCo finds no contact in our first states, where the task promises that; for quadruped, 1 cm lower it does."""
    task = task_of(name)
    qpos = np.asarray(jax.jit(jax.vmap(lambda key: task.reset(key)[0].qpos))(jax.random.split(jax.random.key(2), 64)))
    data = mujoco.MjData(task.simulation.mj_model)
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(task.simulation.mj_model, data)
        assert data.ncon == 0
        if "quadruped" in name:
            data.qpos[2] -= 0.01
            mujoco.mj_fwdPosition(task.simulation.mj_model, data)
            assert data.ncon > 0


# Libraries.


def test_no_opengl_and_no_dm_control_suite_is_loaded():
    code = (
        "import sys, jax, jax.numpy as jnp\n"
        "from ne_dreamer_jax import envs\n"
        "env = envs.make('dmc/pendulum_swingup', obs='vector')\n"
        "state, _ = env.reset(jax.random.key(0))\n"
        "env.step(state, jnp.zeros(1))\n"
        "bad = [m for m in sys.modules if m.split('.')[0] in ('OpenGL', 'glfw') or m.startswith('dm_control')]\n"
        "assert not bad, bad"
    )
    run = subprocess.run([sys.executable, "-c", code], check=True, timeout=300, capture_output=True, text=True)
    assert run.stdout == "", "importing must not print"
