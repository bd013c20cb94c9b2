"""Runs on environments in worker processes: trained, stopped, gone on with and evaluated as others are."""

from __future__ import annotations

import functools
import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax import config as configs
from ne_dreamer_jax import loop as loops
from ne_dreamer_jax.envs.host import Workers, from_dm_env, from_gymnasium
from ne_dreamer_jax.runs import endings, training
from tests.envs import host_fakes
from tests.experiments import toy

pytestmark = pytest.mark.usefixtures("quick_compilation")

WALK = "dm_env:tests.envs.host_fakes:make_walk"


def train(path, env, **loop):
    said: list[str] = []
    outcome = nedreamer.train(toy.config(**loop), path, env=env, checkpoint_minutes=0, echo=said.append)
    return outcome.code, said


@pytest.fixture(scope="module")
def by_name(tmp_path_factory):
    path = tmp_path_factory.mktemp("named") / "run"
    said: list[str] = []
    config = configs.override(toy.config(), f"env.task={WALK}")
    assert nedreamer.train(config, path, echo=said.append).code == 0
    return path, said


def test_a_run_says_what_does_not_resume_and_is_loaded_by_name(by_name):
    path, said = by_name
    assert training.NO_EXACT_RESUME in said
    lines = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    returns = [line["train/return"] for line in lines if "train/return" in line]
    assert returns
    assert np.isfinite(returns).all()
    config, env, agent, state, *_ = nedreamer.load(path)
    assert config.env.task == WALK
    env_state, policy = env.prepare(jax.random.split(jax.random.key(0), 3)), agent.init_policy(3)
    for t in range(3):
        env_state, timestep = env.step(env_state, policy.prev_action)
        policy, _ = agent.act(state.params, policy, timestep, jax.random.key(t), mode="mode")
    env.host.close()
    np.testing.assert_array_equal(timestep.obs["t"], [2.0] * 3)


def test_a_policy_is_played_elsewhere_too(by_name):
    path, _ = by_name
    said: list[str] = []
    result = nedreamer.evaluate(path, episodes=2, also=WALK, echo=said.append)
    assert result["also"]["task"] == WALK
    # The environment has no chance in it, so that both are the same episodes.
    assert result["also"]["policy"] == result["policy"]
    assert result["policy"]["lengths"] == [6, 6]
    assert json.loads((path / "evaluation.json").read_text()) == result
    assert any(f"in {WALK}" in line for line in said)
    with pytest.raises(ValueError, match=r"gym:CartPole-v1: expected the observations of dm_env:.*got"):
        nedreamer.evaluate(path, also="gym:CartPole-v1", echo=said.append)


@pytest.mark.slow
def test_a_failure_stops_the_run_where_that_is_chosen_and_the_run_goes_on_later(tmp_path):
    env = from_gymnasium(
        functools.partial(host_fakes.Failing, "raises", str(tmp_path / "mark")),
        workers=Workers(processes=1, on_failure="stop"),
    )
    code, said = train(tmp_path / "run", env, eval_every=None)
    assert code == endings.ENVIRONMENT
    assert any("the door is stuck" in line for line in said)
    assert "Stopped, as an environment failed (env.on_failure=stop). The last checkpoint is" in said[-1]
    code, said = train(tmp_path / "run", env, eval_every=None)
    assert code == 0
    assert "2 episodes of another process are cut; others begin." in said


def test_an_evaluation_says_which_episodes_were_cut(by_name, monkeypatch):
    path, _ = by_name
    env = from_dm_env(host_fakes.Stumbling)
    monkeypatch.setattr("ne_dreamer_jax.runs.evaluation.env_configs.make", lambda config: env)
    said: list[str] = []
    result = nedreamer.evaluate(path, episodes=2, echo=said.append)
    assert result["policy"]["cut"] == 2
    assert result["policy"]["lengths"] == [3, 3]
    assert any("2 of them CUT SHORT" in line for line in said)
    assert any("the reward is not finite" in line for line in said)


@pytest.mark.slow
def test_a_failure_costs_an_episode_where_the_run_is_to_go_on(tmp_path):
    env = from_gymnasium(
        functools.partial(host_fakes.Failing, "raises", str(tmp_path / "mark")), workers=Workers(processes=1)
    )
    code, said = train(tmp_path / "run", env, eval_every=None)
    assert code == 0
    assert sum("the door is stuck" in line for line in said) == 1
    assert sum("episodes cut by faults of the environment: 1" in line for line in said) == 1


@pytest.mark.slow
def test_environments_that_fail_again_and_again_end_the_run_with_a_sentence(tmp_path):
    env = from_gymnasium(functools.partial(host_fakes.Failing, "raises"), workers=Workers(processes=1))
    code, said = train(tmp_path / "run", env, eval_every=None)
    assert code == endings.ENVIRONMENT
    assert "Stopped: the environments failed: environment 0 raised RuntimeError: the door is stuck" in said[-1]


@pytest.mark.slow
def test_stepping_while_learning_changes_nothing():
    env = from_dm_env(host_fakes.make_walk)
    config = toy.config()
    agent = nedreamer.make_agent(config.agent, env.spec)
    ends = []
    for each in (env, env._replace(start=None)):
        loop = loops.make(config.loop, each, agent, 1)
        state, report = loop.chunk(loop.init(jax.random.key(0)), jnp.asarray(30, jnp.int32))
        assert int(report.updates) > 0
        zero = jnp.zeros((), jnp.int32)
        state = state._replace(env=state.env._replace(pool=zero), key=jax.random.key_data(state.key))
        ends.append(jax.device_get(state._replace(train=state.train._replace(key=zero))))
    env.host.close()
    jax.tree.map(np.testing.assert_array_equal, *ends)


def test_several_devices_are_refused():
    env = from_dm_env(host_fakes.make_walk)
    config = toy.config()
    agent = nedreamer.make_agent(config.agent, env.spec)
    mesh = jax.make_mesh((1,), ("data",))
    with pytest.raises(ValueError, match="expected one device for environments in worker processes"):
        loops.make(config.loop, env, agent, 1, mesh)
    env.host.close()
    with pytest.raises(ValueError, match="expected one device"):
        loops.make(replace(config.loop, num_envs=4), env, agent, 1, mesh)
