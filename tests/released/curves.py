"""Lays learning curves of the authors' code over ours: ``python -m tests.released.curves OUT RUN...``.

A RUN is a directory of `learn`, or of ``experiments.train`` with the command that `learn` prints. For each task
OUT/TASK.png shows the returns of the evaluations, each seed's and their means; what is printed beside it are the
differences from the authors' code, with 95 % intervals and p-values (Welch), of the last evaluation and of the mean
over evaluations. Our runs in ``dm_control:TASK`` are laid beside those in ``dmc/TASK``. Needs scipy, and no PyTorch.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from experiments.switches import difference
from ne_dreamer_jax import settings
from ne_dreamer_jax.commands.options import refusing
from ne_dreamer_jax.config import Config
from ne_dreamer_jax.runs import metrics, plots, run_directory

MARKER = "released.json"
"""What marks a run of the authors' code: its setting, as ours."""
THEIRS, AS_PUBLISHED, OURS = "released code", "released code as published", "this package"
CHOSEN = {"seed", "env", "env.task", "loop.eval_every", "loop.chunk_steps"}
"""Settings in which runs that are compared may differ; tasks are compared one by one."""


class Run(NamedTuple):
    """What was measured of one seed."""

    path: Path
    label: str
    config: Config
    steps: np.ndarray  # environment steps of the evaluations
    returns: np.ndarray


def read(path: Path) -> Run:
    """A run of either. Raises ValueError or RefusedError where there is none, or none that was evaluated."""
    if (path / MARKER).exists():
        said: dict[str, Any] = json.loads((path / MARKER).read_text(encoding="utf-8"))
        label = AS_PUBLISHED if said["as_published"] else THEIRS
        config = settings.from_dict(Config, said["config"])
    else:
        config = run_directory.read_config(path, Config)
        family, separator, _ = config.env.task.partition(":")
        label = f"{OURS}, in {family}" if separator else OURS
    steps, returns = metrics.series(metrics.read(path / "metrics.jsonl"), "eval/return")
    if not len(steps):
        raise ValueError(f"expected a run that was evaluated, got none in {path}")
    return Run(path, label, config, steps, returns)


def task_of(run: Run) -> str:
    """The task's name, whichever simulator it runs in."""
    return re.split("[/:]", run.config.env.task)[-1]


def check_same(runs: Sequence[Run]) -> None:
    """Raises ValueError where runs of a task have other settings than their seeds, or a seed comes twice."""
    first, seen = runs[0], set()
    before = settings.paths(first.config)
    for run in runs:
        after = settings.paths(run.config)
        alone = {name for name in before.keys() ^ after.keys() if name.startswith("env.")}  # another simulator's
        changed = {name for name in before | after if before.get(name) != after.get(name)}
        if different := changed - alone - CHOSEN:
            raise ValueError(f"expected runs of one setting, got others in {first.path} and {run.path}: {different}")
        if (run.label, run.config.seed) in seen:
            raise ValueError(f"expected each seed once, got seed {run.config.seed} again in {run.path}")
        seen.add((run.label, run.config.seed))


def table(by_label: Mapping[str, Sequence[Run]]) -> list[str]:
    """Lines about the runs of one task, at the environment steps at which all of them were evaluated."""
    every = [run.steps for runs in by_label.values() for run in runs]
    common = functools.reduce(np.intersect1d, every)
    common = common[common > 0]
    if not len(common):
        raise ValueError("expected runs that were evaluated at the same environment steps, got none in common")
    curves = {
        label: np.array([run.returns[np.isin(run.steps, common)] for run in runs]) for label, runs in by_label.items()
    }
    base = next((label for label in (THEIRS, AS_PUBLISHED) if label in curves), next(iter(curves)))
    lines = [f"{len(common)} evaluations in common, the last at {common[-1]:,.0f} environment steps"]
    for label, returns in curves.items():
        for name, values in measured(returns).items():
            seeds = " ".join(f"{x:.1f}" for x in values)
            lines.append(f"  {label:26} {name:26} {values.mean():8.1f}   seeds: {seeds}")
            if label != base:
                lines.append(f"  {'':26} {'':26} {compared(values, measured(curves[base])[name])}, from {base}")
    return lines


def measured(returns: np.ndarray) -> dict[str, np.ndarray]:
    """What is compared of curves [seeds, evaluations], one number a seed."""
    return {"last evaluation": returns[:, -1], "mean over evaluations": returns.mean(axis=1)}


def compared(values: np.ndarray, others: np.ndarray) -> str:
    """Difference of two means with its 95 % interval and p-value, as text."""
    from scipy import stats

    if min(len(values), len(others)) < 2:
        return f"{values.mean() - others.mean():+.1f} (one seed has no interval)"
    p = stats.ttest_ind(values, others, equal_var=False).pvalue
    return f"{difference(values, others)}, p = {p:.3f}"


@click.command()
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
@click.argument("paths", metavar="RUN...", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
def main(out: Path, paths: tuple[Path, ...]) -> None:
    """Compare runs of the authors' code and of this package, task by task."""
    out.mkdir(parents=True, exist_ok=True)
    with refusing(ValueError, run_directory.RefusedError):
        found = [read(path) for path in paths]
        for task in dict.fromkeys(task_of(run) for run in found):
            runs = [run for run in found if task_of(run) == task]
            check_same(runs)
            labels = sorted({run.label for run in runs}, key=lambda label: (label.startswith(OURS), label))
            by_label = {label: [run for run in runs if run.label == label] for label in labels}
            picture = out / f"{task}.png"
            curves = {label: [(run.steps, run.returns) for run in each] for label, each in by_label.items()}
            budget = runs[0].config.loop.env_steps
            plots.comparison([plots.Task(f"{task}, from vectors", curves, budget)], picture)
            click.echo(f"{task}: {picture}")
            for line in table(by_label):
                click.echo(line)


if __name__ == "__main__":
    main()
