"""What this package does on one accelerator, measured within minutes: ``python -m benchmarks.accelerator --help``.

What comes first matters most. Stages for which no time is left are named, and the same command on the same folder does
them later, with those that failed.
"""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import click

from benchmarks import stages
from ne_dreamer_jax.commands.options import UserPath, interruptible, refusing, say

TINY = ("batch_size=2", "batch_length=8", "behavior.horizon=2")


class Plan(NamedTuple):
    """A stage, and what takes its arguments' place in the smallest setting."""

    name: str
    module: str  # of this folder, or with its package
    arguments: tuple[str, ...]
    smallest: tuple[str, ...]
    seconds: float

    def stage(self, smallest: bool) -> stages.Stage:
        """In one of the two settings."""
        path = self.module if "." in self.module else f"benchmarks.{self.module}"
        return stages.Stage(self.name, path, self.smallest if smallest else self.arguments, self.seconds)


def _set(*assignments: str) -> tuple[str, ...]:
    return tuple(word for assignment in assignments for word in ("--set", f"agent.{assignment}"))


def _update(size: str, dtype: str, seconds: float) -> Plan:
    arguments = ("--size", size, "--rounds", "5", "--no-parts", *_set(f"compute_dtype={dtype}"))
    smallest = ("--size", "1m", "--rounds", "1", "--no-parts", *_set(f"compute_dtype={dtype}", *TINY))
    return Plan(f"an update, {size}, {dtype}", "train_step", arguments, smallest, seconds)


def _rollout(obs: str, *envs: int) -> Plan:
    counts = tuple(word for count in envs for word in ("--envs", str(count)))
    return Plan(
        f"environments, {obs}, {' and '.join(map(str, envs))}", "rollout", (*counts, "--rounds", "3", "--obs", obs),
        ("--envs", "2", "--steps", "2", "--rounds", "1", "--obs", obs), 30,
    )  # fmt: skip


PLANS = (
    _update("12m", "float32", 60),
    _update("12m", "bfloat16", 60),
    Plan("losses beside the CPU's", "agreement", ("--size", "1m"), ("--updates", "2", *_set(*TINY)), 60),
    Plan(
        "a chunk's shares", "loop", ("--task", "dmc/walker_walk", "--size", "12m"),
        ("--size", "1m", "--capacity", "2048", "--rounds", "1", *_set(*TINY)), 90,
    ),
    _rollout("vector", 16, 256),
    _rollout("pixels", 16, 256),
    _rollout("vector", 4096),
    _rollout("pixels", 4096),
    Plan(
        "seeds at once", "seeds", ("--seeds", "1", "--seeds", "8"),
        ("--seeds", "2", "--rounds", "1", *_set(*TINY)), 60,
    ),
    Plan("the same bits again", "repeats", (), ("--updates", "2", *_set(*TINY)), 120),
    Plan(
        "learning", "experiments.probes", ("--method", "ne_dreamer", "--probe", "two_steps", "--seeds", "8"),
        ("--method", "ne_dreamer", "--probe", "bandit", "--seeds", "1"), 90,
    ),
    _update("50m", "bfloat16", 60),
    _update("200m", "bfloat16", 90),
    Plan(
        "Rooms", "rooms", ("--task", "rooms/watermaze", "--rounds", "3"),
        ("--task", "rooms/watermaze", "--envs", "2", "--pictures", "4", "--rounds", "1"), 40,
    ),
    Plan(
        "methods", "methods", ("--size", "12m"),
        ("--size", "1m", "--method", "dreamer_no_reconstruction", "--rounds", "1"), 120,
    ),
    Plan(
        "a chunk, images kept and drawn again", "methods",
        ("--method", "ne_dreamer", "--chunk", "--beside", "loop.storage=states"),
        ("--preset", "laptop", "--method", "ne_dreamer", "--chunk", "--beside", "loop.storage=states", "--rounds", "1",
         *_set(*TINY)), 90,
    ),
    Plan(
        "an image's place", "storage", (),
        ("--rows", "8", "--batch-size", "2", "--batch-length", "4", "--rounds", "1"), 30,
    ),
    Plan(
        "an update's parts, 12m, float32", "train_step", ("--size", "12m", "--rounds", "5"),
        ("--size", "1m", "--rounds", "1", *_set(*TINY)), 120,
    ),
    Plan("memory", "memory", ("--no-compile",), ("--no-compile", "--size", "1m"), 20),
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
    help="Folder of each stage's output and results.jsonl. A folder with results is continued.",
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
)
def main(output: Path, minutes: float, smallest: bool) -> None:
    """Run the benchmarks that tell of an accelerator, the most important first; print and keep what they print.

    It needs JAX for the accelerator, for NVIDIA GPUs by `pip install -e '.[cuda]'`. The same command on the same folder
    runs what was left out or failed.

    Exit code 0: all that was begun is done, be it that stages were left out; 1: a stage failed.
    """
    planned = [plan.stage(smallest) for plan in PLANS]
    with interruptible(), refusing(ValueError, OSError):
        done = stages.tried(output)
        if not smallest and not all(done.get(stage.command) for stage in planned):
            _expect_accelerator()
        count = stages.run(planned, output, math.inf if smallest else minutes)
    say(f"{', '.join(f'{number} {how}' for how, number in count.items())}; figures are in {output}")
    if count["failed"] or count["left out"]:
        say("The same command again does what is missing.")
    raise SystemExit(1 if count["failed"] else 0)


def _expect_accelerator() -> None:
    """Asks a process of its own, as JAX would keep the accelerator's memory. Raises ValueError where there is none."""
    ask = [sys.executable, "-c", "import jax; print(jax.default_backend())"]
    try:
        asked = subprocess.run(ask, capture_output=True, text=True, check=False, timeout=120)
    except subprocess.TimeoutExpired as error:
        raise ValueError("expected an accelerator, JAX did not find its devices within two minutes") from error
    found = (asked.stdout.split() or ["none"])[-1]
    if asked.returncode or found == "cpu":
        raise ValueError(
            f"expected an accelerator, JAX has {found}: {asked.stderr.strip()[-300:] or 'no other device'}\n"
            "For NVIDIA GPUs, pip install -e '.[cuda]'; on a CPU, --smallest shows that all stages run."
        )


if __name__ == "__main__":
    main()
