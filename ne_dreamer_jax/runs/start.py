"""What training starts from: the run's newest whole checkpoint, another run's agent, or nothing."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from ne_dreamer_jax import settings
from ne_dreamer_jax.config import Config
from ne_dreamer_jax.loop import LoopState
from ne_dreamer_jax.runs import arrays, checkpoint, fork, metrics, run_directory
from ne_dreamer_jax.runs.building import Run
from ne_dreamer_jax.runs.run_directory import RunDirectory, typed
from ne_dreamer_jax.system import memory, parallel

Echo = Callable[[str], None]


def first_state(
    run: Run, files: RunDirectory, key: jax.Array, parent: Path | None, echo: Echo
) -> tuple[LoopState, list[dict[str, Any]]]:
    """The state to go on from, and the metrics up to it.

    Args:
      files: of the run; all processes must see the same.
      key: of a start from nothing.
      parent: the run whose agent this one begins with, where it has no checkpoint yet.

    Raises:
      checkpoint.DamagedError, run_directory.RefusedError: as `runs.training.train`.
    """
    shapes, is_main_process = run.shapes, parallel.is_main_process()
    if jax.process_count() > 1:  # each reads the whole and keeps its share
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), shapes)
    apart: Any = ()
    like: dict[str, Any] = {"agent": shapes.train, "loop": shapes._replace(train=apart)}
    if run.loop.frames is not None:
        like["frames"] = run.loop.frames.shapes
    began = time.perf_counter()
    try:
        restored = checkpoint.restore(files.checkpoints, like)
    except FileNotFoundError:
        _same_for_all(files, -1)
        state = jax.block_until_ready(run.loop.init(key))
        parent = parent or fork.parent_of(files)  # which stands there where the first start was cut short
        if parent is not None:
            state = _taken_over(run, files, parent, shapes.train, state, echo)
        echo(f"Made the agent, the environments and replay in {time.perf_counter() - began:.1f} s.")
        if is_main_process:
            _set_aside(files, echo)
        return state, _lines(files, -1) if is_main_process else []
    except ValueError as error:
        raise run_directory.RefusedError(str(error)) from error
    except checkpoint.DamagedError as error:
        raise checkpoint.DamagedError(f"{error}{_agent_left(files, shapes.train)}") from error
    for reason in restored.skipped:
        echo(f"Passed over a damaged checkpoint: {reason}")
    env_step = restored.checkpoint.step
    echo(f"Going on from {restored.checkpoint.path}, {env_step:,} environment steps.")
    _same_for_all(files, env_step)
    if is_main_process:
        _take_out(restored)
    if run.loop.frames is not None:
        run.loop.frames.load(restored.items["frames"])
    state = restored.items["loop"]._replace(train=restored.items["agent"])
    return parallel.move(state, run.shapes), _lines(files, env_step) if is_main_process else []


def _agent_left(files: RunDirectory, like: Any) -> str:
    """What can still be done with a run that can't go on: a sentence, or nothing."""
    try:
        found = checkpoint.restore(files.checkpoints, {"agent": like}).checkpoint
    except (checkpoint.DamagedError, FileNotFoundError, ValueError):
        return ""
    return f" The agent of {found.path} is intact: --fork {typed(files.path)} begins a new run with it"


def _take_out(restored: checkpoint.Restored) -> None:
    """Lets no checkpoint stand as whole that is damaged: it would keep the run from saving that step again."""
    for found, item in restored.damaged:
        try:
            checkpoint.take_out(found, item)
        except OSError as error:
            raise run_directory.RefusedError(f"{found.path} can't be written to: {error.strerror or error}") from error


def _set_aside(files: RunDirectory, echo: Echo) -> None:
    """Keeps the metrics of a run that begins anew, as its checkpoints are gone, or were never written."""
    try:
        if files.metrics.exists() and files.metrics.stat().st_size:
            kept = files.metrics.rename(files.earlier_metrics)
            echo(f"There is no checkpoint: beginning anew. The metrics so far are in {kept}.")
    except OSError as error:
        raise run_directory.RefusedError(f"{files.metrics} can't be kept: {error.strerror or error}") from error


def _lines(files: RunDirectory, env_step: int) -> list[dict[str, Any]]:
    """The metrics up to a step; what stands behind it is dropped."""
    try:
        return metrics.resume(files.metrics, env_step)
    except OSError as error:
        raise run_directory.RefusedError(f"{files.metrics} can't be written: {error.strerror or error}") from error
    except ValueError as error:
        raise run_directory.RefusedError(str(error)) from error


def _taken_over(run: Run, files: RunDirectory, parent: Path, like: Any, state: LoopState, echo: Echo) -> LoopState:
    """The state with the agent of another run, which ``parent.json`` then names."""
    try:
        train, origin = fork.agent(parent, like, echo)
    except (FileNotFoundError, ValueError, checkpoint.DamagedError) as error:  # there, and fitting, when the run began
        raise run_directory.RefusedError(f"{parent}, the run to begin with: {error}") from error
    parallel.agreed(0)  # all have looked for a parent before one is written down
    if parallel.is_main_process():
        run_directory.write_parent(files, origin)
    return state._replace(train=parallel.move(train, run.shapes.train))


def space(run: Run, files: RunDirectory) -> str:
    """What checkpoints take, and whether there is room for them."""
    items = [run.shapes, *([] if run.loop.frames is None else [run.loop.frames.shapes])]
    each = sum(arrays.nbytes(item) for item in items)
    free = checkpoint.free_space(files.path)
    # Two whole ones stand at a time, and one is being written.
    wanted = "three, as there are at times" if each <= free else "one"
    enough = "" if 3 * each <= free else f" WARNING: that is too little for {wanted}"
    return (
        f"A checkpoint takes up to {memory.readable(each)}; {memory.readable(free)} are free in {files.path}.{enough}"
    )


def check_processes(config: Config, devices: int, parent: Path | None) -> None:
    """Refuses processes that train together under different options; all call it, before one claims a directory.

    Args:
      devices: how many there are, of all processes.
      parent: as of `first_state`.

    Raises:
      RefusedError: in each of them, if one has others.
    """
    options = [settings.to_dict(config), devices, parent and str(parent.resolve())]
    if not parallel.same(json.dumps(options, sort_keys=True)):
        raise run_directory.RefusedError(
            "expected the same options in all processes that train together, got others in at least one of them"
        )


def _same_for_all(files: RunDirectory, env_step: int) -> None:
    if not parallel.same(str(env_step)):
        raise run_directory.RefusedError(
            f"expected all processes to find the same checkpoints, got others in {files.checkpoints} of process "
            f"{jax.process_index()}; put --logdir where all of them see it"
        )
