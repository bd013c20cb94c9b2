"""A disk that is full or gone: one sentence, training goes on, nothing that was saved is lost."""

import errno
import os
import pathlib
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from ne_dreamer_jax.runs import checkpoint, endings, metrics, run_directory, training
from ne_dreamer_jax.runs.metrics import StepCounts
from ne_dreamer_jax.runs.record import Record
from tests.experiments import stub, toy


def train(path, run=None):
    said = []
    run = run or stub.run()
    with run_directory.claim(path, run.config) as files:
        return training.train(run, files, checkpoint_minutes=0, echo=said.append), said


def test_a_full_disk_costs_the_checkpoints_and_nothing_else(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "free_space", lambda directory: 10)
    code, said = train(tmp_path / "run")
    assert code == endings.NOT_SAVED == 4
    refused = [line for line in said if line.startswith("Not saved: ")]
    assert "it takes up to" in refused[0]
    assert "10 B are free; make room there. Training goes on" in refused[0]
    assert "There is no checkpoint yet" in refused[0]
    assert said[-1].startswith("The end of this run is not saved. Make room in ")
    assert "WARNING: that is too little" in " ".join(said)
    lines = metrics.read(tmp_path / "run" / "metrics.jsonl")
    assert lines[-1]["env_step"] == toy.config().loop.env_steps, "training went on to its end"
    assert not list((tmp_path / "run" / "checkpoints").glob("*")) or not checkpoint.checkpoints(
        tmp_path / "run" / "checkpoints"
    )


def test_a_disk_that_fills_up_leaves_the_checkpoint_before(tmp_path, monkeypatch):
    left = iter([10**9, 10**9, *[10] * 100])
    monkeypatch.setattr(checkpoint, "free_space", lambda directory: next(left))
    code, said = train(tmp_path / "run")
    assert code == endings.NOT_SAVED
    (kept,) = checkpoint.checkpoints(tmp_path / "run" / "checkpoints")
    assert any(f"The last checkpoint is {kept.path}" in line for line in said)
    monkeypatch.undo()
    code, said = train(tmp_path / "run")  # with room again
    assert code == 0
    assert any("Going on from" in line for line in said)


def test_room_that_comes_back_is_used_at_the_next_attempt(tmp_path, monkeypatch):
    left = iter([10**9, 10, 10, *[10**9] * 100])
    monkeypatch.setattr(checkpoint, "free_space", lambda directory: next(left))
    code, said = train(tmp_path / "run")
    assert code == 0
    assert any(line.startswith("Not saved") for line in said)
    assert checkpoint.checkpoints(tmp_path / "run" / "checkpoints")[0].step == toy.config().loop.env_steps


@pytest.mark.parametrize(
    ("module", "call", "number"), [(os, "fsync", 0), (os, "fsync", 2), (os, "replace", 0), (pathlib.Path, "rename", 0)]
)
def test_an_error_of_the_system_leaves_what_was_saved_before(tmp_path, monkeypatch, module, call, number):
    """The n-th sync, replacement or renaming of a save fails: the old state loads, and a new attempt succeeds."""
    state = lambda value: {"agent": {"x": jnp.full((4,), value, jnp.float32)}}
    checkpoint.save(tmp_path, 1, state(1.0))
    real, calls = getattr(module, call), []

    def fail(*args, **options):
        calls.append(args)
        if len(calls) == number + 1:
            raise OSError(errno.EIO, "Input/output error", str(args[0]))
        return real(*args, **options)

    monkeypatch.setattr(module, call, fail)
    with pytest.raises(checkpoint.SaveError, match=r"could not save a checkpoint in .*: Input/output error"):
        checkpoint.save(tmp_path, 2, state(2.0))
    monkeypatch.undo()
    like = {"agent": {"x": jax.ShapeDtypeStruct((4,), jnp.float32)}}
    assert float(checkpoint.restore(tmp_path, like).items["agent"]["x"][0]) == 1.0
    assert [entry.name for entry in tmp_path.iterdir()] == [f"{1:012d}"], "nothing is left of the attempt"
    checkpoint.save(tmp_path, 2, state(2.0))
    assert float(checkpoint.restore(tmp_path, like).items["agent"]["x"][0]) == 2.0


def test_metrics_that_can_not_be_written_end_nothing():
    said = []
    full = metrics.Writer(Path("/dev/full"))
    record = Record(full, [], said.append)
    for step in range(3):
        record.write(StepCounts(step, step, 0), {"train/return": float(step)})
    assert len(said) == 1
    assert "No space left on device. Training goes on" in said[0]
    assert record.find("train/return") == 2.0
    full.close()  # says nothing more


def test_a_file_system_that_is_full_from_the_start_is_said_in_one_sentence(tmp_path, monkeypatch):
    """Nothing is left in a buffer, which would be written, and fail, once more when the file is closed."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / run_directory.MARKER).symlink_to("/dev/full")
    with (
        pytest.raises(run_directory.RefusedError, match="run can't be written to: No space left on device"),
        run_directory.claim(tmp_path / "run", toy.config()),
    ):
        pass


def test_a_save_that_fails_at_the_end_promises_nothing(tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(checkpoint, "save", raising(checkpoint.SaveError("no room")))
    run = stub.build(toy.config(env_steps=40, eval_every=None), image=False)
    with run_directory.claim(tmp_path / "run", run.config) as files:
        assert training.train(run, files, checkpoint_minutes=60, echo=said.append) == endings.NOT_SAVED
    refused = [line for line in said if line.startswith("Not saved: no room.")]
    assert refused
    assert "Training goes on" not in refused[-1]


def raising(error):
    def call(*_, **__):
        raise error

    return call
