"""What JAX is told by the user's environment changes neither the program's types nor whether it runs."""

import os
import re
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax import loop as loops
from ne_dreamer_jax.envs import dmc, probes
from ne_dreamer_jax.nets.platform import traced_for
from ne_dreamer_jax.replay import ring as replay
from tests import tiny
from tests.drqv2 import small
from tests.experiments import toy

AGENTS = {"ne_dreamer": tiny.CONFIG, "drqv2": small.CONFIG}

pytestmark = pytest.mark.usefixtures("quick_compilation")


def described(tree):
    """Name -> shape and dtype of every array."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): (x.shape, str(x.dtype))
        for path, x in jax.tree.leaves_with_path(tree)
    }


def build(method, observation):
    """A loop of a tiny agent in a probe, its configuration and the environment's spec."""
    probe = probes.cue() if observation == "vector" else probes.as_picture(probes.cue(), side=16)
    config = replace(AGENTS[method], batch_size=2)
    settings = toy.config(env_steps=200, prefill=2 * (config.batch_length + 2)).loop
    return loops.make(settings, probe.env, nedreamer.make_agent(config, probe.env.spec), 1), config, probe.env.spec


def types(method, observation):
    """Of state, metrics, a batch out of replay and one of noise, without compiling anything."""
    loop, config, spec = build(method, observation)
    state, metrics = jax.eval_shape(loop.chunk, loop.state_shapes(), jax.ShapeDtypeStruct((), jnp.int32))
    draw = lambda ring, key: replay.sample(ring, key, 2, config.batch_length)
    batch = jax.eval_shape(draw, state.replay, jax.random.key(0))
    noise = jax.eval_shape(lambda key: replay.random_batch(spec, config, key), jax.random.key(0))
    return described((state, metrics, batch, noise))


def learned(method, observation):
    """State and metrics of a chunk with updates, and the episodes of an evaluation."""
    loop, config, _ = build(method, observation)
    state = loop.init(jax.random.key(0))
    before = described(state)
    state, metrics = loop.chunk(state, np.int32(config.batch_length + 8))
    assert int(state.train.update) > 0
    assert described(state) == before  # what a chunk returns goes into the next
    return state, metrics, loop.evaluate(state.train.params, jax.random.key(1), frames=True)[:2]


BOTH = pytest.mark.parametrize(
    ("method", "observation"), [(method, kind) for method in AGENTS for kind in ("vector", "picture")]
)


@BOTH
def test_64_bit_mode_changes_no_type(method, observation):
    expected = types(method, observation)
    assert {dtype for _, dtype in expected.values()} <= {"float32", "int32", "uint8", "bool", "key<fry>"}
    with jax.enable_x64(True):
        assert jnp.zeros(()).dtype == jnp.float64
        assert types(method, observation) == expected


def test_a_chunk_learns_in_64_bit_mode():
    with jax.enable_x64(True):
        learned("drqv2", "picture")


@pytest.mark.slow
@BOTH
def test_64_bit_mode_changes_no_value(method, observation):
    expected = learned(method, observation)
    with jax.enable_x64(True):
        got = learned(method, observation)
    assert described(got) == described(expected)
    for name, value in got[1].items():
        np.testing.assert_allclose(value, expected[1][name], rtol=1e-5, err_msg=name)


@pytest.mark.parametrize("platform", ["cpu", "cuda"])
@pytest.mark.parametrize("method", tiny.OBJECTIVES)
def test_in_bfloat16_nothing_is_summed_in_it(method, platform):
    """Products add in float32 inside; a sum of its own, as a bias' gradient over all rows, has to be asked for."""
    config = replace(tiny.with_method(tiny.OBJECTIVES[method]), compute_dtype="bfloat16")
    with traced_for(platform):
        agent = nedreamer.make_agent(config, tiny.BOTH)
        shapes = jax.eval_shape(agent.init, jax.random.key(0))
        batch = jax.eval_shape(lambda key: replay.random_batch(tiny.BOTH, config, key), jax.random.key(1))
        program = str(jax.make_jaxpr(agent.train_step)(shapes, batch))
    sums = re.findall(r"(\w+)\[[\d,]*\] = reduce_sum\[", program)
    assert len(sums) > 100
    assert "bf16" not in sums
    assert "bf16" in program


@pytest.mark.parametrize("method", [name for name in tiny.OBJECTIVES if name != "ne_dreamer"])
def test_64_bit_mode_changes_no_objectives_type(method):
    def update():
        config = tiny.with_method(tiny.OBJECTIVES[method])
        agent = nedreamer.make_agent(config, tiny.BOTH)
        shapes = jax.eval_shape(agent.init, jax.random.key(0))
        batch = jax.eval_shape(lambda key: replay.random_batch(tiny.BOTH, config, key), jax.random.key(1))
        return described((shapes, batch, *jax.eval_shape(agent.train_step, shapes, batch)))

    expected = update()
    with jax.enable_x64(True):
        assert update() == expected


def test_64_bit_mode_changes_no_type_of_a_control_task():
    def stepped():
        env = nedreamer.envs.make("dmc/pendulum_swingup", obs="both", image_size=8)
        state = jax.eval_shape(env.prepare, jax.random.key(0))
        action = jax.ShapeDtypeStruct(env.spec.action.shape, jnp.float32)
        return described((state, jax.eval_shape(env.step, state, action)))

    expected = stepped()
    with jax.enable_x64(True):
        assert stepped() == expected


def test_a_task_made_in_64_bit_mode_makes_no_environment():
    with jax.enable_x64(True):
        task = dmc.load("pendulum", "swingup")
        with pytest.raises(ValueError, match="expected a task of 32 bits"):
            dmc.from_task(task, obs="vector")


CHUNK = """
import jax
from tests.experiments import toy
from ne_dreamer_jax import loop, make_agent
config, env = toy.config(), toy.env()
made = loop.make(config.loop, env, make_agent(config.agent, env.spec), 1)
state = made.init(jax.random.key(0))
for steps in (1, 1, 14):  # no episode and no update; then both
    state, metrics = made.chunk(state, jax.numpy.int32(steps))
assert int(state.train.update) > 0
made.evaluate(state.train.params, jax.random.key(1))
"""
TOLD = {
    "JAX_ENABLE_X64": "1",
    "JAX_DEBUG_NANS": "True",
    "JAX_NUMPY_RANK_PROMOTION": "raise",
    "JAX_NUMPY_DTYPE_PROMOTION": "strict",
    "JAX_DEFAULT_PRNG_IMPL": "rbg",
    "JAX_ENABLE_CUSTOM_PRNG": "1",
    "JAX_DEFAULT_MATMUL_PRECISION": "bfloat16",
    "JAX_CHECK_TRACER_LEAKS": "1",
}


@pytest.mark.slow
def test_a_sound_run_stays_one_whatever_jax_is_told():
    environment = {**os.environ, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1", **TOLD}
    subprocess.run([sys.executable, "-c", CHUNK], env=environment, check=True, timeout=600)
