"""metrics.jsonl: what a run measured, one JSON object a line.

Each line holds the counters ``env_step`` (simulator steps, action repeat counted), ``agent_step`` (actions chosen, over
all environments) and ``update`` (train steps), then names such as ``train/loss/next_embedding``, ``train/return`` or
``eval/return``, and at last ``crc32``, a checksum of all before it. A name that was not measured at that step is
absent; a value that was not finite is null, as JSON has no other word for it, and reads back as NaN.

A run that goes on from a checkpoint first drops the lines past the checkpoint's step (`resume`): they are about to be
written again, the same but for what starts with ``time/``. So no line stands twice in the file, and one that was cut
in the middle heals. Standard library and numpy only.
"""

from __future__ import annotations

import contextlib
import json
import math
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, SupportsFloat

import numpy as np

from ne_dreamer_jax.files import replacing

COUNTERS = ("env_step", "agent_step", "update")
CHECKSUM = "crc32"


class StepCounts(NamedTuple):
    """How far a run is."""

    env_step: int  # simulator steps, action repeat counted, over all environments
    agent_step: int  # actions chosen, over all environments
    update: int  # train steps


class Writer:
    """Appends lines to a metrics file; each is on its way to disk when `write` returns."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="utf-8")

    def write(self, counters: StepCounts, values: Mapping[str, SupportsFloat]) -> None:
        """Appends one line.

        Args:
          values: name -> scalar. Integers stay integers.

        Raises:
          ValueError: a name that is a counter's.
        """
        taken = sorted(set(values) & {*COUNTERS, CHECKSUM})
        if taken:
            raise ValueError(f"expected names other than the counters {COUNTERS} and {CHECKSUM}, got {taken}")
        line = counters._asdict() | {name: _number(value) for name, value in values.items()}
        self._file.write(json.dumps(line | {CHECKSUM: _checksum(line)}, allow_nan=False) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Closes the file; what a full disk has not taken by now is lost."""
        with contextlib.suppress(OSError):
            self._file.close()

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read(path: Path) -> list[dict[str, Any]]:
    """All lines of a metrics file, without their checksums and null as NaN; empty where there is no file.

    A last line without its end, as a crash leaves it, is left out. Version 0.2 wrote lines without checksums; they are
    taken where they come first.

    Raises:
      ValueError: another line that is no JSON object of numbers with the counters, or whose checksum does not hold; the
        message names file and line.
    """
    if not path.exists():
        return []
    lines: list[dict[str, Any]] = []
    checked = False
    for number, text in enumerate(path.read_bytes().splitlines(keepends=True), start=1):
        if not text.endswith(b"\n"):
            break
        line = _parse(text)
        checked = checked or (line is not None and CHECKSUM in line)
        if line is None or (checked and line.pop(CHECKSUM, None) != _checksum(line)):
            raise ValueError(
                f"{path}, line {number}: expected a JSON object with {', '.join(COUNTERS)} whose checksum fits, got "
                f"{text.decode(errors='replace').strip()[:80]!r}. Remove the line (the others say "
                "all they said), or restore the file"
            )
        lines.append({name: math.nan if value is None else value for name, value in line.items()})
    return lines


def _parse(text: bytes) -> dict[str, Any] | None:
    """A line as an object of numbers with the counters; None for anything else."""
    try:
        line = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(line, dict) or not all(isinstance(line.get(counter), int) for counter in COUNTERS):
        return None
    return line if all(value is None or isinstance(value, int | float) for value in line.values()) else None


def _checksum(line: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(line).encode())


def resume(path: Path, env_step: int) -> list[dict[str, Any]]:
    """Drops the lines past a checkpoint's step and returns those that stay.

    The file is replaced whole, so that it never stands half written.
    """
    kept = [line for line in read(path) if line["env_step"] <= env_step]
    with replacing(path, sync=True) as beside, Writer(beside) as writer:
        for line in kept:
            values = {name: value for name, value in line.items() if name not in COUNTERS}
            writer.write(StepCounts(*(line[counter] for counter in COUNTERS)), values)
    return kept


def series(
    lines: Iterable[Mapping[str, Any]], name: str, *, against: str = "env_step"
) -> tuple[np.ndarray, np.ndarray]:
    """One metric as a curve: float64 ``[n]`` steps and values, of the lines where it stands and is finite."""
    pairs = [(line[against], line[name]) for line in lines if math.isfinite(line.get(name, math.nan))]
    steps, values = zip(*pairs, strict=True) if pairs else ((), ())
    return np.asarray(steps, np.float64), np.asarray(values, np.float64)


def _number(value: SupportsFloat) -> int | float | None:
    if isinstance(value, int):
        return int(value)
    array = np.asarray(value)
    if array.shape != ():
        raise ValueError(f"expected a scalar, got an array of shape {array.shape}")
    number = array.item()
    return number if math.isfinite(number) else None
