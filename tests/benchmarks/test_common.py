"""Benchmarks print what they measured, whole and in one JSON line."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import common


@pytest.fixture(autouse=True)
def _small_unit(monkeypatch):
    monkeypatch.setattr(common, "GEMM_SIZE", 8)


def test_every_round_calls_each_case_once_in_turn():
    calls = []
    cases = {name: lambda name=name: calls.append(name) or jnp.zeros(()) for name in ("a", "b")}
    measured = common.measure(cases, rounds=3, warmup=2)
    assert calls == ["a", "b"] * 5
    assert [timing.rounds for timing in measured.cases.values()] == [3, 3]
    assert measured.gemm.rounds == 4  # before each round and after the last


def test_units_are_medians_over_the_matrix_product():
    timing = common.Timing(first=9.0, median=3.0, low=1.0, high=4.0, rounds=3)
    gemm = common.Timing(first=9.0, median=1.5, low=1.0, high=2.0, rounds=4)
    assert common.Measured(gemm, {"a": timing}).units("a") == 2.0


def test_last_line_of_a_report_is_json_with_all_figures(capsys):
    measured = common.measure({"slow": lambda: jnp.ones(3), "fast": lambda: jnp.ones(2)}, rounds=2)
    line = common.report("demo", measured, settings={"batch": 4}, columns={"fast": {"frames/s": 5}})
    out = capsys.readouterr().out
    assert json.loads(out.splitlines()[-1]) == line
    assert line["settings"] == {"batch": 4}
    slow, fast = line["rows"]
    assert slow["seconds"] == measured.cases["slow"].median
    np.testing.assert_allclose(fast["gemm_units"], fast["seconds"] / line["gemm_seconds"])
    assert fast["frames/s"] == 5
    assert "frames/s" not in slow


def test_a_report_says_how_much_memory_a_device_has_held(monkeypatch, capsys):
    monkeypatch.setattr(common, "peak_bytes", lambda: 3_000_000_000)
    measured = common.measure({"a": lambda: jnp.ones(1)}, rounds=1)
    assert common.report("demo", measured, settings={})["peak_bytes"] == 3_000_000_000
    assert "at most 3 GB of the device's memory" in capsys.readouterr().out


def test_table_aligns_columns_and_marks_what_is_missing():
    rows = [{"case": "a", "seconds": 1.23456}, {"case": "long name", "seconds": 10.0, "n": 2}]
    assert common.table(rows).splitlines() == [
        "case       seconds  n",
        "a            1.235  -",
        "long name       10  2",
    ]


def test_misuse_is_refused_with_expected_and_got():
    with pytest.raises(ValueError, match="expected at least one case"):
        common.measure({})
    measured = common.measure({"a": lambda: jnp.ones(1)}, rounds=1)
    with pytest.raises(ValueError, match=r"expected columns for the cases \['a'\], got some for \['b'\]"):
        common.report("demo", measured, settings={}, columns={"b": {}})
