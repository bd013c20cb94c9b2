"""A child that saves, while calls fail or until it is killed: ``python -m tests.faults.saving WHAT DIRECTORY ...``.

``faults DIRECTORY``: reads lines of JSON, a fault each, lets it happen in a save, and writes what came out as a line.
``kills DIRECTORY SEED``: saves a state that changes, again and again, and says after each save which content stands.
"""

from __future__ import annotations

import json
import random
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from ne_dreamer_jax.loop import Counters, LoopState
from ne_dreamer_jax.runs import checkpoint, metrics, run_directory
from ne_dreamer_jax.runs.metrics import StepCounts
from ne_dreamer_jax.runs.record import Record, Saves
from ne_dreamer_jax.runs.run_directory import RunDirectory
from ne_dreamer_jax.system.quiet import quiet
from tests.faults.shim import Shim
from tests.test_run_directory import Config


def state(value: int) -> LoopState:
    """A small state of a run, other for each value."""
    nothing: Any = ()
    zeros = [jnp.zeros((), jnp.int32) for _ in range(3)]
    train: Any = {"kernel": jnp.full((40, 40), value, jnp.float32), "key": jax.random.key(value)}
    return LoopState(
        train, nothing, nothing, jnp.full((9,), value % 251, jnp.uint8), nothing, Counters(*zeros), nothing
    )


def content(directory: Path) -> tuple[int, int, str]:
    """Step, value and digest of what loads from a folder of checkpoints."""
    nothing: Any = ()
    whole = state(0)
    like = {"agent": whole.train, "loop": whole._replace(train=nothing)}
    found, items, *_ = checkpoint.restore(directory, like)
    digest = checkpoint.digest(found, "agent") + checkpoint.digest(found, "loop")
    return found.step, int(items["agent"]["kernel"][0, 0]), digest


def fail(shim: Shim, files: RunDirectory, fault: dict[str, Any]) -> dict[str, Any]:
    """One fault in a save of the step that stands there, or of a new one, with a line of metrics before."""
    said: list[str] = []
    with metrics.Writer(files.metrics) as writer:
        record, saves = Record(writer, [], said.append), Saves(files, 0.0, said.append)
        before = content(files.checkpoints)
        step = before[0] + fault["forward"]
        counters = StepCounts(step, step, step)
        with shim.failing(fault["kind"], fault["number"], fault["error"], fault["lasting"]):
            record.write(counters, {"x": 1.0})
            saves.whole(state(fault["value"]), counters, float(fault["value"]))
            counts = shim.counts()
        after = content(files.checkpoints)
        stands = "new" if after[:2] == (step, fault["value"]) else "old" if after == before else "neither"
        return {"said": said, "stands": stands, "failed": saves.failed, "hits": shim.hits, "counts": counts}


def faults(path: Path) -> None:
    """Serves faults from standard input."""
    shim = Shim(path)
    with run_directory.claim(path, Config()) as files:
        Saves(files, 0.0, lambda line: None).whole(state(0), StepCounts(1, 1, 1), 0.0)
        for line in sys.stdin:
            print(json.dumps(fail(shim, files, json.loads(line))), flush=True)


def kills(path: Path, seed: int) -> None:
    """Saves until the end of the process; the same step now and then, as a run does whose evaluation came late."""
    draw = random.Random(seed)
    with run_directory.claim(path, Config()) as files:
        step, value = 0, 1000 * seed
        while True:
            step, value = step + draw.randint(0, 1), value + 1
            Saves(files, 0.0, lambda line: None).whole(state(value), StepCounts(step, step, step), float(value))
            print(*content(files.checkpoints), flush=True)


if __name__ == "__main__":
    quiet()
    if sys.argv[1] == "faults":
        faults(Path(sys.argv[2]))
    else:
        kills(Path(sys.argv[2]), int(sys.argv[3]))
