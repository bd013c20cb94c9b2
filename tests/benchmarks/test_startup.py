"""What is timed as a start ends after its first updates."""

import pytest

from benchmarks import startup
from ne_dreamer_jax.commands.train import configure
from ne_dreamer_jax.loop.budget import Budget


@pytest.mark.parametrize("assignments", [(), ("loop.prefill=5000",), ("loop.num_envs=4", "loop.replay_ratio=8")])
def test_the_shortest_run_learns_and_ends(assignments):
    settings = startup.shortest("quickstart", None, None, assignments)
    config = configure("quickstart", None, None, {}, (*assignments, *settings))
    budget = Budget.of(config.loop, config.agent.batch_size, config.agent.batch_length, config.env.action_repeat)
    assert 1 <= budget.updates <= 5
    assert config.loop.eval_every is None
