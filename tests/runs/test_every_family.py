"""An agent trained for 1,000 agent steps in an environment of every family, where its library is installed."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax import config as configs
from ne_dreamer_jax import loop as loops
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.envs import conformance
from ne_dreamer_jax.envs.vector import as_vector
from tests.experiments import toy

STEPS = 1_000

FAMILIES = [
    ("dmc/pendulum_swingup", {"obs": "pixels"}, None),
    ("rooms/watermaze_small", {}, None),
    ("gym:CartPole-v1", {}, "gymnasium"),
    ("gym:CartPole-v1", {"obs": "pixels"}, "pygame"),
    ("gym:ALE/Pong-v5", {"action_repeat": 4}, "ale_py"),
    ("dm_env:tests.envs.host_fakes:make_walk", {}, "dm_env"),
    ("dm_control:cartpole_balance", {"obs": "vector"}, "dm_control"),
    ("memory_maze:9x9", {}, "memory_maze"),
    ("jax:popgym_arcade/AutoEncodeEasy", {}, "popgym_arcade"),
    ("jax:popgym_arcade/AutoEncodeEasy-partial", {}, "popgym_arcade"),
    ("jax:gymnax/MemoryChain-bsuite", {}, "gymnax"),
    ("jax:craftax/Craftax-Classic-Pixels-v1", {}, "craftax"),
]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the libraries' own code
@pytest.mark.parametrize(
    ("task", "settings", "package"), FAMILIES, ids=[f"{t}-{o.get('obs', '')}" for t, o, _ in FAMILIES]
)
def test_an_agent_trains(task, settings, package, quick_compilation):
    if package is not None and importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    config = configs.override(toy.config(env_steps=10**6, eval_every=None, replay_ratio=0.5), f"env.task={task}")
    size = {"image_size": 32} if hasattr(config.env, "image_size") else {}
    env_config = replace(config.env, **settings, **size)
    env = env_configs.make(env_config)
    assert conformance.findings(env, jax.random.key(0), beginning_steps=10, echo=lambda line: None) == []
    venv = as_vector(env)
    encoder = replace(config.agent.encoder, depth=2)
    agent = nedreamer.make_agent(replace(config.agent, encoder=encoder), venv.spec)
    options = replace(config.loop, num_envs=4, capacity=4 * STEPS)
    loop = loops.make(options, venv, agent, env_config.action_repeat)
    state, report = loop.chunk(loop.init(jax.random.key(0)), jnp.asarray(STEPS // 4, jnp.int32))
    report = jax.device_get(report)
    if venv.host is not None:
        assert venv.host.lines() == []
        venv.host.close()
    assert int(report.updates) > 50
    assert int(report.faults) == 0
    assert int(state.counters.skipped) == 0
    assert all(np.isfinite(value).all() for value in report.learning.values())
