"""One task of each domain along stored trajectories of dm_control, made by ``benchmarks.dmc_trajectories``."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import dmc_equality as equality
from benchmarks import dmc_trajectories as trajectories

pytestmark = pytest.mark.usefixtures("quick_compilation")

STORED = Path(__file__).parent / "trajectories.npz"
EXACT = ("acrobot", "cartpole", "pendulum", "reacher")  # nothing touches, or is near its limits for long
QUICK = ("cartpole", "pendulum", "reacher")  # to compile


def marked(name):
    quick = any(domain in name for domain in QUICK)
    return name if quick else pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.parametrize("name", [marked(name) for name in trajectories.TASKS])
def test_stored_trajectories_of_dm_control_are_followed(name):
    segments = trajectories.load(STORED, name)
    player = equality.Player(equality.load_task(name))
    rewards, obs = player.play(segments.start, segments.episode, segments.action)
    exact = any(domain in name for domain in EXACT)
    assert set(obs) == set(segments.obs)
    for key, value in {**obs, "reward": rewards}.items():
        expected = segments.reward if key == "reward" else segments.obs[key]
        errors = np.stack([equality.error(ours, theirs) for ours, theirs in zip(value, expected, strict=True)])
        assert errors.shape == (trajectories.STEPS, trajectories.SEGMENTS)
        if exact:
            assert errors.max() < 1e-4, key
            continue
        # A contact that begins within a step amplifies rounding, and what follows goes its own way; the bulk is exact.
        assert np.median(errors[0]) < 1e-4, key
        assert errors[0].max() < 0.05, key
        assert np.median(errors) < 1e-3, key


def test_the_stored_trajectories_are_dm_controls():
    """Recorded once more, as the script does."""
    name = "dmc/reacher_hard"
    stored, again = (trajectories.flat(name, s) for s in (trajectories.load(STORED, name), trajectories.record(name)))
    assert set(stored) == set(again)
    for key, value in stored.items():
        assert value.dtype == np.float32
        np.testing.assert_allclose(value, again[key], rtol=1e-5, atol=1e-5, err_msg=key)


def test_the_segments_move():
    for name in trajectories.TASKS:
        segments = trajectories.load(STORED, name)
        assert segments.action.shape[:2] == segments.reward.shape == (trajectories.STEPS, trajectories.SEGMENTS)
        for value in segments.obs.values():
            assert np.isfinite(value).all()
        assert max(np.abs(np.diff(value, axis=0)).max() for value in segments.obs.values()) > 0.01, name
