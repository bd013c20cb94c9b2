"""DrQ-v2 on the same loop, replay, checkpoints and evaluation as every agent."""

import dataclasses
import signal

import jax
import numpy as np
import pytest

from ne_dreamer_jax import config as configs
from ne_dreamer_jax.runs import building
from tests.drqv2 import small
from tests.experiments import test_training, toy

pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.fixture(scope="module")
def config():
    """The toy run's budget, with DrQ-v2 in the world model's place."""
    base = configs.with_method(toy.config(), "drqv2")
    agent = dataclasses.replace(
        small.CONFIG,
        batch_size=base.agent.batch_size,
        steps_per_update=base.agent.steps_per_update,
        random_steps=base.agent.random_steps,
    )
    return dataclasses.replace(base, agent=agent)


def test_a_stopped_run_goes_on_to_the_same_bits(tmp_path, config):
    run = building.build(config, toy.env())
    train = test_training.train
    assert train(tmp_path / "straight", run=run)[0] == 0
    assert train(tmp_path / "stopped", test_training.terminate, "env step 80", run=run)[0] == 128 + signal.SIGTERM
    assert train(tmp_path / "stopped", run=run)[0] == 0
    assert test_training.last_bits(tmp_path / "stopped") == test_training.last_bits(tmp_path / "straight")
    lines = test_training.measured(tmp_path / "straight")
    assert test_training.measured(tmp_path / "stopped") == lines
    assert lines[-1]["update"] == run.loop.budget.updates > 3
    losses = [line[name] for line in lines for name in line if name.startswith("train/loss/")]
    assert len(losses) > 3
    assert np.isfinite(losses).all()


def test_the_clocks_of_acting_and_learning_agree(config):
    """Agent steps as acting counts them, and as the updates imply them."""
    run = building.build(config, toy.env())
    steps, updates = run.loop.budget.vector_steps * config.loop.num_envs, run.loop.budget.updates
    implied = run.loop.budget.prefill * config.loop.num_envs + config.agent.steps_per_update * updates
    assert steps - config.agent.steps_per_update <= implied <= steps
    state = jax.eval_shape(run.loop.init, jax.random.key(0))
    assert state.policy.step.shape == ()
