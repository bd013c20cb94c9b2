"""Trains an agent: ``python -m ne_dreamer_jax train --help``.

Names are checked here, before JAX loads; `runs.training` does the work.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from ne_dreamer_jax import envs, settings
from ne_dreamer_jax.commands.options import Name, Task, UserPath, find_devices, interruptible, refusing, say
from ne_dreamer_jax.runs import run_directory
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.quiet import quiet

if TYPE_CHECKING:
    from ne_dreamer_jax.config import Config

FLAGS = {  # option -> the setting that it changes
    "task": "env.task",
    "obs": "env.obs",
    "seed": "seed",
    "env_steps": "loop.env_steps",
    "num_envs": "loop.num_envs",
    "replay_ratio": "loop.replay_ratio",
}


class Minutes(click.FloatRange):
    """A time; not-a-number is none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number of minutes."""
        minutes = super().convert(value, param, ctx)
        if math.isnan(minutes):
            self.fail(f"expected a number of minutes, got {value!r}", param, ctx)
        return minutes


@click.command(
    context_settings={"max_content_width": 110}, epilog=f"Tasks: {', '.join(envs.names())}. Settings: see --settings."
)
@click.option(
    "--preset",
    type=Name("preset", names.PRESETS),
    default="dmc",
    show_default=True,
    help=f"The setting to start from: {', '.join(names.PRESETS)}. The options below change it.",
)
@click.option("--task", type=Task(), help="What to learn, such as dmc/walker_walk.")
@click.option("--method", type=Name("method", names.METHODS), help=f"One of {', '.join(names.METHODS)}.")
@click.option(
    "--size", type=Name("size", names.SIZES), help=f"Parameters, roughly: {', '.join(names.SIZES)}; drqv2 has one size."
)
@click.option("--obs", type=Name("observation", names.OBSERVATIONS), metavar="KIND", help="pixels, vector or both.")
@click.option(
    "--seed", type=click.IntRange(0, 2**31 - 1), metavar="N", help="The same seed gives the same run, to the bit."
)
@click.option("--env-steps", type=click.IntRange(1), metavar="N", help="Simulator steps in all, action repeat counted.")
@click.option("--num-envs", type=click.IntRange(1), metavar="N", help="Environments stepped together.")
@click.option(
    "--replay-ratio",
    type=click.FloatRange(0, min_open=True),
    metavar="X",
    help="How often each agent step is learned from.",
)
@click.option(
    "--set",
    "assignments",
    metavar="PATH=VALUE",
    multiple=True,
    help="Any setting, such as agent.optimizer.learning_rate=1e-4. May be repeated.",
)
@click.option(
    "--logdir",
    type=UserPath(),
    metavar="DIRECTORY",
    help="Where the run is kept. The same command on the same directory goes on with it; more --env-steps, and other "
    "evaluations, are let change.",
)
@click.option(
    "--fork",
    type=UserPath(),
    metavar="RUN",
    help="Begin a new run with the agent of another one's newest checkpoint; replay and environments are new. Settings "
    "may be others where the agent's shapes, observations and actions are the same.",
)
@click.option(
    "--checkpoint-minutes",
    type=Minutes(0),
    metavar="X",
    default=15.0,
    show_default="15",
    help="Time between checkpoints; there is one at the end and on Ctrl-C besides.",
)
@click.option(
    "--devices",
    type=click.IntRange(1),
    metavar="N",
    default=1,
    show_default=True,
    help="Devices of this process to divide environments, replay and batches over; the run is the same on any number.",
)
@click.option("--coordinator", metavar="HOST:PORT", help="With several processes: where the first of them listens.")
@click.option("--processes", type=click.IntRange(1), metavar="N", default=1, help="How many processes train together.")
@click.option("--process", type=click.IntRange(0), metavar="N", default=0, help="Which of them this is, from 0.")
@click.option(
    "--deterministic",
    is_flag=True,
    help="Repeat to the bit on GPUs too, for some speed; a CPU always does.",
)
@click.option("--settings", "show", is_flag=True, help="Print all settings as PATH=VALUE and exit.")
def main(
    preset: str,
    size: str | None,
    method: str | None,
    assignments: tuple[str, ...],
    logdir: Path | None,
    fork: Path | None,
    checkpoint_minutes: float,
    devices: int,
    coordinator: str | None,
    processes: int,
    process: int,
    deterministic: bool,
    show: bool,
    **flags: Any,
) -> None:
    """Train an agent on the device: environments, rendering, replay and learning together.

    \b
    The directory of the run then holds
      config.json    all settings             checkpoints/  to go on from, and for evaluations
      metrics.jsonl  one JSON object a line   curve.png     returns over environment steps
                                              policy.mp4    an episode of the trained policy

    \b
    Examples:
      python -m ne_dreamer_jax train --preset quickstart --logdir runs/quickstart
      python -m ne_dreamer_jax train --task dmc/walker_walk --size 12m --seed 1 --logdir runs/walker
    """
    if not show:
        if logdir is None:
            raise click.UsageError("Missing option '--logdir': where the run is kept, such as runs/first")
        with refusing(run_directory.RefusedError):
            run_directory.check(logdir)
    if (processes > 1) != (coordinator is not None) or process >= processes:
        raise click.UsageError(
            "expected --coordinator, --processes and --process together, the last below the number of processes, got "
            f"--coordinator {coordinator} --processes {processes} --process {process}"
        )
    quiet()
    if deterministic:
        flags_of_xla = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = f"{flags_of_xla} --xla_gpu_deterministic_ops=true".strip()
    with refusing(ValueError):
        config = configure(preset, size, method, {FLAGS[name]: value for name, value in flags.items()}, assignments)
    if show or logdir is None:
        for path, value in settings.paths(config).items():
            say(f"{path}={settings.as_text(value)}")
        return
    with interruptible():
        _train(config, logdir, fork, checkpoint_minutes, Group(devices, coordinator, processes, process))


class Group(NamedTuple):
    """What trains together, as of the options of these names."""

    devices: int
    coordinator: str | None
    processes: int
    process: int


def _train(config: Config, logdir: Path, fork: Path | None, checkpoint_minutes: float, group: Group) -> None:
    """Trains, and ends the program with the run's exit code."""
    from ne_dreamer_jax.runs import building, checkpoint, progress, resume, start, training
    from ne_dreamer_jax.runs import fork as forks
    from ne_dreamer_jax.system import compile_cache, parallel

    echo = say if group.process == 0 else lambda line: None
    with refusing(ValueError, run_directory.RefusedError):
        config = resume.settle(logdir, config)
        changed = resume.changes(logdir, config)
        if fork is not None:
            forks.check(fork, logdir)
        if group.coordinator is not None:
            parallel.connect(group.coordinator, group.processes, group.process)
        find_devices()
        kept = compile_cache.enable()
        mesh = parallel.make_mesh(group.devices) if group.devices * group.processes > 1 else None
        run = building.build(config, mesh=mesh)
        if fork is not None:
            forks.check_agent(fork, logdir, config, run.agent.spec, run.shapes.train)
        start.check_processes(config, group.devices * group.processes, fork)
    for line in [*progress.describe(config, run.loop, run.shapes, changed), f"  compiled programs are kept in {kept}"]:
        echo(line)
    with refusing(run_directory.RefusedError, checkpoint.DamagedError), contextlib.ExitStack() as stack:
        files = run_directory.RunDirectory(logdir)
        if group.process == 0:
            files = stack.enter_context(run_directory.claim(logdir, config, resume.differences))
        code = training.train(run, files, checkpoint_minutes=checkpoint_minutes, echo=echo, parent=fork)
    raise SystemExit(code)


def configure(
    preset: str, size: str | None, method: str | None, values: Mapping[str, Any], assignments: Sequence[str] = ()
) -> Config:
    """A preset with some settings changed.

    Args:
      values: path -> value; None leaves a setting as the preset has it.
      assignments: ``path=value``, applied last.

    Raises:
      ValueError: no such setting, or a value that does not fit it.
    """
    from ne_dreamer_jax import config as presets

    config = presets.preset(preset, size)
    if (task := values.get("env.task")) is not None:  # before the method: drqv2's authors chose some settings by task
        config = presets.override(config, f"env.task={task}")
    if method is not None:
        config = presets.with_method(config, method, presets.OBJECTIVES.get(preset, ()))
    if values.get("env.obs") is not None and not hasattr(config.env, "obs"):
        raise ValueError(f"--obs: {config.env.task} says itself how it is observed; expected a dmc/ task for it")
    for path, value in values.items():
        if value is not None:
            config = presets.override(config, f"{path}={value}")
    for assignment in assignments:
        config = presets.override(config, assignment)
    return config
