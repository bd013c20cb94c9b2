"""What this package does on one accelerator, measured within minutes: ``python -m benchmarks.accelerator --help``.

Each stage is a command in a process of its own, so that one that fails, or runs out of memory, costs the others
nothing. What comes first matters most: stages for which no time is left are named, and the same command on the same
folder does them later, with those that failed.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import click

from ne_dreamer_jax.commands.options import UserPath, say

RESULTS = "results.jsonl"
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


def _rollout(obs: str, *envs: int) -> Stage:
    counts = tuple(word for count in envs for word in ("--envs", str(count)))
    return Stage(
        f"environments, {obs}, {' and '.join(map(str, envs))}", "rollout", (*counts, "--rounds", "3", "--obs", obs),
        ("--envs", "2", "--steps", "2", "--rounds", "1", "--obs", obs), 30,
    )  # fmt: skip


STAGES = (
    _update("12m", "float32", 60),
    _update("12m", "bfloat16", 60),
    Stage("losses beside the CPU's", "agreement", ("--size", "1m"), ("--updates", "2", *_set(*TINY)), 60),
    Stage(
        "a chunk's shares", "loop", ("--task", "dmc/walker_walk", "--size", "12m"),
        ("--size", "1m", "--capacity", "2048", "--rounds", "1", *_set(*TINY)), 90,
    ),
    _rollout("vector", 16, 256),
    _rollout("pixels", 16, 256),
    _rollout("vector", 4096),
    _rollout("pixels", 4096),
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


def _finite(_: click.Context, parameter: click.Parameter, value: float) -> float:
    if not math.isfinite(value):
        raise click.BadParameter(f"expected a finite number of minutes, got {value}", param=parameter)
    return value


@click.command(context_settings={"max_content_width": 110})
@click.option(
    "--output",
    type=UserPath(),
    required=True,
    help="Folder of each stage's output and results.jsonl. One with results is gone on with.",
)
@click.option(
    "--minutes",
    type=click.FloatRange(0, min_open=True),
    default=9.0,
    show_default=True,
    callback=_finite,
    help="For all stages together.",
)
@click.option(
    "--smallest", is_flag=True, help="All as small as it goes and however long it takes, to see that it runs on a CPU."
)  # fmt: skip
def main(output: Path, minutes: float, smallest: bool) -> None:
    """Run the benchmarks that tell of an accelerator, the most important first; print and keep what they print.

    It needs JAX for the accelerator, for NVIDIA GPUs by `pip install -e '.[cuda]'`. The same command on the same folder
    runs what was left out or failed. Exit code 1: a stage failed.
    """
    done = _done(output, smallest)
    if not smallest:
        _expect_accelerator()
    with _refusing(output):
        output.mkdir(parents=True, exist_ok=True)
        (output / RESULTS).touch()
    with _unwinding_on_sigterm():
        count = _run_all(output, done, smallest, time.monotonic() + 60 * minutes)
    say(f"{', '.join(f'{number} {how}' for how, number in count.items())}; figures are in {output}")
    if count["failed"] or count["left out"]:
        say("The same command again does what is missing.")
    raise SystemExit(1 if count["failed"] else 0)


def _run_all(output: Path, done: set[str], smallest: bool, deadline: float) -> dict[str, int]:
    """Runs the stages that are not done, and says how each went; how many are done, failed and were left out."""
    count = {"done": 0, "failed": 0, "left out": 0}
    for number, stage in enumerate(STAGES, 1):
        if stage.name in done:
            count["done"] += 1
            continue
        left = math.inf if smallest else deadline - time.monotonic()
        if left < stage.seconds:
            how, told = "left out", f"left out, {max(left, 0):.0f} s are left and {stage.seconds:.0f} are needed"
        else:
            how, told = _run(stage, output, f"{number:02}", smallest, None if smallest else left)
        count[how] += 1
        say(f"{stage.name}: {told}\n")
    return count


def _done(output: Path, smallest: bool) -> set[str]:
    """The names of stages that are done in the folder, if there is one.

    Raises:
      UsageError: it holds something else, or was begun in the other setting.
    """
    if not output.exists():
        return set()
    results = output / RESULTS
    with _refusing(output):
        if any(output.iterdir()) and not results.exists():
            raise click.UsageError(
                f"--output: expected a new folder or one with {RESULTS}, got {output}, which holds something else; "
                "choose another name"
            )
        text = results.read_text(encoding="utf-8") if results.exists() else ""
        lines = [json.loads(line) for line in text.splitlines()]
    if any(line["smallest"] != smallest for line in lines):
        raise click.UsageError(
            f"--output: {output} was begun {'without' if smallest else 'with'} --smallest; choose another name"
        )
    return {line["stage"] for line in lines}


@contextlib.contextmanager
def _refusing(output: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise click.UsageError(
            f"--output: expected a folder of this benchmark or a new one that can be made, got {output}: {error}"
        ) from error


@contextlib.contextmanager
def _unwinding_on_sigterm() -> Iterator[None]:
    """Within the block SIGTERM unwinds the stack, as Ctrl-C does, so that a stage does not outlive this process."""

    def leave(number: int, _: Any) -> NoReturn:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _expect_accelerator() -> None:
    """Asks a process of its own, as JAX would keep the accelerator's memory. Raises UsageError where there is none."""
    asked = subprocess.run(
        [sys.executable, "-c", "import jax; print(jax.default_backend())"], capture_output=True, text=True, check=False
    )
    found = (asked.stdout.split() or ["none"])[-1]
    if asked.returncode or found == "cpu":
        raise click.UsageError(
            f"expected an accelerator, JAX has {found}: {asked.stderr.strip()[-300:] or 'no other device'}\n"
            "For NVIDIA GPUs, pip install -e '.[cuda]'; on a CPU, --smallest shows that all stages run."
        )


def _run(stage: Stage, output: Path, number: str, smallest: bool, seconds: float | None) -> tuple[str, str]:
    """Runs a stage and stores what it prints; "done" or "failed", and how it went."""
    arguments = stage.smallest if smallest else stage.arguments
    command = [sys.executable, "-m", stage.path, *arguments]
    begin, file = time.monotonic(), output / f"{number}_{stage.module}.txt"
    with file.open("ab") as printed:
        before = printed.tell()  # what an earlier try printed stays
        printed.write(f"$ python -m {stage.path} {' '.join(arguments)}\n".encode())
        printed.flush()
        process = subprocess.Popen(command, stdout=printed, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            return "failed", f"failed, it took longer than the {seconds:.0f} s that were left"
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)  # with the processes that it began
                process.wait()
    taken = time.monotonic() - begin
    lines = file.read_bytes()[before:].decode("utf-8", errors="replace").strip().splitlines()
    say("\n".join(line for line in lines if not _is_result(line)))
    if code:
        return "failed", f"failed with exit code {code} after {taken:.0f} s"
    with (output / RESULTS).open("a", encoding="utf-8") as results:
        for line in _results(lines):
            told = {"stage": stage.name, "smallest": smallest, "seconds_in_all": taken, **line}
            results.write(json.dumps(told) + "\n")
    return "done", f"done in {taken:.0f} s"


def _is_result(line: str) -> bool:
    return line.startswith('{"benchmark"')


def _results(lines: Sequence[str]) -> list[dict[str, Any]]:
    """The JSON lines that benchmarks print for programs, or all that was printed where there are none."""
    return [json.loads(line) for line in lines if _is_result(line)] or [{"printed": list(lines)}]


if __name__ == "__main__":
    main()
