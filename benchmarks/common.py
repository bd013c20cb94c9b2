"""What every benchmark shares: honest timing, a unit that travels between machines, and one way of printing.

A figure in seconds says as much about the machine and its other tenants as about the code. So every benchmark times
its cases in interleaved rounds, with a 2048 x 2048 x 2048 float32 matrix product before each round and after the
last, and prints each case's median beside the median of those products: seconds / GEMM seconds = "GEMM units".

A benchmark reads::

    measured = measure({"forward": lambda: forward(x), "gradient": lambda: gradient(x)}, rounds=5)
    report("conv", measured, settings={"batch": 16})
"""

from __future__ import annotations

import json
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.system import processors

GEMM_SIZE = 2048
Value = str | int | float | None


class Timing(NamedTuple):
    """Seconds of one case over all rounds."""

    first: float  # the first call: trace, compile and run
    median: float
    low: float
    high: float
    rounds: int


class Measured(NamedTuple):
    """What `measure` returns."""

    gemm: Timing  # of one GEMM_SIZE-cubed float32 matrix product, around and between the rounds
    cases: dict[str, Timing]

    def units(self, case: str) -> float:
        """Median time of a case in GEMM units."""
        return self.cases[case].median / self.gemm.median


def seconds(function: Callable[[], Any]) -> float:
    """Wall-clock seconds of one call, until every array in its result is ready."""
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def measure(cases: Mapping[str, Callable[[], Any]], *, rounds: int = 5, warmup: int = 1) -> Measured:
    """Time the cases in interleaved rounds, so that what else the machine does falls on all of them alike.

    Args:
      cases: name -> function of no arguments whose result holds everything to wait for. A function that donates its
        input keeps the state it returned and feeds that to its next call.
      rounds: calls of each case that count.
      warmup: calls of each case that do not, at least one: the first is where it compiles.

    Raises:
      ValueError: no case, or fewer than one round or warm-up call.
    """
    if not cases or rounds < 1 or warmup < 1:
        raise ValueError(
            f"expected at least one case, round and warm-up call, got {len(cases)} cases, {rounds=} and {warmup=}"
        )
    gemm = _gemm()
    first = {name: seconds(case) for name, case in cases.items()}
    first_gemm = seconds(gemm)
    for _ in range(warmup - 1):
        for case in cases.values():
            seconds(case)
    times: dict[str, list[float]] = {name: [] for name in cases}
    gemms = []
    for _ in range(rounds):
        gemms.append(seconds(gemm))
        for name, case in cases.items():
            times[name].append(seconds(case))
    gemms.append(seconds(gemm))
    return Measured(_timing(first_gemm, gemms), {name: _timing(first[name], times[name]) for name in cases})


def report(
    name: str,
    measured: Measured,
    *,
    settings: Mapping[str, Value],
    columns: Mapping[str, Mapping[str, Value]] | None = None,
) -> dict[str, Any]:
    """Print a table for people, then the same as one JSON line for programs; returns what the line holds.

    Args:
      name: of the benchmark.
      settings: what was run: sizes, task, dtype.
      columns: case -> column -> value, further figures beside a case's times, such as frames a second.
    """
    columns = columns or {}
    unknown = sorted(set(columns) - set(measured.cases))
    if unknown:
        raise ValueError(f"expected columns for the cases {sorted(measured.cases)}, got some for {unknown}")
    rows = [
        {
            "case": case,
            "seconds": timing.median,
            "low": timing.low,
            "high": timing.high,
            "gemm_units": measured.units(case),
            "first_call": timing.first,
            **columns.get(case, {}),
        }
        for case, timing in measured.cases.items()
    ]
    gemm = measured.gemm
    gflops = 2 * GEMM_SIZE**3 / gemm.median / 1e9
    rounds = next(iter(measured.cases.values())).rounds
    print(f"{name}: {', '.join(f'{key} {value}' for key, value in settings.items())}")
    print(f"on {machine()}; medians of {rounds} interleaved rounds")
    print(
        f"one GEMM unit (a {GEMM_SIZE}^3 float32 matrix product): {gemm.median:.4g} s, "
        f"{gemm.low:.4g} to {gemm.high:.4g}, {gflops:.0f} GFLOP/s"
    )
    if (peak := peak_bytes()) is not None:
        print(f"at most {peak / 1e9:.3g} GB of the device's memory were in use at once, in the whole process")
    print()
    print(table(rows))
    line = {
        "benchmark": name,
        "machine": machine(),
        "settings": dict(settings),
        "rounds": rounds,
        "gemm_seconds": gemm.median,
        "peak_bytes": peak_bytes(),
        "rows": rows,
    }
    print("\n" + json.dumps(line))
    return line


def peak_bytes() -> int | None:
    """The most of the first device's memory that this process has held at once; None where the device can't tell."""
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")


def table(rows: Sequence[Mapping[str, Value]]) -> str:
    """Rows as aligned text, one column for each key that occurs, in order of first appearance."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    cells = [keys, *([_format(row.get(key)) for key in keys] for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(keys))]
    numeric = [all(not isinstance(row.get(key), str) for row in rows) for key in keys]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(line, widths, numeric, strict=True)
        ).rstrip()
        for line in cells
    )


def machine() -> str:
    """One line: the devices that JAX computes on, the processor with the cores this process may use, and versions."""
    devices = jax.devices()
    kinds = f"{len(devices)} x {devices[0].device_kind}" if devices[0].platform != "cpu" else "CPU only"
    cores = processors.available()
    return f"{kinds}, {_processor()} ({cores} cores), jax {jax.__version__}, Python {platform.python_version()}"


def _gemm() -> Callable[[], jax.Array]:
    shape = (GEMM_SIZE, GEMM_SIZE)
    a, b = (jax.random.normal(jax.random.key(seed), shape, jnp.float32) for seed in (0, 1))

    # True float32: the default precision of some accelerators would round the factors first.
    @jax.jit
    def product(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)

    return lambda: product(a, b)


def _timing(first: float, times: Sequence[float]) -> Timing:
    return Timing(first, statistics.median(times), min(times), max(times), len(times))


def _format(value: Value) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            names = [line.split(":", 1)[1].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or platform.machine()
