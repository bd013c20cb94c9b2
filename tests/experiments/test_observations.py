"""What an agent sees of a Control Suite task: pixels, dm_control's own observations, or both."""

import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.envs.config import DmcConfig
from ne_dreamer_jax.runs import building
from tests.experiments import toy

VECTORS = {"orientation": (2,), "velocity": (1,)}  # dm_control's, of the pendulum


def build(obs):
    return building.build(replace(toy.config(), env=DmcConfig("dmc/pendulum_swingup", obs=obs, image_size=16)))


@pytest.mark.parametrize("obs", ["vector", "both"])
def test_the_encoder_and_replay_take_what_is_observed(obs):
    run = build(obs)
    expected = VECTORS if obs == "vector" else {"image": (16, 16, 3), **VECTORS}
    assert {name: x.shape[2:] for name, x in run.shapes.replay.data.obs.items()} == expected
    encoder = {
        jax.tree_util.keystr(path): x for path, x in jax.tree.leaves_with_path(run.shapes.train.params["encoder"])
    }
    assert any("stage0_kernel" in name for name in encoder) == (obs == "both")
    widths = {x.shape[0] for name, x in encoder.items() if "mlp" in name and x.ndim == 2}
    assert sum(size for (size,) in VECTORS.values()) in widths


@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
@pytest.mark.parametrize("obs", ["vector", "both"])
def test_an_agent_learns_from_dm_controls_observations(obs):
    """Each part of the encoder moves under its updates."""
    run = build(obs)
    state = run.loop.init(jax.random.key(0))
    before = jax.device_get(state.train.params["encoder"])
    state, report = run.loop.chunk(state, jnp.asarray(run.loop.budget.vector_steps, jnp.int32))
    assert int(state.train.update) == run.loop.budget.updates > 0
    assert all(np.isfinite(value) for value in report.means().values())
    for (path, old), new in zip(
        jax.tree.leaves_with_path(before), jax.tree.leaves(state.train.params["encoder"]), strict=True
    ):
        assert (old != new).any(), jax.tree_util.keystr(path)


@pytest.mark.slow
@pytest.mark.parametrize("obs", ["vector", "both"])
def test_the_command_trains_from_dm_controls_observations(obs, tmp_path):
    command = ["train", "--preset", "smoke", "--size", "1m", "--task", "dmc/walker_walk", "--obs", obs]
    run = subprocess.run(
        [sys.executable, "-m", f"experiments.{command[0]}", *command[1:], "--logdir", str(tmp_path / "run")],
        check=True,
        capture_output=True,
        text=True,
    )
    assert "Finished" in run.stdout
    assert (tmp_path / "run" / "policy.mp4").exists() == (obs == "both")
