"""What is timed as a start ends after its first updates."""

import pytest
from click.testing import CliRunner

from benchmarks import startup, storage, versions
from ne_dreamer_jax.commands.train import configure
from ne_dreamer_jax.loop.budget import Budget


@pytest.mark.parametrize("assignments", [(), ("loop.prefill=5000",), ("loop.num_envs=4", "loop.replay_ratio=8")])
def test_the_shortest_run_learns_and_ends(assignments):
    settings = startup.shortest("quickstart", None, None, assignments)
    config = configure("quickstart", None, None, {}, (*assignments, *settings))
    budget = Budget.of(config.loop, config.agent.batch_size, config.agent.batch_length, config.env.action_repeat)
    assert 1 <= budget.updates <= 5
    assert config.loop.eval_every is None


@pytest.mark.parametrize("command", [startup.main, versions.main])
def test_a_folder_that_is_no_checkout_is_refused(tmp_path, command):
    found = CliRunner().invoke(command, [str(tmp_path)])
    assert found.exit_code == 2
    assert "expected a checkout of this repository" in found.output


def test_a_failing_start_is_told_in_a_sentence(tmp_path):
    for package in ("experiments", "ne_dreamer_jax"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
    (tmp_path / "experiments" / "train.py").write_text("raise SystemExit('broken')")
    found = CliRunner().invoke(startup.main, [str(tmp_path), "--rounds", "1"])
    assert found.exit_code == 1
    assert "expected training to end well, got exit code 1: broken" in found.output


def test_storage_refuses_sequences_that_do_not_fit():
    found = CliRunner().invoke(storage.main, ["--rows", "8"])
    assert (found.exit_code, "expected more than --batch-length, 64, got 8" in found.output) == (2, True)
