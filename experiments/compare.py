"""Compares methods on one task: ``python -m experiments.compare --help``.

Runs what is missing of every method and seed, one after the other, each a run of `experiments.train` with a directory
of its own, and draws all of it into one figure.
"""

from __future__ import annotations

import csv
import signal
import statistics
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from experiments.common import Common, common
from ne_dreamer_jax.commands.options import Name, Task, UserPath, refusing, say
from ne_dreamer_jax.runs import run_directory
from ne_dreamer_jax.runs.run_directory import as_argument
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet

if TYPE_CHECKING:
    from ne_dreamer_jax.config import Config
    from ne_dreamer_jax.runs.plots import Curve

PUBLISHED = Path(__file__).parent / "reference" / "dmc_vision_published.csv"
LABELS = {"dreamerv3": "DreamerV3", "drqv2": "DrQ-v2"}


REFUSED = 2
"""Exit code of a command whose arguments do not fit, such as a method that can't act in the task."""


class Found(NamedTuple):
    """A run that has been evaluated at least once."""

    config: Config
    curve: Curve  # environment steps and returns of its evaluations
    random_return: float | None


def command(methods: Sequence[str], help_text: str) -> click.Command:
    """The command that compares these methods, unless told others."""

    @click.command(context_settings={"max_content_width": 110}, help=help_text)
    @click.argument("directory", type=UserPath(file_okay=False))
    @click.option("--task", type=Task(), help="What to learn; default: the preset's.")
    @click.option(
        "--method",
        "chosen",
        type=Name("method", names.METHODS),
        multiple=True,
        help=f"May be repeated. Default: {', '.join(methods)}.",
    )
    @click.option("--seeds", type=click.IntRange(1), default=2, show_default=True, help="Runs of each method.")
    @common("quickstart")
    @click.option("--draw", "only_draw", is_flag=True, help="Train nothing; draw the runs that are there.")
    def main(
        directory: Path,
        task: str | None,
        chosen: tuple[str, ...],
        seeds: int,
        only_draw: bool,
        **settings: Any,
    ) -> None:
        quiet()
        with refusing(run_directory.RefusedError, ValueError):
            failed = {} if only_draw else train_missing(directory, task, chosen or methods, seeds, Common(**settings))
            found = find(directory)
            for line in draw(found, directory / "comparison.png"):
                say(line)
        for (method, seed), code in failed.items():
            why = "refused (its message stands above)" if code == REFUSED else f"exit code {code}"
            say(f"  {method}, seed {seed}, is missing: {why}")
        if failed:
            raise SystemExit(next(iter(failed.values())))

    return main


def train_missing(
    directory: Path, task: str | None, methods: Sequence[str], seeds: int, settings: Common
) -> dict[tuple[str, int], int]:
    """Trains what is not finished yet, and goes on where a run fails.

    A method that can't act in the task is refused once, not for every seed.

    Returns:
      (method, seed) -> exit code, of the runs that failed.

    Raises:
      SystemExit: a run was stopped by a signal, and so is this process.
      RefusedError, ValueError: as `finished`.
    """
    place = lambda method, seed: directory / method.replace("/", "-") / f"seed{seed}"
    expect_evaluations(settings, task, methods)
    # All of them before the first one trains: a run of other settings is no part of this comparison.
    runs = [(method, seed) for seed in range(seeds) for method in methods]
    done = {run for run in runs if finished(place(*run), settings, task, *run)}
    failed: dict[tuple[str, int], int] = {}
    for seed in range(seeds):  # by seed first: all methods are there to be compared as early as can be
        for method in methods:
            path = place(method, seed)
            if failed.get((method, 0)) == REFUSED or (method, seed) in done:
                continue
            say(f"\n{method}, seed {seed}: {path}")
            code = train(path, settings.options(task, method, seed))
            if code in (128 + signal.SIGINT, 128 + signal.SIGTERM):  # somebody stopped the run, and so all of this
                raise SystemExit(code)
            if code:
                failed[method, seed] = code
    return failed


def expect_evaluations(settings: Common, task: str | None, methods: Sequence[str]) -> None:
    """Raises ValueError where a method's runs would have none, or the settings fit no method."""
    refused: list[ValueError] = []
    for method in methods:
        try:
            config = settings.config(task, method, 0)
        except ValueError as error:  # a method that does not fit is refused when its turn comes
            refused.append(error)
            continue
        if config.loop.eval_every is None:
            raise ValueError("loop.eval_every: expected a number of steps, as evaluations are compared, got none")
    if len(refused) == len(methods):
        raise refused[0]


def train(path: Path, options: Sequence[str]) -> int:
    """One run, in a process of its own; its exit code, 128 + n where signal n ended it.

    On Ctrl-C or SIGTERM the run is told, too, and saves itself, which is waited for. Signals that are ignored stay so.

    Raises:
      SystemExit: there was such a signal.
    """
    arguments = [sys.executable, "-m", "ne_dreamer_jax", "train", *options, "--logdir", as_argument(path)]
    stopped: list[int] = []
    run: subprocess.Popen[bytes] | None = None

    def stop(signum: int, _: object) -> None:
        stopped.append(signum)
        if run is not None:  # which takes it and a terminal's own, at the same time, for one
            run.send_signal(signum)

    in_main_thread = threading.current_thread() is threading.main_thread()  # no other hears of signals
    heeded = [signum for signum in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(signum) != signal.SIG_IGN]
    before = {signum: signal.signal(signum, stop) for signum in heeded if in_main_thread}
    try:
        with subprocess.Popen(arguments) as run:
            for signum in stopped:
                run.send_signal(signum)
            code = run.wait()
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
    if stopped:
        raise SystemExit(128 + stopped[0])
    return code if code >= 0 else 128 - code


def finished(path: Path, settings: Common, task: str | None, method: str, seed: int) -> bool:
    """Whether a run has had the last evaluation that is asked for.

    Raises:
      RefusedError: it is a run of other settings, or its configuration can't be read.
      ValueError: the settings do not fit together, or its metrics can't be read.
    """
    files = run_directory.RunDirectory(path)
    if not files.config.exists():
        return False
    from ne_dreamer_jax.runs import metrics, resume

    budget = resume.settle(path, settings.config(task, method, seed)).loop.env_steps
    return any("eval/return" in line and line["env_step"] >= budget for line in metrics.read(files.metrics))


def find(directory: Path) -> list[Found]:
    """All runs under a directory that were evaluated, by path.

    Raises:
      ValueError: there is none.
    """
    from ne_dreamer_jax.config import Config
    from ne_dreamer_jax.runs import metrics

    found = []
    for marker in sorted(directory.rglob(run_directory.MARKER)):
        files = run_directory.RunDirectory(marker.parent)
        lines = metrics.read(files.metrics)
        steps, returns = metrics.series(lines, "eval/return")
        _, of_random = metrics.series(lines, "eval/random_return")
        if len(steps):
            config = run_directory.read_config(marker.parent, Config)
            found.append(Found(config, (steps, returns), float(of_random[-1]) if len(of_random) else None))
    if not found:
        raise ValueError(f"expected runs that have been evaluated under {directory}, got none")
    return found


def draw(found: Sequence[Found], path: Path) -> list[str]:
    """Draws the figure; returns a table of each task, a line a method: mean and range of its last evaluations."""
    from ne_dreamer_jax.runs import pictures, plots

    by_task: dict[str, dict[str, list[Found]]] = {}
    for run in found:
        by_task.setdefault(run.config.env.task, {}).setdefault(run.config.method, []).append(run)
    tasks, lines = [], []
    for task, by_method in sorted(by_task.items()):
        runs = [run for of_method in by_method.values() for run in of_method]
        of_random = [run.random_return for run in runs if run.random_return is not None]
        random_return = statistics.fmean(of_random) if of_random else None
        curves = {method: [run.curve for run in of_method] for method, of_method in by_method.items()}
        env_steps = max(run.config.loop.env_steps for run in runs)
        tasks.append(plots.Task(task, curves, env_steps, random_return, published(task)))
        lines += [*_table(task, by_method), *([] if random_return is None else [_line("random policy", random_return)])]
    failed: list[str] = []
    pictures.attempt(lambda: plots.comparison(tasks, path), path, failed.append)
    return [*lines, *(failed or [f"  {path}"])]


def _table(task: str, by_method: Mapping[str, Sequence[Found]]) -> list[str]:
    """What the methods came to on a task."""
    lines = [f"{task}: return of the last evaluation, mean over seeds (lowest to highest)"]
    for method, runs in by_method.items():
        last = [float(run.curve[1][-1]) for run in runs]
        unfinished = sum(run.curve[0][-1] < run.config.loop.env_steps for run in runs)
        note = f", {unfinished} unfinished" if unfinished else ""
        seeds = f"{len(last)} seed{'s' * (len(last) > 1)}{note}"
        lines.append(f"{_line(method, statistics.fmean(last))} ({min(last):.1f} to {max(last):.1f}), {seeds}")
    return lines


def _line(name: str, value: float) -> str:
    return f"  {name:28} {value:8.1f}"


def published(task: str) -> Mapping[str, Curve]:
    """Label -> published environment steps and returns on a task; empty for one that is not in the file."""
    import numpy as np

    curves: dict[str, tuple[list[float], list[float]]] = {}
    with PUBLISHED.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if f"dmc/{row['task']}" == task:
                steps, returns = curves.setdefault(LABELS[row["method"]], ([], []))
                steps.append(float(row["env_steps"]))
                returns.append(float(row["mean_return"]))
    return {label: (np.asarray(steps), np.asarray(returns)) for label, (steps, returns) in curves.items()}


main = command(
    [name for name in names.METHODS if "/" not in name],
    """Train methods on one task with a few seeds each, and draw them together.

    Each run is kept in DIRECTORY/METHOD/seedN; those that are finished are not run again, and one that was stopped goes
    on. DIRECTORY/comparison.png shows evaluation returns, with a random policy's and, for DeepMind Control, the
    published returns of DreamerV3 and DrQ-v2 from pixels. With --draw DIRECTORY may hold runs of several tasks, such as
    those of experiments.sweep, wherever in it they lie: each task has a part of the figure.
    """,
)

if __name__ == "__main__":
    use_large_pages("experiments.compare")
    main()
