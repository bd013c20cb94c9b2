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
from typing import TYPE_CHECKING, Any

import numpy as np

from ne_dreamer_jax.files import replacing
from ne_dreamer_jax.runs import metrics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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


def comparison(
    curves: Mapping[str, Sequence[tuple[np.ndarray, np.ndarray]]],
    path: Path,
    *,
    title: str,
    env_steps: int,
    random_return: float | None = None,
    published: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> None:
    """Draws evaluation returns of several methods into a PNG: each seed thin, the mean over seeds thick.

    Args:
      curves: method -> (environment steps ``[n]``, returns ``[n]``) of each seed.
      path: of the PNG, replaced whole.
      env_steps: the runs' budget.
      random_return: mean of a random policy's returns.
      published: label -> (environment steps, returns). What lies within the budget is drawn as a curve; if fewer than
        two points do, the first point beyond it is drawn as a level.
    """
    with _picture(path, 7.8, 4.6) as axes:
        for color, (method, seeds) in zip(itertools.cycle(METHODS), curves.items(), strict=False):
            for steps, returns in seeds:
                axes.plot(steps, returns, color=color, lw=0.7, alpha=0.5)
            label = f"{method} ({len(seeds)} seed{'s' * (len(seeds) > 1)})"
            axes.plot(*mean_over_seeds(seeds), color=color, lw=2, marker="o", ms=3.5, label=label)
        for style, (label, (steps, returns)) in zip(itertools.cycle((":", "-.")), published.items(), strict=False):
            within = steps <= env_steps
            if within.sum() > 1:
                axes.plot(steps[within], returns[within], color="k", lw=1.2, ls=style, label=f"{label}, published")
            else:
                nearest = min(int(within.sum()), len(steps) - 1)
                told = f"{label}, published, {steps[nearest]:,.0f} steps ({returns[nearest]:.3g})"
                axes.axhline(returns[nearest], color="k", lw=1.2, ls=style, label=told)
        if random_return is not None:
            axes.axhline(random_return, color=RANDOM, lw=1.2, ls="--", label=f"random policy ({random_return:.3g})")
        axes.set(title=title, xlabel="environment steps", ylabel="evaluation return", xlim=(0, env_steps))
        _style(axes)
        axes.legend(frameon=False, fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))


def mean_over_seeds(seeds: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
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
