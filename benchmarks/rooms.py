"""Times Rooms tasks with their pictures, beside Memory Maze in turns: ``python -m benchmarks.rooms --help``."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from typing import Any

import click

from ne_dreamer_jax.commands.options import Name
from ne_dreamer_jax.envs.rooms import names
from ne_dreamer_jax.system.quiet import quiet

TASKS = (
    "rooms/collect_good_objects",
    "rooms/exploit_deferred_effects",
    "rooms/select_nonmatching_object",
    "rooms/watermaze",
)
MAZE = "memory maze 9x9"
MAZE_STEPS = 20  # of each process in a timed call
WORKER = """
import os, sys
os.environ.setdefault("MUJOCO_GL", "egl")
import numpy as np
from memory_maze import tasks
env, rng = tasks.memory_maze_9x9(), np.random.default_rng(0)
env.reset()
print("ready", flush=True)
for line in sys.stdin:
    for _ in range(int(line)):
        env.step(rng.integers(6))
    print("done", flush=True)
"""


@click.command(context_settings={"max_content_width": 110})
@click.option("--task", "tasks", type=Name("Rooms task", names.NAMES), multiple=True, default=TASKS, show_default=True)
@click.option(
    "--envs", "counts", type=click.IntRange(1), multiple=True, default=(16, 256, 4096), show_default=True,
    help="Environments stepped together. May be repeated.",
)  # fmt: skip
@click.option("--pictures", type=click.IntRange(1), default=1_024, show_default=True, help="At least, in a timed call.")
@click.option("--rounds", type=click.IntRange(1), default=3, show_default=True)
@click.option(
    "--memory-maze-python",
    type=click.Path(exists=True, dir_okay=False),
    help="A Python with the packages memory-maze and gym: Memory Maze is timed, too, a process for each core. "
    "MUJOCO_GL says what draws it, egl by default.",
)
def main(
    tasks: tuple[str, ...], counts: tuple[int, ...], pictures: int, rounds: int, memory_maze_python: str | None
) -> None:
    """Agent steps a second with random actions, each with its picture of 64 x 64, and how many times Memory Maze's."""
    quiet()
    from benchmarks import common, rollout

    steps_of: dict[str, int] = {}
    cases: dict[str, Callable[[], Any]] = {}
    for task in dict.fromkeys(tasks):
        for n in dict.fromkeys(counts):
            length = max(1, pictures // n)
            steps_of[name := f"{task} x {n}"] = n * length
            cases[name] = rollout.rollout(task, n, length)
    workers = [] if memory_maze_python is None else start(memory_maze_python)
    if workers:
        steps_of[MAZE] = MAZE_STEPS * len(workers)
        cases[MAZE] = lambda: step(workers)
    measured = common.measure(cases, rounds=rounds)
    for worker in workers:
        worker.communicate()
    rates = {name: steps_of[name] / timing.median for name, timing in measured.cases.items()}
    maze = {name: {"times_memory_maze": rate / rates[MAZE]} if workers else {} for name, rate in rates.items()}
    columns: dict[str, dict[str, Any]] = {
        name: {"agent_steps_per_s": rate, **maze[name]} for name, rate in rates.items()
    }
    common.report("rooms", measured, settings={"image_size": 64, "pictures": pictures}, columns=columns)


def start(python: str) -> list[subprocess.Popen[str]]:
    """A process with a Memory Maze for each core that this one may use, when all are ready."""
    from ne_dreamer_jax.system import processors

    cores, pipe = processors.available(), subprocess.PIPE
    workers = [subprocess.Popen([python, "-c", WORKER], stdin=pipe, stdout=pipe, text=True) for _ in range(cores)]
    for worker in workers:
        expect(worker, "ready")
    return workers


def step(workers: list[subprocess.Popen[str]]) -> None:
    """Some steps of every maze, side by side."""
    for worker in workers:
        assert worker.stdin is not None
        worker.stdin.write(f"{MAZE_STEPS}\n")
        worker.stdin.flush()
    for worker in workers:
        expect(worker, "done")


def expect(worker: subprocess.Popen[str], answer: str) -> None:
    """Waits for a line that ends with ``answer``; whatever else the packages print is passed over."""
    assert worker.stdout is not None
    for line in worker.stdout:
        if line.strip() == answer:
            return
    raise SystemExit(
        "--memory-maze-python: expected memory-maze, gym and a way to draw there; its process ended, see above"
    )


if __name__ == "__main__":
    main()
