"""A run that is killed at any moment, most often in a save: it loads, and holds what was last said to be saved."""

import random
import subprocess
import sys
import time

import pytest

from ne_dreamer_jax.runs import checkpoint
from tests.faults import saving


def killed(path, seed):
    """What a child said that it had saved, last, before it was killed at a seeded moment."""
    draw = random.Random(seed)
    child = subprocess.Popen(
        [sys.executable, "-m", "tests.faults.saving", "kills", str(path), str(seed)], stdout=subprocess.PIPE, text=True
    )
    with child:
        assert child.stdout is not None
        said = [child.stdout.readline() for _ in range(draw.randint(1, 6))]
        time.sleep(draw.uniform(0.0, 0.06))  # about as long as a save and a look at it
        child.kill()
        said += child.stdout.read().splitlines(keepends=True)
    whole = [line for line in said if line.endswith("\n")]
    step, value, digest = whole[-1].split()
    return int(step), int(value), digest


def check(path, seed):
    """Whether the newest that loads is what was last said to be saved (False), or the one after it (True)."""
    step, value, digest = killed(path, seed)
    partial = sorted(entry.name for entry in (path / "checkpoints").glob(".partial*"))
    found = saving.content(path / "checkpoints")
    assert found == (step, value, digest) or (found[1] == value + 1 and found[0] in (step, step + 1)), (seed, partial)
    saving.checkpoint.save(path / "checkpoints", found[0] + 1, {"agent": saving.state(1).train, "loop": ()})
    assert not list((path / "checkpoints").glob(".partial*")), "the next save clears what is left"
    assert len(checkpoint.checkpoints(path / "checkpoints")) <= 5
    return found[1] != value, bool(partial)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_process_that_is_killed_leaves_what_it_said_was_saved(tmp_path, seed):
    check(tmp_path / "run", seed)


@pytest.mark.slow
def test_fifty_kills(tmp_path):
    outcomes = [check(tmp_path / f"{seed}", seed) for seed in range(100, 150)]
    within = sum(partial for _, partial in outcomes)
    print(
        f"of 50, {within} were in the middle of a save, {sum(newer for newer, _ in outcomes)} between it and its line"
    )
    assert within > 5
