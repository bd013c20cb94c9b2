"""Pictures of a run, drawn without a display.

Nothing here, and so nothing that trains, imports matplotlib before it draws, and then without ``MPLBACKEND``: a
notebook hands its own backend down to all that it starts, and matplotlib refuses to be imported where that one is not
installed. Neither pyplot nor a backend of the user's has a part in these pictures, nor has a matplotlibrc.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ne_dreamer_jax.files import replacing
from ne_dreamer_jax.runs import metrics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Curve = tuple[np.ndarray, np.ndarray]
"""Environment steps ``[n]``, and returns ``[n]`` there."""
TRAIN, EVALUATION, RANDOM = "#0072b2", "#d55e00", "#666666"  # of the Okabe-Ito palette: apart for every eye
METHODS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8b5a2b", "#999999", "#000000")


def learning_curve(
    lines: Sequence[Mapping[str, Any]],
    path: Path,
    *,
    title: str,
    env_steps: int,
    random_return: tuple[float, float] | None = None,
) -> None:
    """Draws returns against environment steps into a PNG.

    Args:
      lines: of a metrics file, with ``train/return``, ``eval/return`` and ``eval/return_std`` where measured.
      path: of the PNG, replaced whole.
      env_steps: the run's whole budget, which is the width of the picture.
      random_return: mean and standard deviation of a random policy's returns.
    """
    with _picture(path, 7.2, 4.2) as axes:
        _train(axes, *metrics.series(lines, "train/return"))
        _evaluation(axes, lines)
        if random_return is not None:
            mean, deviation = random_return
            axes.axhspan(mean - deviation, mean + deviation, color=RANDOM, alpha=0.12, lw=0)
            axes.axhline(mean, color=RANDOM, lw=1.2, ls="--", label=f"random policy ({mean:.3g})")
        axes.set(title=title, xlabel="environment steps", ylabel="return of an episode", xlim=(0, env_steps))
        _style(axes)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, loc="best")
        else:
            axes.text(0.5, 0.5, "no episode has ended yet", transform=axes.transAxes, ha="center", color=RANDOM)


class Task(NamedTuple):
    """What is drawn of one task."""

    title: str
    curves: Mapping[str, Sequence[Curve]]  # method -> the evaluations of each seed
    env_steps: int  # the runs' budget
    random_return: float | None = None  # mean of a random policy's returns
    published: Mapping[str, Curve] = {}  # label -> published returns


def comparison(tasks: Sequence[Task], path: Path) -> None:
    """Draws evaluation returns of several methods into a PNG, tasks beside each other.

    Each seed is thin, the mean over seeds thick. A method has the same colour in all tasks. What is published within
    the budget is drawn as a curve; if that is less than two points, the first one beyond it is drawn as a level.

    Args:
      tasks: at least one.
      path: of the PNG, replaced whole.
    """
    methods = list(dict.fromkeys(method for task in tasks for method in task.curves))
    colors = dict(zip(methods, itertools.cycle(METHODS), strict=False))
    columns = min(len(tasks), 4)
    rows = -(-len(tasks) // columns)
    alone = len(tasks) == 1
    with figure(*((7.8, 4.6) if alone else (3.0 * columns, 2.5 * rows + 0.4)), dpi=150) as empty:
        panels = empty.subplots(rows, columns, squeeze=False).flatten()
        for axes, task in zip(panels, tasks, strict=False):
            _compare(axes, task, colors, full=alone)
        for axes in panels[len(tasks) :]:
            axes.set_axis_off()
        if alone:
            panels[0].legend(frameon=False, fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
        else:
            handles = {
                label: line for axes in panels for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
            }
            empty.supxlabel("environment steps", fontsize="medium")
            empty.supylabel("evaluation return", fontsize="medium")
            empty.legend(
                handles.values(), handles, loc="outside upper center", ncols=min(5, len(handles)), frameon=False
            )
        save(empty, path)


def _compare(axes: Axes, task: Task, colors: Mapping[str, str], full: bool) -> None:
    """One task's curves; labels have numbers of seeds and returns where ``full``, and are names alone otherwise."""
    for method, seeds in task.curves.items():
        for steps, returns in seeds:
            axes.plot(steps, returns, color=colors[method], lw=0.7, alpha=0.5)
        label = f"{method} ({len(seeds)} seed{'s' * (len(seeds) > 1)})" if full else method
        axes.plot(*mean_over_seeds(seeds), color=colors[method], lw=2, marker="o", ms=3.5, label=label)
    for style, (name, (steps, returns)) in zip(itertools.cycle((":", "-.")), task.published.items(), strict=False):
        within = steps <= task.env_steps
        label = f"{name}, published"
        if within.sum() > 1:
            axes.plot(steps[within], returns[within], color="k", lw=1.2, ls=style, label=label)
        else:
            nearest = min(int(within.sum()), len(steps) - 1)
            told = f"{label}, {steps[nearest]:,.0f} steps ({returns[nearest]:.3g})"
            axes.axhline(returns[nearest], color="k", lw=1.2, ls=style, label=told if full else label)
    if task.random_return is not None:
        label = f"random policy ({task.random_return:.3g})" if full else "random policy"
        axes.axhline(task.random_return, color=RANDOM, lw=1.2, ls="--", label=label)
    axes.set_title(task.title, fontsize="large" if full else "medium")
    axes.set_xlim(0, task.env_steps)
    if full:
        axes.set(xlabel="environment steps", ylabel="evaluation return")
    _style(axes)


def mean_over_seeds(seeds: Sequence[Curve]) -> Curve:
    """Environment steps that every seed was evaluated at, and the mean return there."""
    if not seeds:
        return np.zeros(0), np.zeros(0)
    common = functools.reduce(np.intersect1d, [steps for steps, _ in seeds])
    return common, np.mean([returns[np.isin(steps, common)] for steps, returns in seeds], axis=0)


def _style(axes: Axes) -> None:
    from matplotlib.ticker import EngFormatter

    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.25, lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)


@contextlib.contextmanager
def _picture(path: Path, width: float, height: float) -> Iterator[Axes]:
    """Axes to draw on; at the end of the block the PNG is replaced whole. Sides are in inches of 150 pixels."""
    with figure(width, height, dpi=150) as empty:
        yield empty.subplots()
        save(empty, path)


class Filmstrip(NamedTuple):
    """A row of frames."""

    name: str
    frames: np.ndarray  # uint8 [n, H, W, C], with one or three channels
    titles: Sequence[str]  # above each frame


def filmstrips(strips: Sequence[Filmstrip], path: Path) -> None:
    """Draws rows of frames into a PNG, which is replaced whole."""
    most = max(len(strip.frames) for strip in strips)
    with figure(1.1 * most + 0.6, 1.35 * len(strips), dpi=150) as empty:
        grid = empty.subplots(len(strips), most, squeeze=False)
        for axes, strip in zip(grid, strips, strict=True):
            for i, each in enumerate(axes):
                each.set(xticks=[], yticks=[])
                each.spines[:].set_visible(False)
                if i < len(strip.frames):
                    each.imshow(strip.frames[i].squeeze(), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
                    each.set_title(strip.titles[i], fontsize=7)
            axes[0].set_ylabel(strip.name, fontsize=8)
        save(empty, path)


@contextlib.contextmanager
def figure(width: float, height: float, dpi: int) -> Iterator[Figure]:
    """An empty figure in matplotlib's own style, drawn without a display. Sides are in inches."""
    backend = os.environ.pop("MPLBACKEND", None)
    try:
        import matplotlib.style
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    finally:
        if backend is not None:
            os.environ["MPLBACKEND"] = backend
    with matplotlib.style.context("default"):
        empty = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
        FigureCanvasAgg(empty)
        yield empty


def save(drawn: Figure, path: Path) -> None:
    """Writes a figure as a PNG that is replaced whole."""
    with replacing(path) as beside:
        drawn.canvas.print_figure(beside, format="png")


def _train(axes: Axes, steps: np.ndarray, returns: np.ndarray) -> None:
    if not len(steps):
        return
    window = max(1, len(returns) // 20)
    if window == 1:
        axes.plot(steps, returns, color=TRAIN, lw=1.5, marker="o", ms=3, label="training")
        return
    axes.plot(steps, returns, color=TRAIN, lw=0, marker=".", ms=3, alpha=0.3)
    sums = np.cumsum(np.concatenate([[0.0], returns]))
    first = np.maximum(np.arange(1, len(returns) + 1) - window, 0)
    mean = (sums[1:] - sums[first]) / (np.arange(1, len(returns) + 1) - first)
    axes.plot(steps, mean, color=TRAIN, lw=1.5, label=f"training (mean of {window} points)")


def _evaluation(axes: Axes, lines: Sequence[Mapping[str, Any]]) -> None:
    evaluated = [line for line in lines if np.isfinite(line.get("eval/return", np.nan))]
    if not evaluated:
        return
    steps, means = metrics.series(evaluated, "eval/return")
    deviations = np.array([line.get("eval/return_std", 0.0) for line in evaluated])
    axes.plot(steps, means, color=EVALUATION, lw=2, marker="o", ms=4, label="evaluation, mean and std", clip_on=False)
    axes.fill_between(steps, means - deviations, means + deviations, color=EVALUATION, alpha=0.18, lw=0)
