"""Learning curves are compared seed by seed, and only with those of the same setting."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ne_dreamer_jax import config as configs
from tests.released import curves

CONFIG = configs.preset("released_code", "1m")


def run(label, seed, returns, steps=(0, 4_000, 8_000), task="dmc/walker_stand", **loop):
    config = configs.override(replace(CONFIG, seed=seed, loop=replace(CONFIG.loop, **loop)), f"env.task={task}")
    return curves.Run(Path(f"{label}{seed}"), label, config, np.array(steps), np.array(returns, float))


def test_curves_are_compared_at_the_steps_that_all_of_them_have():
    theirs = [run(curves.THEIRS, seed, (0, 100 + seed, 200 + seed)) for seed in (0, 1)]
    ours = [run(curves.OURS, seed, (0, 7, 110 + seed, 250 + seed), (0, 2_000, 4_000, 8_000)) for seed in (0, 1)]
    lines = curves.table({curves.THEIRS: theirs, curves.OURS: ours})
    assert lines[0] == "2 evaluations in common, the last at 8,000 environment steps"
    assert "seeds: 250.0 251.0" in lines[3]
    assert "+50.0" in lines[4]
    assert "p = 0.000" in lines[4]
    assert "+30.0" in lines[6]


def test_runs_of_other_settings_are_refused_but_not_of_another_simulator():
    first = run(curves.THEIRS, 0, (0, 1, 2))
    curves.check_same([first, run(curves.OURS, 0, (0, 1, 2)), run(curves.OURS, 1, (0, 1, 2), eval_every=4_000)])
    elsewhere = run("elsewhere", 0, (0, 1, 2), task="dm_control:walker_stand")
    curves.check_same([first, elsewhere])
    assert curves.task_of(first) == curves.task_of(elsewhere) == "walker_stand"
    with pytest.raises(ValueError, match=r"others in .*: \{'loop.replay_ratio'\}"):
        curves.check_same([first, run(curves.OURS, 0, (0, 1, 2), replay_ratio=3.0)])
    with pytest.raises(ValueError, match="expected each seed once, got seed 0 again"):
        curves.check_same([first, run(curves.THEIRS, 0, (0, 1, 2))])
