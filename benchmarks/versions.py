"""A training chunk of the quickstart in several checkouts of this repository, timed in turns on one machine.

Each checkout trains by its own quickstart, so that the programs differ where presets do. It has a process of its own,
which compiles the chunk and then waits; they take turns, so that what else the machine does falls on all of them alike.

Usage: git worktree add ../before HEAD~10; python -m benchmarks.versions ../before .
"""

from __future__ import annotations

import statistics
import subprocess
import sys
from pathlib import Path

import click

from benchmarks.checkout import Checkout

CHECKOUT = Checkout("ne_dreamer_jax/__init__.py", "ne_dreamer_jax/config.py")
WORKER = """
import sys, time
sys.path.insert(0, sys.argv[1])
import dataclasses, jax, jax.numpy as jnp
from ne_dreamer_jax import config as configs, envs, loop as loops, make_agent
config = configs.preset("quickstart")
env = envs.make(config.env.task, obs="pixels", action_repeat=2, image_size=config.env.image_size)
options = dataclasses.replace(config.loop, prefill=200)
loop = loops.make(options, env, make_agent(config.agent, env.spec), 2)
state = loop.init(jax.random.key(0))
steps = lambda n: jnp.asarray(n, jnp.int32)
state, _ = loop.chunk(state, steps(40))
jax.block_until_ready(state.counters)
print("ready", flush=True)
for _ in sys.stdin:
    begin = time.perf_counter()
    state, report = loop.chunk(state, steps(8))
    jax.block_until_ready(report)
    print(time.perf_counter() - begin, flush=True)
"""


@click.command(help=__doc__, context_settings={"show_default": True})
@click.argument("checkouts", nargs=-1, required=True, type=CHECKOUT)
@click.option("--rounds", type=click.IntRange(1), default=20, help="Chunks timed of each.")
def main(checkouts: tuple[Path, ...], rounds: int) -> None:
    """Prints milliseconds of a chunk of 8 vector steps, updates included, and its ratio to the first checkout's."""
    command = [sys.executable, "-W", "ignore", "-c", WORKER]
    workers = [
        subprocess.Popen([*command, str(path.resolve())], stdin=-1, stdout=-1, text=True, cwd=path)
        for path in checkouts
    ]
    for path, worker in zip(checkouts, workers, strict=True):
        if ask(worker, "") != "ready":
            raise SystemExit(f"{path}: expected a checkout of this repository; its process ended, see above")
    seconds: list[list[float]] = [[] for _ in workers]
    for number in range(rounds):
        order = range(len(workers)) if number % 2 else reversed(range(len(workers)))
        for i in order:
            seconds[i].append(float(ask(workers[i], "go\n")))
    for path, values in zip(checkouts, seconds, strict=True):
        ratio = statistics.median(value / first for value, first in zip(values, seconds[0], strict=True))
        click.echo(f"{path}: {1e3 * statistics.median(values):.0f} ms, {ratio:.3f} of the first")
    for worker in workers:
        worker.communicate()


def ask(worker: subprocess.Popen[str], line: str) -> str:
    """Writes a line to a worker, and reads its answer."""
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write(line)
    worker.stdin.flush()
    return worker.stdout.readline().strip()


if __name__ == "__main__":
    main()
