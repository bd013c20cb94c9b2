"""Trains many runs, here or on a cluster: ``python -m experiments.sweep --help``.

Each run is one `experiments.train` command with a directory of its own, so a sweep that is started again goes on with
what is not finished. submitit starts them: as processes of this machine, or as SLURM jobs.
"""

from __future__ import annotations

import itertools
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click

from experiments.common import Common, common
from ne_dreamer_jax.commands.options import Name, Task, UserPath, refusing, say
from ne_dreamer_jax.runs.run_directory import as_argument
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.quiet import quiet

GPUS = "CUDA_VISIBLE_DEVICES"
POLL = 2.0  # seconds between two looks at the jobs


class Run(NamedTuple):
    """One run of a sweep."""

    name: str  # task/method/seed
    logdir: Path
    command: tuple[str, ...]


class Job:
    """Runs a command in a job; what a preempted job is put back in the queue with, and then goes on."""

    def __init__(self, command: Sequence[str], variables: Mapping[str, str | None] | None = None) -> None:
        """A job of a command.

        Args:
          variables: of the environment, to be set, or for None to be unset, whatever the job's launcher has made them.
        """
        self.command, self.variables = tuple(command), dict(variables or {})
        self._process: subprocess.Popen | None = None

    def __call__(self) -> None:
        """Waits for the command. Raises RuntimeError where it fails."""
        chosen = {**os.environ, **self.variables}
        variables = {name: value for name, value in chosen.items() if value is not None}
        self._process = subprocess.Popen(self.command, env=variables)
        code = self._process.wait()
        if code:
            raise RuntimeError(f"exit code {code}: {shlex.join(self.command)}")

    def checkpoint(self) -> Any:
        """What submitit asks for before a job is taken off its machine: lets the run save itself, and starts anew."""
        from submitit.helpers import DelayedSubmission

        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait()
        return DelayedSubmission(Job(self.command, self.variables))


@click.command(context_settings={"max_content_width": 110})
@click.option("--task", "tasks", type=Task(), multiple=True, required=True, help="May be repeated.")
@click.option(
    "--method",
    "methods",
    type=Name("method", names.METHODS),
    multiple=True,
    default=("ne_dreamer",),
    show_default=True,
    help="May be repeated.",
)
@click.option("--seeds", type=click.IntRange(1), metavar="N", default=3, show_default=True, help="Seeds 0 to N - 1.")
@common("dmc")
@click.option("--logdir", type=UserPath(), metavar="DIRECTORY", required=True, help="Runs are kept below.")
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Runs at a time.")
@click.option("--slurm", is_flag=True, help="Submit SLURM jobs, instead of processes of this machine.")
@click.option("--partition", help="With --slurm: the partition.")
@click.option("--gpus", type=click.IntRange(0), default=1, show_default=True, help="With --slurm: GPUs of a job.")
@click.option("--hours", type=click.IntRange(1), default=24, show_default=True, help="Time limit of a run.")
@click.option("--dry-run", is_flag=True, help="Print the commands and exit.")
def main(
    tasks: tuple[str, ...],
    methods: tuple[str, ...],
    seeds: int,
    logdir: Path,
    jobs: int,
    slurm: bool,
    partition: str | None,
    gpus: int,
    hours: int,
    dry_run: bool,
    **settings: Any,
) -> None:
    """Train every task with every method and seed.

    \b
    Example, on a cluster:
      python -m experiments.sweep --task dmc/walker_walk --task dmc/cheetah_run --seeds 5 --slurm --jobs 10 \\
        --logdir runs/sweep

    Needs the extra "sweep": pip install -e '.[sweep]'.
    """
    if partition is not None and not slurm:
        raise click.UsageError("expected --partition together with --slurm")
    quiet()
    with refusing(ValueError):
        runs = plan(tasks, methods, range(seeds), Common(**settings), logdir)
    if dry_run:
        for run in runs:
            say(shlex.join(run.command))
        return
    try:
        import submitit
    except ImportError as error:
        raise click.UsageError("sweeps need submitit: pip install -e '.[sweep]'") from error
    executor = submitit.AutoExecutor(logdir / "jobs", cluster="slurm" if slurm else "local")
    executor.update_parameters(timeout_min=60 * hours, name="ne_dreamer")
    if slurm:
        executor.update_parameters(gpus_per_node=gpus, **({"slurm_partition": partition} if partition else {}))
    # submitit hides the GPUs from processes of this machine that have asked for none by number.
    variables = {} if slurm else {GPUS: os.environ.get(GPUS)}
    failed = launch(runs, executor, jobs, say, variables)
    say(f"{len(runs) - len(failed)} of {len(runs)} runs finished; their directories are in {logdir}.")
    raise SystemExit(1 if failed else 0)


def plan(
    tasks: Sequence[str], methods: Sequence[str], seeds: Sequence[int], settings: Common, logdir: Path
) -> list[Run]:
    """All runs of a sweep, seed by seed, so that what comes first covers all tasks and methods.

    Raises ValueError where the settings do not fit one of them.
    """
    for task, method in itertools.product(tasks, methods):
        settings.config(task, method, 0)
    runs = []
    for seed, task, method in itertools.product(seeds, dict.fromkeys(tasks), dict.fromkeys(methods)):
        folder = logdir / task.replace("/", "_") / method.replace("/", "_") / f"seed{seed}"
        options = [*settings.options(task, method, seed), "--logdir", as_argument(folder)]
        command = (sys.executable, "-m", "ne_dreamer_jax", "train", *options)
        runs.append(Run(f"{task} {method} seed {seed}", folder, command))
    return runs


def launch(
    runs: Sequence[Run],
    executor: Any,
    at_once: int,
    echo: Callable[[str], None],
    variables: Mapping[str, str | None] | None = None,
) -> list[Run]:
    """Submits the runs, no more than some at once, waits for them all and tells how each ended.

    Args:
      executor: of submitit.
      variables: as of `Job`.

    Returns:
      The runs that failed.
    """
    waiting, failed = list(runs), []
    running: dict[Run, Any] = {}
    while waiting or running:
        while waiting and len(running) < at_once:
            run = waiting.pop(0)
            running[run] = executor.submit(Job(run.command, variables))
            echo(f"started   {run.name}: {running[run].paths.stdout}")
        for run, job in list(running.items()):
            if not job.done():
                continue
            del running[run]
            error = job.exception()
            if error is None:
                echo(f"finished  {run.name}")
            else:
                failed.append(run)
                echo(f"failed    {run.name}: see {job.paths.stderr}")
        if running:
            time.sleep(POLL)
    return failed


if __name__ == "__main__":
    main()
