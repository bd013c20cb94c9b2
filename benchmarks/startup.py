"""From the command to the first update, with an empty cache of compiled programs and again with a full one.

Each checkout trains in a directory of its own until it has learned a little, twice; checkouts take turns. Processor
seconds count what all threads did, and say more than seconds on a machine that others use.

Usage: python -m benchmarks.startup --preset quickstart, or python -m benchmarks.startup ../before .
"""

from __future__ import annotations

import math
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import click

from benchmarks.checkout import Checkout
from ne_dreamer_jax.commands.options import Name, Task, refusing
from ne_dreamer_jax.settings import names

CHECKOUT = Checkout("experiments/__init__.py", "experiments/train.py", "ne_dreamer_jax/__init__.py")
OTHER_CACHES = {"JAX_COMPILATION_CACHE_DIR", "NE_DREAMER_JAX_CACHE"}
"""Variables that would keep programs elsewhere, or not at all."""
TRACED = re.compile(r"Traced in ([\d.]+) s, (.*) in ([\d.]+) s")


class Start(NamedTuple):
    """What a command took until it ended, just after its first updates."""

    wall: float  # seconds
    processor: float  # seconds of all threads
    chunk: str  # what the command said of tracing and compiling the training chunk


@click.command(help=__doc__, context_settings={"show_default": True, "max_content_width": 110})
@click.argument("checkouts", nargs=-1, type=CHECKOUT)
@click.option("--preset", type=Name("preset", names.PRESETS), default="quickstart")
@click.option("--size", type=Name("size", names.SIZES), help="Default: the preset's own.")
@click.option("--task", type=Task(), help="Default: the preset's.")
@click.option("--rounds", type=click.IntRange(1), default=3, help="Cold and warm starts of each.")
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
def main(
    checkouts: tuple[Path, ...],
    preset: str,
    size: str | None,
    task: str | None,
    rounds: int,
    assignments: tuple[str, ...],
) -> None:
    """Prints seconds of a cold and of a warm start, medians over the rounds."""
    options = ["--preset", preset, *(["--size", size] if size else []), *(["--task", task] if task else [])]
    with refusing(ValueError):
        least = shortest(preset, size, task, assignments)
    for assignment in (*assignments, *least):
        options += ["--set", assignment]
    places = checkouts or (Path(),)
    starts: dict[tuple[Path, str], list[Start]] = {}
    for _ in range(rounds):
        for place in places:
            with tempfile.TemporaryDirectory() as directory:
                for how in ("cold", "warm"):
                    began = start(place.resolve(), options, Path(directory), how)
                    starts.setdefault((place, how), []).append(began)
                    click.echo(f"{place} {how}: {began.wall:.1f} s, {began.processor:.1f} of processors; {began.chunk}")
    click.echo("medians")
    for (place, how), found in starts.items():
        wall, processor = (statistics.median(values) for values in zip(*(s[:2] for s in found), strict=True))
        click.echo(f"{place} {how}: {wall:.1f} s, {processor:.1f} of processors")


def shortest(preset: str, size: str | None, task: str | None, assignments: Sequence[str]) -> Sequence[str]:
    """Settings of a run that is over after its first updates. Raises ValueError for settings that don't fit."""
    from ne_dreamer_jax.commands.train import configure
    from ne_dreamer_jax.loop.budget import Budget

    config = configure(preset, size, None, {"env.task": task}, assignments)
    budget = Budget.of(config.loop, config.agent.batch_size, config.agent.batch_length, config.env.action_repeat)
    learning = 1 + math.ceil(budget.update_cost / budget.step_credit)
    steps = (budget.prefill + learning) * budget.num_envs * budget.action_repeat
    return f"loop.env_steps={steps}", "loop.eval_every=none"


def start(checkout: Path, options: Sequence[str], directory: Path, name: str) -> Start:
    """Trains once. Raises ClickException, with the end of what was printed, where the command fails."""
    command = [sys.executable, "-m", "experiments.train", *options, "--logdir", str(directory / name)]
    kept = {name: value for name, value in os.environ.items() if name not in OTHER_CACHES}
    environment = {**kept, "XDG_CACHE_HOME": str(directory), "PYTHONPATH": str(checkout)}
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=False)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise click.ClickException(
            f"{checkout}: expected training to end well, got exit code {done.returncode}: {done.stderr[-2000:]}"
        )
    traced = TRACED.search(done.stdout)
    chunk = "" if traced is None else f"the chunk traced in {traced[1]} s, {traced[2]} in {traced[3]} s"
    return Start(wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, chunk)


if __name__ == "__main__":
    main()
