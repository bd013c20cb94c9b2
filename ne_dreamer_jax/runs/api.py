"""One call that trains, for people who write their experiments in Python."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from jax.sharding import Mesh

from ne_dreamer_jax.config import Config
from ne_dreamer_jax.runs import building, progress, resume, run_directory, start, training
from ne_dreamer_jax.runs import fork as forks
from ne_dreamer_jax.runs.run_directory import RunDirectory
from ne_dreamer_jax.system import compile_cache
from ne_dreamer_jax.system.quiet import quiet


class Outcome(NamedTuple):
    """How a call of `train` ended."""

    files: RunDirectory
    """Where everything lies."""
    code: int
    """0 when the run is finished, 128 + the signal's number when it was stopped by one, else as of `training.train`."""


def train(
    config: Config,
    logdir: str | Path,
    env: Any = None,
    *,
    checkpoint_minutes: float = 15.0,
    fork: str | Path | None = None,
    mesh: Mesh | None = None,
    echo: Callable[[str], None] = print,
) -> Outcome:
    """Trains an agent, with all that the command has: checkpoints, metrics, evaluations, pictures, resuming.

    Called again with the same configuration and directory it goes on, and ends with the same bits. What may change
    meanwhile says `runs.resume`: more ``loop.env_steps``, and how often and long evaluations are.

    Args:
      config: what to train; see `config.preset`.
      logdir: the run's directory, made if need be.
      env: an environment of one's own, an ``envs.base.Env`` (``env.spec``, ``env.reset``, ``env.step``, ...; see
        ``envs.base.from_core``), in place of the one that the configuration names. The run's ``config.json`` then says
        that the environment was given in code: to go on and to evaluate, give it again. Where each of its steps is
        several of the simulation's, say so with ``env=envs.config.OwnConfig(action_repeat=...)`` in ``config``; else
        ``loop.env_steps`` counts its own steps.
      checkpoint_minutes: time between checkpoints.
      fork: the directory of another run, whose agent this one begins with: parameters, optimiser and number of updates
        of its newest good checkpoint. Replay and environments are new. Settings may be others as long as the agent has
        the same shapes and the environment the same observations and actions. ``parent.json`` then names it.
      mesh: of ``system.parallel.make_mesh``, to train on several devices.
      echo: takes the lines for people; ``lambda line: None`` for none.

    Raises:
      ValueError: settings that do not fit each other, the environment, the memory or the agent of ``fork``.
      RefusedError: the directory holds another run, or anything else, or is in use.
      DamagedError: there are checkpoints, and none that can be used.
    """
    quiet()
    path = Path(logdir).expanduser()
    config = config if env is None else building.own(config)
    run_directory.check(path)
    parent = None if fork is None else Path(fork).expanduser()
    config = resume.settle(path, config)
    if parent is not None:
        forks.check(parent, path)
    changed = resume.changes(path, config)
    compile_cache.enable()
    run = building.build(config, env, mesh)
    if parent is not None:
        forks.check_agent(parent, path, config, run.agent.spec, run.shapes.train)
    start.check_processes(config, 1 if mesh is None else mesh.size, parent)
    for line in progress.describe(config, run.loop, run.shapes, changed):
        echo(line)
    with run_directory.claim(path, config, resume.differences) as files:
        code = training.train(run, files, checkpoint_minutes=checkpoint_minutes, echo=echo, parent=parent)
        return Outcome(files, code)
