"""The whole training chunk is lowered for CUDA on a machine without one, and is what a GPU can run by itself."""

from __future__ import annotations

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest
from jax import export

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax import config as configs
from ne_dreamer_jax import loop as loops
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.nets.platform import traced_for
from ne_dreamer_jax.settings import names

GPU_LIBRARIES = {"cusolver_potrf_ffi", "cublas_trsm_ffi", "__cublas$triangularSolve", "cu_threefry2x32_ffi"}
"""Of a GPU's linear algebra and random numbers, which physics and sampling may call."""
COUNTER = re.compile(r"stablehlo\.(constant|iota|broadcast_in_dim|multiply|add|shift_right_logical|convert|reshape) ")
"""What JAX makes its random numbers' counters with, which have 64 bits whatever the program is set to."""


def exported(task: str, method: str) -> str:
    """The StableHLO of a training chunk for CUDA."""
    config = configs.override(configs.preset("quickstart"), f"env.task={task}")
    config = configs.with_method(config, method)
    env = env_configs.make(config.env)
    with traced_for("cuda"):
        agent = nedreamer.make_agent(config.agent, env.spec)
        loop = loops.make(replace(config.loop, capacity=10_000), env, agent, config.env.action_repeat)
        program = export.export(loop.chunk, platforms=["cuda"])
        return program(loop.state_shapes(), jax.ShapeDtypeStruct((), jnp.int32)).mlir_module()


CASES = [("dmc/cartpole_swingup", "ne_dreamer")]
SLOW = [("dmc/quadruped_walk", "ne_dreamer"), ("rooms/watermaze_small", "ne_dreamer")]
SLOW += [("dmc/cartpole_swingup", method) for method in names.METHODS if method != "ne_dreamer"]


@pytest.mark.parametrize(("task", "method"), [*CASES, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)])
def test_a_chunk_is_lowered_for_cuda(task, method):
    text = exported(task, method)
    calls = set(re.findall(r'custom_call @"?([\w$]+)"?', text))
    assert calls <= GPU_LIBRARIES, "neither the host is called back nor a CPU's code"
    assert "f64>" not in text
    computed = [line.strip() for line in text.splitlines() if "dense" not in line]  # that is for constants
    assert [line for line in computed if re.search(r"[<x]i64>", line)] == []
    assert [line for line in computed if re.search(r"[<x]ui64>", line) and not COUNTER.search(line)] == []
    assert text.count("stablehlo.convolution") > 0, "those of a GPU, not the CPU's products"
