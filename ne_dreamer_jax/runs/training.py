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
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from ne_dreamer_jax import loop as loops
from ne_dreamer_jax.agents import guard, make_agent
from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.agents.dreamer.agent import parameter_counts
from ne_dreamer_jax.config import Config, check
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.envs.base import Env
from ne_dreamer_jax.envs.config import GIVEN, OwnConfig
from ne_dreamer_jax.envs.vector import Host, VectorEnv, check_env
from ne_dreamer_jax.loop import Evaluation, Loop, LoopState, Report
from ne_dreamer_jax.runs import checkpoint, fork, metrics, pictures, plots, progress, run_directory, video
from ne_dreamer_jax.runs.evaluation import mean_and_deviation
from ne_dreamer_jax.runs.metrics import StepCounts
from ne_dreamer_jax.runs.record import Record, Saves, last
from ne_dreamer_jax.runs.run_directory import RunDirectory, typed
from ne_dreamer_jax.runs.schedule import Schedule
from ne_dreamer_jax.runs.signals import Stop
from ne_dreamer_jax.system import compile_cache, memory, parallel
from ne_dreamer_jax.types import images_of

Echo = Callable[[str], None]


class Run(NamedTuple):
    """A configuration made real."""

    config: Config
    agent: Agent
    loop: Loop
    shapes: LoopState  # shapes and dtypes of the whole state
    step_seconds: float | None = None  # simulated time of an agent step
    host: Host | None = None  # where the environments are, if they are not in the program

    @property
    def schedule(self) -> Schedule:
        """When chunks end and evaluations are due."""
        return Schedule.of(self.config, self.loop)


def own(config: Config) -> Config:
    """The configuration of a run on an environment that is given as an object: it says so.

    Each of its steps counts for one environment step, unless the configuration says otherwise in an `OwnConfig`.
    """
    return config if isinstance(config.env, OwnConfig) else replace(config, env=OwnConfig())


def build(config: Config, env: Env | VectorEnv | None = None, mesh: Mesh | None = None) -> Run:
    """Makes the environment, the agent and the loop of a configuration; allocates nothing.

    Args:
      env: what to train in, instead of the environment that the configuration names.
      mesh: of `system.parallel`, to train on several devices.

    Raises:
      ValueError: what does not fit together, or not into memory.
    """
    check(config)
    if env is None:
        env = env_configs.make(config.env)
    else:
        config = own(config)
    check_env(env)
    agent = make_agent(config.agent, env.spec)
    loop = loops.make(config.loop, env, agent, config.env.action_repeat, mesh)
    host = env.host if isinstance(env, VectorEnv) else None
    return Run(config, agent, loop, loop.state_shapes(), env.step_seconds, host)


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
      The exit code: 0 when the run is finished, 128 + the signal's number when it was stopped by one, `DIVERGED` where
      updates were not finite, `NOT_SAVED` where the last checkpoint could not be written, `ENVIRONMENT` where
      environments in worker processes failed.

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
        _tell(run, echo)
        echo(f"Stopped: the environments failed: {run.host.failure}. {last(files, run.loop.frames)}")
        return ENVIRONMENT
    finally:
        run.host.close()


def _train(run: Run, files: RunDirectory, checkpoint_minutes: float, echo: Echo, parent: Path | None) -> int:
    schedule = run.schedule
    if parallel.is_main_process() and run.config.env.task == GIVEN:
        run_directory.store_config(files, run.config)  # which says that the environment was given in code
    start_key, evaluation_key = jax.random.split(jax.random.key(run.config.seed))
    state, lines = _start(run, files, start_key, parent, echo)
    echo(_space(run, files))
    counters = schedule.counters(state)
    pace = progress.Pace(schedule)
    saves = Saves(files, 60 * checkpoint_minutes, echo, run.loop.frames)
    chunk: Any = None
    frames = None
    is_main_process = parallel.is_main_process()
    with metrics.Writer(files.metrics if is_main_process else Path(os.devnull)) as writer, Stop(echo) as stop:
        record = Record(writer, lines, echo)
        if parallel.agreed(files.parent.exists() and counters.env_step == 0)[0]:
            saves.whole(state, counters, None)  # from here on it needs its parent no more
        while True:
            step = counters.agent_step // schedule.num_envs
            missing, with_random = parallel.agreed(
                record.find("eval/return", counters) is None, record.random_return is None
            )
            if schedule.evaluates(step) and missing:
                try:
                    values, frames = evaluate(run, state, evaluation_key, bool(with_random), echo)
                except jax.errors.JaxRuntimeError:
                    if run.host is not None and run.host.failure is not None:  # what was learned is whole
                        saves.whole(state, counters, None)
                    raise
                _tell(run, echo)
                pace.evaluated(values["time/evaluation_seconds"])
                record.write(counters, values)
                if is_main_process:
                    draw(run, files, record, echo)
                gc.collect()  # cycles that wait for their turn lie scattered, and keep whole pages: 10 kB a chunk
            if schedule.evaluates(step) and step < schedule.total:  # at the end everything is saved below
                # Also of an evaluation that stands there already: a kill may have come between the two.
                saves.if_best(state, counters, record.score(counters))
            (stopped_by,) = parallel.agreed(stop.signal or 0)
            if step == schedule.total or stopped_by:
                break
            if chunk is None:
                chunk = _compile(run, echo)
                continue  # in case that somebody wished to stop meanwhile
            steps = np.asarray(schedule.end_of_chunk(step) - step, np.int32)
            began = time.perf_counter()
            state, report = chunk(state, steps)
            report = jax.device_get(report)
            seconds = time.perf_counter() - began
            before, counters = counters, schedule.counters(state)
            values = _named(report, before, counters, seconds)
            record.write(counters, values)
            echo(pace.line(before, counters, values, seconds))
            if int(state.counters.skipped) >= run.config.loop.max_skipped:
                return _diverged(run, files, report, state, echo)
            _tell(run, echo)
            if run.host is not None and run.host.should_stop:
                saves.whole(state, counters, record.score(counters))
                echo(f"Stopped, as an environment failed (env.on_failure=stop). {last(files, run.loop.frames)}")
                return ENVIRONMENT
            if saves.due():
                saves.whole(state, counters, record.score(counters))
        saves.whole(state, counters, record.score(counters), goes_on=False)
        if step < schedule.total:
            if saves.failed:
                echo(f"Stopped after {counters.env_step:,} environment steps, of which the last are lost: see above.")
                return NOT_SAVED
            echo(f"Stopped after {counters.env_step:,} environment steps. The same command goes on from there.")
            return 128 + stopped_by
    return _finish(run, files, state, evaluation_key, record, saves, frames, echo) if is_main_process else 0


def _finish(
    run: Run,
    files: RunDirectory,
    state: LoopState,
    key: jax.Array,
    record: Record,
    saves: Saves,
    frames: Any,
    echo: Echo,
) -> int:
    """What comes after the last step: pictures, a conclusion and the exit code.

    Args:
      key: of the run's evaluations.
      frames: of the last one, if this start of the run had one.
    """
    if not saves.failed:
        saves.prune(keep=1)  # nothing will go on from here
    # Frames of this start's last evaluation are newer than a video from before the run went on beyond an earlier end.
    if run.schedule.evaluation and images_of(run.agent.spec) and not (frames is None and files.video.exists()):
        if frames is None:  # the run was stopped between its last evaluation and here
            frames = evaluate(run, state, key, False, echo)[1]
        pictures.attempt(
            lambda: video.write(frames, files.video, fps=video.frame_rate(run.step_seconds)), files.video, echo
        )
    draw(run, files, record, echo)
    for line in _conclusion(run, files, record, int(state.counters.skipped)):
        echo(line)
    if saves.failed:
        echo(f"The end of this run is not saved. Make room in {files.path}, and give the same command again.")
        return NOT_SAVED
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


def _start(
    run: Run, files: RunDirectory, key: jax.Array, parent: Path | None, echo: Echo
) -> tuple[LoopState, list[dict[str, Any]]]:
    """The state to go on from, and the metrics up to it."""
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
    except (FileNotFoundError, ValueError) as error:  # it was there, and fitted, when the run began
        raise run_directory.RefusedError(f"{parent}, the run to begin with: {error}") from error
    parallel.agreed(0)  # all have looked for a parent before one is written down
    if parallel.is_main_process():
        run_directory.write_parent(files, origin)
    return state._replace(train=parallel.move(train, run.shapes.train))


def _space(run: Run, files: RunDirectory) -> str:
    """What checkpoints take, and whether there is room for them."""
    items = [run.shapes, *([] if run.loop.frames is None else [run.loop.frames.shapes])]
    each = sum(checkpoint.nbytes({"item": item}) for item in items)
    free = checkpoint.free_space(files.path)
    # Two whole ones stand at a time, and one is being written.
    wanted = "three, as there are at times" if each <= free else "one"
    enough = "" if 3 * each <= free else f" WARNING: that is too little for {wanted}"
    return (
        f"A checkpoint takes up to {memory.readable(each)}; {memory.readable(free)} are free in {files.path}.{enough}"
    )


def _same_for_all(files: RunDirectory, env_step: int) -> None:
    if parallel.agreed(env_step) != (env_step,):
        raise run_directory.RefusedError(
            f"expected all processes to find the same checkpoints, got others in {files.checkpoints} of process "
            f"{jax.process_index()}; put --logdir where all of them see it"
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


DIVERGED = 3
"""Exit code of a run that stopped because its updates were not finite."""
NOT_SAVED = 4
"""Exit code of a run whose last checkpoint could not be written."""
ENVIRONMENT = 5
"""Exit code of a run whose environments, in processes of their own, failed."""
NO_EXACT_RESUME = (
    "The environments run in worker processes, which checkpoints do not hold: a run that is stopped and goes on begins "
    "their episodes anew. All else resumes as it was."
)


def _diverged(run: Run, files: RunDirectory, report: Report, state: LoopState, echo: Echo) -> int:
    """Says what happened and what can be done; the state, which no such update has changed, is not saved."""
    counted = {name.removeprefix(guard.PREFIX): value for name, value in report.learning.items()}
    guilty = sorted(name for name, value in counted.items() if f"{guard.PREFIX}{name}" in report.learning and value)
    echo(
        f"Stopped: {int(state.counters.skipped):,} updates in a row were not finite (loop.max_skipped is "
        f"{run.config.loop.max_skipped:,}) and changed nothing. Not finite were: {', '.join(guilty)}. "
        f"{last(files, run.loop.frames)} This command would come to the same point again: begin a new run, with --fork "
        f"{typed(files.path)} from that checkpoint or from the start, with a lower agent.optimizer.learning_rate or "
        "agent.optimizer.agc; look at the size of the rewards; or set JAX_DEBUG_NANS=True to find the first operation."
    )
    return DIVERGED


def _tell(run: Run, echo: Echo) -> None:
    """Says what happened to environments on the host."""
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


def _conclusion(run: Run, files: RunDirectory, record: Record, in_a_row: int) -> list[str]:
    mean, deviation = record.find("eval/return"), record.find("eval/return_std")
    lines = [f"Finished {run.config.loop.env_steps:,} environment steps of {run.config.env.task}."]
    if run.loop.budget.updates == 0:
        lines.append(progress.NOTHING_LEARNED)
    if skipped := sum(line.get("train/skipped_updates", 0) for line in record.lines):
        lines.append(
            f"{skipped:,.0f} of {run.loop.budget.updates:,} updates were skipped, as their numbers were not finite; "
            f"{in_a_row:,} of them in a row at the end."
        )
    if mean is not None and deviation is not None and record.random_return is not None:
        lines.append(
            f"Evaluation return {mean:.1f} ± {deviation:.1f}; a random policy's is "
            f"{record.random_return[0]:.1f} ± {record.random_return[1]:.1f}."
        )
    if files.curve.exists():
        lines.append(f"  {files.curve}: the learning curve")
    if files.video.exists():
        lines.append(f"  {files.video}: an episode of the policy")
    if run.config.env.task == GIVEN:  # no command can make it
        lines.append(f"  ne_dreamer_jax.evaluate({str(files.path)!r}, env=...) in Python: more episodes")
    else:
        lines.append(f"  python -m ne_dreamer_jax evaluate {typed(files.path)}: more episodes")
    return lines
