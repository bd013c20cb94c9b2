"""A training run from its start, or from where it was stopped, to its end.

The host's part of the loop: it compiles the chunk, calls it, writes metrics and checkpoints, evaluates, and draws the
pictures. What a run computes depends on its configuration alone: not on how often it was stopped, nor on when
checkpoints were written.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.agents.dreamer.agent import parameter_counts
from ne_dreamer_jax.envs.config import GIVEN
from ne_dreamer_jax.loop import Evaluation, LoopState, Report
from ne_dreamer_jax.runs import endings, metrics, pictures, plots, progress, run_directory, start, video
from ne_dreamer_jax.runs.building import Run
from ne_dreamer_jax.runs.evaluation import mean_and_deviation
from ne_dreamer_jax.runs.metrics import StepCounts
from ne_dreamer_jax.runs.record import Record, Saves, last
from ne_dreamer_jax.runs.run_directory import RunDirectory
from ne_dreamer_jax.runs.signals import Stop
from ne_dreamer_jax.system import compile_cache, parallel
from ne_dreamer_jax.types import images_of

Echo = Callable[[str], None]

NO_EXACT_RESUME = (
    "The environments run in worker processes, which checkpoints do not hold: a run that is stopped and goes on begins "
    "their episodes anew. All else resumes as it was."
)


def train(
    run: Run, files: RunDirectory, *, checkpoint_minutes: float = 15.0, echo: Echo = print, parent: Path | None = None
) -> int:
    """Trains to the end of the budget, from the newest checkpoint if there is one; ends the environments' processes.

    Where a run has several processes, all of them call this. The main process alone writes files, and decides what
    depends on a clock, a signal or a file.

    Args:
      files: of a directory that is claimed for this configuration; all processes must see the same.
      checkpoint_minutes: time between checkpoints.
      echo: takes the lines for people.
      parent: the run whose agent this one begins with, see `runs.fork`; once begun, it goes on without.

    Returns:
      The exit code: 0 when the run is finished, 128 + the signal's number when it was stopped by one, and those of
      `runs.endings`: `DIVERGED` where updates were not finite, `NOT_SAVED` where the last checkpoint could not be
      written, `ENVIRONMENT` where environments in worker processes failed.

    Raises:
      checkpoint.DamagedError: there are checkpoints, and none is intact.
      run_directory.RefusedError: there is one of an agent of other shapes; or the metrics so far are damaged, or can't
        be written; or processes that train together see different checkpoints; or the run to begin with is gone.
    """
    if run.host is None:
        return _train(run, files, checkpoint_minutes, echo, parent)
    echo(NO_EXACT_RESUME)
    try:
        return _train(run, files, checkpoint_minutes, echo, parent)
    except jax.errors.JaxRuntimeError:
        if run.host.failure is None:
            raise
        _say_failures(run, echo)
        echo(f"Stopped: the environments failed: {run.host.failure}. {last(files, run.loop.frames)}")
        return endings.ENVIRONMENT
    finally:
        run.host.close()


def _train(run: Run, files: RunDirectory, checkpoint_minutes: float, echo: Echo, parent: Path | None) -> int:
    is_main_process = parallel.is_main_process()
    if is_main_process and run.config.env.task == GIVEN:
        run_directory.store_config(files, run.config)  # which says that the environment was given in code
    start_key, evaluation_key = jax.random.split(jax.random.key(run.config.seed))
    state, lines = start.first_state(run, files, start_key, parent, echo)
    echo(start.space(run, files))
    saves = Saves(files, 60 * checkpoint_minutes, echo, run.loop.frames)
    with metrics.Writer(files.metrics if is_main_process else Path(os.devnull)) as writer, Stop(echo) as stop:
        training = _Training(run, files, state, Record(writer, lines, echo), saves, evaluation_key, echo)
        code = training.train_to_end(stop)
    if code is None:
        return training.finish() if is_main_process else 0
    return code


class _Training:
    """One call of `train`: the state of the loop, and the records and checkpoints that are written of it."""

    def __init__(
        self,
        run: Run,
        files: RunDirectory,
        state: LoopState,
        record: Record,
        saves: Saves,
        evaluation_key: jax.Array,
        echo: Echo,
    ) -> None:
        self.run, self.files, self.record, self.saves, self.echo = run, files, record, saves, echo
        self.state, self.evaluation_key = state, evaluation_key
        self.schedule = run.schedule
        self.counters = self.schedule.counters(state)
        self.pace = progress.Pace(self.schedule)
        self.frames: Any = None  # of this start's last evaluation

    @property
    def step(self) -> int:
        """The vector step."""
        return self.counters.agent_step // self.schedule.num_envs

    def train_to_end(self, stop: Stop) -> int | None:
        """Trains chunk after chunk, and evaluates. None at the budget's end; an exit code where it stops before."""
        if parallel.agreed(self.files.parent.exists() and self.counters.env_step == 0)[0]:
            self.saves.whole(self.state, self.counters, None)  # from here on it needs its parent no more
        chunk: Any = None
        while True:
            if self.schedule.evaluates(self.step):
                self._evaluate()
            (stopped_by,) = parallel.agreed(stop.signal or 0)
            if self.step == self.schedule.total or stopped_by:
                return self._end(stopped_by)
            if chunk is None:
                chunk = _compile(self.run, self.echo)
                continue  # in case that somebody wished to stop meanwhile
            report = self._advance(chunk)
            code = self._halted(report)
            if code is not None:
                return code
            if self.saves.due():
                self._save_whole()

    def _evaluate(self) -> None:
        """Evaluates, unless that is recorded for this step already, and keeps the agent if it is the best."""
        run, record, counters = self.run, self.record, self.counters
        missing, with_random = parallel.agreed(
            record.find("eval/return", counters) is None, record.random_return is None
        )
        if missing:
            try:
                values, self.frames = evaluate(run, self.state, self.evaluation_key, bool(with_random), self.echo)
            except jax.errors.JaxRuntimeError:
                if run.host is not None and run.host.failure is not None:  # what was learned is whole
                    self.saves.whole(self.state, counters, None)
                raise
            _say_failures(run, self.echo)
            self.pace.evaluated(values["time/evaluation_seconds"])
            record.write(counters, values)
            if parallel.is_main_process():
                draw(run, self.files, record, self.echo)
            gc.collect()  # cycles that wait for their turn lie scattered, and keep whole pages: 10 kB a chunk
        if self.step < self.schedule.total:  # at the end everything is saved
            # Also of an evaluation that stands there already: a kill may have come between the two.
            self.saves.if_best(self.state, counters, record.score(counters))

    def _advance(self, chunk: Any) -> Report:
        """Trains to the end of a chunk, and records it."""
        steps = np.asarray(self.schedule.end_of_chunk(self.step) - self.step, np.int32)
        began = time.perf_counter()
        self.state, report = chunk(self.state, steps)
        report = jax.device_get(report)
        seconds = time.perf_counter() - began
        before, self.counters = self.counters, self.schedule.counters(self.state)
        values = _named(report, before, self.counters, seconds)
        self.record.write(self.counters, values)
        self.echo(self.pace.line(before, self.counters, values, seconds))
        return report

    def _halted(self, report: Report) -> int | None:
        """The exit code where a chunk's updates or environments leave no way to go on."""
        run = self.run
        if int(self.state.counters.skipped) >= run.config.loop.max_skipped:
            # Not saved: skipped updates changed no parameter, and going on from here would skip again.
            self.echo(endings.diverged(run, self.files, report, self.state))
            return endings.DIVERGED
        _say_failures(run, self.echo)
        if run.host is not None and run.host.should_stop:
            self._save_whole()
            self.echo(f"Stopped, as an environment failed (env.on_failure=stop). {last(self.files, run.loop.frames)}")
            return endings.ENVIRONMENT
        return None

    def _save_whole(self, goes_on: bool = True) -> None:
        self.saves.whole(self.state, self.counters, self.record.score(self.counters), goes_on=goes_on)

    def _end(self, stopped_by: int) -> int | None:
        """Saves everything; the exit code where that is before the end of the budget."""
        self._save_whole(goes_on=False)
        if self.step == self.schedule.total:
            return None
        trained = f"Stopped after {self.counters.env_step:,} environment steps"
        if self.saves.failed:
            self.echo(f"{trained}, of which the last are lost: see above.")
            return endings.NOT_SAVED
        self.echo(f"{trained}. The same command goes on from there.")
        return 128 + stopped_by

    def finish(self) -> int:
        """What comes after the last step: pictures, a conclusion and the exit code."""
        run, files, saves, echo = self.run, self.files, self.saves, self.echo
        if not saves.failed:
            saves.prune(keep=1)  # nothing will go on from here
        # Frames of this start's last evaluation are newer than a video from before the run went on beyond its end.
        video_stands = self.frames is None and files.video.exists()
        if run.schedule.evaluation and images_of(run.agent.spec) and not video_stands:
            frames = self.frames
            if frames is None:  # the run was stopped between its last evaluation and here
                frames = evaluate(run, self.state, self.evaluation_key, False, echo)[1]
            pictures.attempt(
                lambda: video.write(frames, files.video, fps=video.frame_rate(run.step_seconds)), files.video, echo
            )
        draw(run, files, self.record, echo)
        for line in endings.conclusion(run, files, self.record, int(self.state.counters.skipped)):
            echo(line)
        if saves.failed:
            echo(f"The end of this run is not saved. Make room in {files.path}, and give the same command again.")
            return endings.NOT_SAVED
        return 0


def evaluate(run: Run, state: LoopState, key: jax.Array, with_random: bool, echo: Echo) -> tuple[dict[str, float], Any]:
    """Metrics of an evaluation on environments of its own, and the frames of one of its episodes.

    Args:
      key: of the run's evaluations; every step has its own episodes.
      with_random: whether to evaluate a random policy too.
    """
    policy_key, random_key = jax.random.split(jax.random.fold_in(key, int(state.counters.vector_step)))
    values: dict[str, float] = {}
    if with_random:
        echo("Compiling the evaluation, and playing episodes with a random policy.")
        values |= _returns(run.loop.evaluate(state.train.params, random_key, random=True, frames=True), "eval/random_")
    began = time.perf_counter()
    evaluation = run.loop.evaluate(state.train.params, policy_key, frames=True)
    values |= _returns(evaluation, "eval/")
    values["time/evaluation_seconds"] = seconds = time.perf_counter() - began
    values["eval/cut_episodes"] = cut = int((~np.asarray(evaluation.complete)).sum())
    values["eval/finite"] = finite = bool(_finite(state.train.params))
    echo(
        f"Evaluation: return {values['eval/return']:.1f} ± {values['eval/return_std']:.1f} over "
        f"{len(evaluation.returns)} episodes, in {progress.duration(seconds)}."
    )
    if evaluation.unfinished:
        echo(
            f"{evaluation.unfinished} of {len(evaluation.returns)} episodes had not ended after "
            f"{run.config.loop.eval_max_steps:,} steps (loop.eval_max_steps)."
        )
    if not finite:
        echo("The agent has diverged: some of its parameters are not finite. It is not kept as the best.")
    elif cut:
        echo(
            f"{cut} of the episodes were cut short by faults of the environment, so that this agent is not kept as the "
            "best."
        )
    return values, evaluation.frames


def draw(run: Run, files: RunDirectory, record: Record, echo: Echo) -> None:
    """Draws the learning curve so far, if that can be."""
    config = run.config
    parameters = sum(parameter_counts(run.shapes.train.params).values())
    title = f"{config.env.task}, {config.method}, {parameters / 1e6:.1f}M parameters, seed {config.seed}"
    steps, random_return = config.loop.env_steps, record.random_return
    pictures.attempt(
        lambda: plots.learning_curve(
            record.lines, files.curve, title=title, env_steps=steps, random_return=random_return
        ),
        files.curve,
        echo,
    )


def _compile(run: Run, echo: Echo) -> Callable[[LoopState, jax.Array], Any]:
    draws = "and draw " if images_of(run.agent.spec) else ""
    echo(f"Compiling the training chunk: act, step {draws}the environments, store, sample, update.")
    jitted: Any = run.loop.chunk
    began = time.perf_counter()
    # Of shapes, not of the state: one that was restored lies where it was put, and would make another program of it.
    lowered = jitted.lower(run.shapes, jax.ShapeDtypeStruct((), jnp.int32))
    traced = time.perf_counter()
    with compile_cache.hits() as hits:
        compiled = lowered.compile()
    done = time.perf_counter()
    how = "loaded from the cache" if hits else "compiled"
    echo(f"Traced in {traced - began:.1f} s, {how} in {done - traced:.1f} s.")
    return compiled


def _say_failures(run: Run, echo: Echo) -> None:
    """Says what failed in environments on the host, if there are any."""
    for line in run.host.lines() if run.host is not None else ():
        echo(line)


@jax.jit
def _finite(params: Any) -> jax.Array:
    """Whether all parameters are finite numbers."""
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(params)]).all()


def _named(report: Report, before: StepCounts, after: StepCounts, seconds: float) -> dict[str, float]:
    """A chunk's metrics under their names."""
    rates = {
        "time/chunk_seconds": seconds,
        "time/env_steps_per_second": (after.env_step - before.env_step) / seconds,
        "time/updates_per_second": (after.update - before.update) / seconds,
    }
    return {f"train/{name}": value for name, value in report.means().items()} | rates


def _returns(evaluation: Evaluation, prefix: str) -> dict[str, float]:
    mean, deviation = mean_and_deviation(np.asarray(evaluation.returns, np.float64))
    return {f"{prefix}return": mean, f"{prefix}return_std": deviation}
