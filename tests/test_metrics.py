"""Metrics lines are whole, stand once a step, and survive a crash."""

import json
import math

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ne_dreamer_jax.runs import metrics
from ne_dreamer_jax.runs.metrics import StepCounts


def write(path, steps, name="train/return"):
    with metrics.Writer(path) as writer:
        for step in steps:
            writer.write(StepCounts(2 * step, step, step // 4), {name: float(step), "train/episodes": step})


def test_a_line_is_plain_json_with_counters_first(tmp_path):
    path = tmp_path / "metrics.jsonl"
    with metrics.Writer(path) as writer:
        values = {"a": jnp.float32(0.5), "b": np.int32(3), "c": 4, "d": True, "e": math.inf, "f": math.nan}
        writer.write(StepCounts(20, 10, 2), values)
    assert path.read_text() == (
        '{"env_step": 20, "agent_step": 10, "update": 2, "a": 0.5, "b": 3, "c": 4, "d": 1, "e": null, "f": null, '
        '"crc32": 3885388497}\n'
    )
    (line,) = metrics.read(path)
    assert math.isnan(line["e"])


@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), max_size=5))
def test_values_read_back_exactly(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("run") / "metrics.jsonl"
    with metrics.Writer(path) as writer:
        for step, value in enumerate(values):
            writer.write(StepCounts(step, step, 0), {"x": np.float32(value)})
    steps, read = metrics.series(metrics.read(path), "x")
    np.testing.assert_array_equal(read.astype(np.float32), np.asarray(values, np.float32))
    np.testing.assert_array_equal(steps, np.arange(len(values)))


def test_going_on_drops_what_lies_past_the_checkpoint(tmp_path):
    path = tmp_path / "metrics.jsonl"
    write(path, [10, 20, 30])
    assert [line["agent_step"] for line in metrics.resume(path, 40)] == [10, 20]
    write(path, [30, 40])
    assert [line["agent_step"] for line in metrics.read(path)] == [10, 20, 30, 40]
    assert [entry.name for entry in tmp_path.iterdir()] == ["metrics.jsonl"]


def test_a_line_cut_by_a_crash_is_left_out_and_healed(tmp_path):
    path = tmp_path / "metrics.jsonl"
    write(path, [10, 20])
    path.write_text(path.read_text()[:-5])
    assert [line["agent_step"] for line in metrics.read(path)] == [10]
    metrics.resume(path, 40)
    write(path, [20])
    assert [line["agent_step"] for line in metrics.read(path)] == [10, 20]


def test_resume_keeps_null_and_starts_a_file_where_there_is_none(tmp_path):
    path = tmp_path / "metrics.jsonl"
    assert metrics.resume(path, 5) == []
    with metrics.Writer(path) as writer:
        writer.write(StepCounts(1, 1, 1), {"loss": math.nan})
    before = path.read_text()
    metrics.resume(path, 5)
    assert path.read_text() == before


def test_a_series_skips_lines_without_the_name(tmp_path):
    path = tmp_path / "metrics.jsonl"
    write(path, [10, 20])
    write(path, [30], name="eval/return")
    steps, values = metrics.series(metrics.read(path), "eval/return", against="agent_step")
    assert (steps.tolist(), values.tolist()) == ([30.0], [30.0])
    assert metrics.series([], "x")[0].shape == (0,)


@pytest.mark.parametrize("text", ["not json\n", "[1]\n", json.dumps({"agent_step": 3}) + "\n"])
def test_a_foreign_line_is_refused_by_its_number(tmp_path, text):
    path = tmp_path / "metrics.jsonl"
    write(path, [10])
    path.write_text(path.read_text() + text)
    with pytest.raises(ValueError, match="line 2: expected a JSON object with env_step, agent_step, update whose"):
        metrics.read(path)


def test_a_number_that_was_changed_is_refused_and_old_lines_have_no_checksum(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"env_step": 2, "agent_step": 1, "update": 0, "eval/return": 5.5}\n')
    write(path, [10, 20])
    assert [line["agent_step"] for line in metrics.read(path)] == [1, 10, 20]
    text = path.read_text()
    for old, new in (
        ('"env_step": 40', '"env_step": 42'),
        (', "crc32"', ', "crc42"'),
        ('return": 20.0', 'return": "20"'),
    ):
        assert old in text
        path.write_text(new.join(text.rsplit(old, 1)))
        with pytest.raises(ValueError, match=r"metrics.jsonl, line [23]: expected .* whose checksum fits"):
            metrics.read(path)


def test_misuse_is_refused(tmp_path):
    with metrics.Writer(tmp_path / "metrics.jsonl") as writer:
        with pytest.raises(ValueError, match="expected names other than the counters"):
            writer.write(StepCounts(1, 1, 1), {"update": 3})
        with pytest.raises(ValueError, match=r"expected a scalar, got an array of shape \(2,\)"):
            writer.write(StepCounts(1, 1, 1), {"x": np.zeros(2)})
