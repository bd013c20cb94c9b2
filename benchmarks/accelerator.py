"""What this package does on one accelerator, measured within minutes: ``python -m benchmarks.accelerator --help``.

Each stage is a command in a process of its own, so that one that fails, or runs out of memory, costs the others
nothing. What comes first matters most: stages for which no time is left are named and left out.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click

from ne_dreamer_jax.commands.options import UserPath, say

TINY = ("batch_size=2", "batch_length=8", "behavior.horizon=2")


class Stage(NamedTuple):
    """A command, and what takes its arguments' place in the smallest setting."""

    name: str
    module: str  # of this folder, or with its package
    arguments: tuple[str, ...]
    smallest: tuple[str, ...]
    seconds: float  # it is not begun with less time left

    @property
    def path(self) -> str:
        """What ``python -m`` runs."""
        return self.module if "." in self.module else f"benchmarks.{self.module}"


def _set(*assignments: str) -> tuple[str, ...]:
    return tuple(word for assignment in assignments for word in ("--set", f"agent.{assignment}"))


def _update(size: str, dtype: str, seconds: float) -> Stage:
    arguments = ("--size", size, "--rounds", "5", "--no-parts", *_set(f"compute_dtype={dtype}"))
    smallest = ("--size", "1m", "--rounds", "1", "--no-parts", *_set(f"compute_dtype={dtype}", *TINY))
    return Stage(f"an update, {size}, {dtype}", "train_step", arguments, smallest, seconds)


def _rollout(name: str, *arguments: str) -> Stage:
    counts = ("--envs", "16", "--envs", "256", "--envs", "4096", "--rounds", "3")
    return Stage(
        name, "rollout", (*counts, *arguments), ("--envs", "2", "--steps", "2", "--rounds", "1", *arguments), 40
    )


STAGES = (
    _update("12m", "float32", 60),
    _update("12m", "bfloat16", 60),
    Stage("losses beside the CPU's", "agreement", ("--size", "1m"), ("--updates", "2", *_set(*TINY)), 60),
    Stage(
        "a chunk's shares", "loop", ("--task", "dmc/walker_walk", "--size", "12m"),
        ("--size", "1m", "--capacity", "2048", "--rounds", "1", *_set(*TINY)), 90,
    ),
    _rollout("environments, from vectors", "--obs", "vector"),
    _rollout("environments, from pixels", "--obs", "pixels"),
    Stage(
        "seeds at once", "seeds", ("--seeds", "1", "--seeds", "8"),
        ("--seeds", "2", "--rounds", "1", *_set(*TINY)), 60,
    ),
    Stage("the same bits again", "repeats", (), ("--updates", "2", *_set(*TINY)), 120),
    Stage(
        "learning", "experiments.probes", ("--method", "ne_dreamer", "--probe", "two_steps", "--seeds", "8"),
        ("--method", "ne_dreamer", "--probe", "bandit", "--seeds", "1"), 90,
    ),
    _update("50m", "bfloat16", 60),
    _update("200m", "bfloat16", 90),
    Stage(
        "Rooms", "rooms", ("--task", "rooms/watermaze", "--rounds", "3"),
        ("--task", "rooms/watermaze", "--envs", "2", "--pictures", "4", "--rounds", "1"), 40,
    ),
    Stage(
        "methods", "methods", ("--size", "12m"),
        ("--size", "1m", "--method", "dreamer_no_reconstruction", "--rounds", "1"), 120,
    ),
    Stage(
        "a chunk, images kept and drawn again", "methods",
        ("--method", "ne_dreamer", "--chunk", "--beside", "loop.storage=states"),
        ("--preset", "laptop", "--method", "ne_dreamer", "--chunk", "--beside", "loop.storage=states", "--rounds", "1",
         *_set(*TINY)), 90,
    ),
    Stage(
        "an image's place", "storage", (),
        ("--rows", "8", "--batch-size", "2", "--batch-length", "4", "--rounds", "1"), 30,
    ),
    Stage(
        "an update's parts, 12m, float32", "train_step", ("--size", "12m", "--rounds", "5"),
        ("--size", "1m", "--rounds", "1", *_set(*TINY)), 120,
    ),
    Stage("memory", "memory", ("--no-compile",), ("--no-compile", "--size", "1m"), 20),
)  # fmt: skip


@click.command(context_settings={"max_content_width": 110})
@click.option("--output", type=UserPath(), required=True, help="A new folder: each stage's output and results.jsonl.")
@click.option("--minutes", type=click.FloatRange(0, min_open=True), default=9.0, show_default=True, help="In all.")
@click.option(
    "--smallest", is_flag=True, help="All as small as it goes and however long it takes, to see that it runs."
)
def main(output: Path, minutes: float, smallest: bool) -> None:
    """Run the benchmarks that tell of an accelerator, the most important first, and keep what they print."""
    try:
        output.mkdir(parents=True)
    except OSError as error:
        raise click.UsageError(
            f"--output: expected a folder that can be made, got {output}: {error.strerror}"
        ) from error
    deadline, told = time.monotonic() + 60 * minutes, []
    for number, stage in enumerate(STAGES, 1):
        left = deadline - time.monotonic()
        if left < stage.seconds and not smallest:
            told.append(f"{stage.name}: left out, {left:.0f} s are left and {stage.seconds:.0f} are needed")
        else:
            told.append(_run(stage, output, f"{number:02}", smallest, None if smallest else left))
        say(told[-1])
    failed = [line for line in told if ": failed" in line]
    say(f"{len(told) - len(failed)} of {len(told)} stages are done or left out; their figures are in {output}")
    raise SystemExit(1 if failed else 0)


def _run(stage: Stage, output: Path, number: str, smallest: bool, seconds: float | None) -> str:
    """Runs a stage, stores what it prints, and says how it went."""
    arguments = stage.smallest if smallest else stage.arguments
    command = [sys.executable, "-m", stage.path, *arguments]
    begin, file = time.monotonic(), output / f"{number}_{stage.module}.txt"
    with file.open("w", encoding="utf-8") as printed:
        printed.write(f"$ python -m {stage.path} {' '.join(arguments)}\n")
        printed.flush()
        process = subprocess.Popen(command, stdout=printed, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            return f"{stage.name}: failed, it took longer than the {seconds:.0f} s that were left"
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)  # with the processes that it began
                process.wait()
    taken, lines = time.monotonic() - begin, file.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    if code:
        return f"{stage.name}: failed with exit code {code} after {taken:.0f} s: {lines[-1]}"
    with (output / "results.jsonl").open("a", encoding="utf-8") as results:
        for line in _results(lines):
            results.write(json.dumps({"stage": stage.name, "seconds_in_all": taken, **line}) + "\n")
    return f"{stage.name}: done in {taken:.0f} s"


def _results(lines: Sequence[str]) -> list[dict[str, Any]]:
    """The JSON lines that benchmarks print for programs, or all that was printed where there are none."""
    found = [json.loads(line) for line in lines if line.startswith('{"benchmark"')]
    return found or [{"printed": list(lines)}]


if __name__ == "__main__":
    main()
