"""Flipped bits and cuts in every file of a run: what is damaged is named, and never taken for whole."""

import random
import shutil

import pytest

from ne_dreamer_jax.config import Config
from ne_dreamer_jax.runs import checkpoint, metrics, run_directory, training
from ne_dreamer_jax.runs.run_directory import RefusedError, RunDirectory
from tests.experiments import stub, toy
from tests.experiments.test_training import Killed
from tests.experiments.test_training import train as run_stub

OUTCOMES = {"refused", "passed over", "not read", "fewer lines", "as it was"}
"""The last: nothing of what is read is other than it was, such as where a bit of white space has become another one."""


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A run with two whole checkpoints, and what loads from it."""
    path = tmp_path_factory.mktemp("run") / "run"
    patch = pytest.MonkeyPatch()
    patch.setattr(training, "draw", lambda *_: None)
    with pytest.raises(Killed):
        run_stub(path, at="env step 80", minutes=0, run=stub.build(toy.config(), image=False))
    patch.undo()
    return path


def likes():
    nothing = ()
    shapes = stub.run().shapes
    return {"agent": shapes.train, "loop": shapes._replace(train=nothing)}


def taken(path):
    """All that a start of the run reads: configuration, checkpoint and metrics; and what was named as damaged."""
    config = run_directory.read_config(path, Config)
    restored = checkpoint.restore(RunDirectory(path).checkpoints, likes())
    lines = metrics.read(RunDirectory(path).metrics)
    found = restored.checkpoint
    digests = [checkpoint.digest(found, item) for item in ("agent", "loop")]
    lines = [
        {name: value for name, value in line.items() if value == value} for line in lines
    ]  # a NaN is like no other
    return (config, found.step, digests, [line for line in lines if line["env_step"] <= found.step]), (restored.skipped)


def damage(path, draw):
    """Flips a bit of a file, or cuts it short."""
    content = bytearray(path.read_bytes())
    if draw.random() < 0.2:
        path.write_bytes(content[: draw.randrange(len(content))])
        return "cut"
    content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    path.write_bytes(content)
    return "flipped"


def check(original, path, seed):
    """One seeded damage to a copy of the run; what came of it."""
    draw = random.Random(seed)
    shutil.copytree(original, path)
    read = sorted(entry for entry in path.rglob("*") if entry.is_file() and entry.stat().st_size)
    target = draw.choice([entry for entry in read if entry.name != run_directory.MARKER])
    before, kind = taken(original), damage(target, draw)
    where = (seed, kind, target.relative_to(path))
    try:
        after = taken(path)
    except (RefusedError, ValueError) as error:
        return "refused" if str(target) in str(error) else f"refused without its name: {error}"
    older = target.is_relative_to(path / "checkpoints") and f"{before[0][1]:012d}" not in target.parts
    if after[1]:
        assert str(target.parent.relative_to(path).parts[1]) in after[1][0], where
        assert (after[0] == before[0]) if older else (after[0][1] < before[0][1]), where
        return "passed over"
    cut_short = target.name == "metrics.jsonl" and kind == "cut"  # as a crash leaves it: the lines before are whole
    assert cut_short or after[0] == before[0], where
    return "not read" if older else "fewer lines" if cut_short else "as it was"


@pytest.mark.parametrize("seed", range(8))
def test_damage_is_named(original, tmp_path, seed):
    assert check(original, tmp_path / "run", seed) in OUTCOMES


@pytest.mark.slow
def test_two_hundred_damages(original, tmp_path):
    outcomes = [check(original, tmp_path / f"{seed}", 1000 + seed) for seed in range(200)]
    assert set(outcomes) <= OUTCOMES
    print({outcome: outcomes.count(outcome) for outcome in sorted(set(outcomes))})
    assert outcomes.count("refused") + outcomes.count("passed over") > 50
