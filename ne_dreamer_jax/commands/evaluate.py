"""Evaluates the policy of a run: ``python -m ne_dreamer_jax evaluate --help``."""

from __future__ import annotations

import ctypes.util
import functools
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import click

from ne_dreamer_jax import settings
from ne_dreamer_jax.commands.options import UserPath, find_devices, quiet, refusing, say
from ne_dreamer_jax.runs import run_directory


@click.command(context_settings={"max_content_width": 110})
@click.argument("logdir", type=UserPath(), metavar="DIRECTORY")
@click.option("--episodes", type=click.IntRange(1), default=10, show_default=True, help="Episodes, played together.")
@click.option(
    "--checkpoint",
    "prefer",
    type=click.Choice(["best", "newest"]),
    default="best",
    show_default=True,
    help="The checkpoint with the best evaluation return during training, or the last one.",
)
@click.option(
    "--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True, help="Of these episodes' beginnings."
)
@click.option(
    "--backend",
    type=click.Choice(["mjx", "dm_control"]),
    default="mjx",
    show_default=True,
    help="dm_control: play as many episodes there too, with C MuJoCo's physics and OpenGL pictures.",
)
@click.option("--video", "with_video", is_flag=True, help="Write one episode to policy.mp4 in the directory.")
def main(
    logdir: Path,
    episodes: int,
    prefer: Literal["best", "newest"],
    seed: int,
    backend: Literal["mjx", "dm_control"],
    with_video: bool,
) -> None:
    """Play episodes with the trained policy of a run, beside a random policy's on the same task.

    The actions are the policy's mode, the episodes none that training or its evaluations had. The result is printed
    and written to evaluation.json in DIRECTORY. The replay buffer is not read.
    """
    if not run_directory.RunDirectory(logdir).marker.exists():
        raise click.UsageError(
            f"expected the --logdir of a run, got {logdir}: there is no {run_directory.MARKER} in it"
        )
    quiet()
    if backend == "dm_control":
        with refusing(ValueError):
            allow_opengl()
    import jax
    import numpy as np

    from ne_dreamer_jax.config import Config
    from ne_dreamer_jax.runs import checkpoint, pictures, training, video
    from ne_dreamer_jax.system import compile_cache

    compile_cache.enable()
    files = run_directory.RunDirectory(logdir)
    with refusing(run_directory.RefusedError, ValueError):
        find_devices()
        config = run_directory.read_config(logdir, Config)
        if backend == "dm_control" and not config.env.task.startswith("dmc/"):
            raise ValueError(f"--backend dm_control: expected a run of a dmc task, got one of {config.env.task}")
        # The smallest replay there is: none is read or allocated here, and the run's may not fit this machine.
        smallest = (config.agent.batch_length + 1) * config.loop.num_envs
        run = training.build(replace(config, loop=replace(config.loop, capacity=smallest)))
    with refusing(FileNotFoundError, checkpoint.DamagedError, ValueError):
        restored = checkpoint.restore(files.checkpoints, {"agent": run.shapes.train}, prefer=prefer)
    for reason in restored.skipped:
        say(f"Passed over a damaged checkpoint: {reason}")
    env_step = restored.checkpoint.step
    say(f"{config.env.task}, {config.method}, after {env_step:,} environment steps ({restored.checkpoint.path})")

    params = restored.items["agent"].params
    policy_key, random_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), EVALUATION))
    evaluate = {"mjx": functools.partial(run.loop.evaluate, params, episodes=episodes, frames=True)}
    if backend == "dm_control":
        from ne_dreamer_jax.runs import control_suite

        evaluate[backend] = functools.partial(control_suite.evaluate, config.env, run.agent, params, episodes=episodes)
    content: dict[str, Any] = {"task": config.env.task, "env_step": env_step, "episodes": episodes, "seed": seed}
    for place, play in evaluate.items():
        results = {}
        for name, key in (("policy", policy_key), ("random", random_key)):
            with refusing(RuntimeError):
                evaluation = play(key=key, random=name == "random")
            returns = np.asarray(evaluation.returns, np.float64)
            results[name] = {
                "mean": float(returns.mean()),
                "std": float(returns.std()),
                "returns": [float(value) for value in returns],
                "lengths": [int(value) for value in evaluation.lengths],
            }
            where = f" in {place}" if len(evaluate) > 1 else ""
            say(f"{name:7} return {returns.mean():8.1f} ± {returns.std():.1f} over {episodes} episodes{where}")
            if place == "mjx" and name == "policy" and with_video:
                if evaluation.frames is None:
                    say("no video: this agent sees vectors, not pixels")
                else:
                    write = functools.partial(
                        video.write, evaluation.frames, files.video, fps=training.FRAMES_PER_SECOND
                    )
                    if pictures.attempt(write, files.video, say):
                        say(f"{files.video} shows the first episode")
        content |= results if place == "mjx" else {place: results}
    run_directory.write_evaluation(files, content)


_NO_OPENGL = ("", "disable", "disabled", "off", "0", "false", "no")
_OPENGL = ("egl", "osmesa", "glfw", "glx", "cgl", "wgl", "enable", "enabled", "on", "true", "1")


def allow_opengl() -> None:
    """Sets ``MUJOCO_GL`` to draw without a screen, unless it already names a way to draw; call before MuJoCo loads.

    Raises:
      ValueError: it names none that MuJoCo knows.
    """
    given = os.environ.get("MUJOCO_GL", "")
    if given.lower() not in (*_NO_OPENGL, *_OPENGL):
        raise ValueError(f"MUJOCO_GL: no way to draw is called {given!r}. {settings.did_you_mean(given, _OPENGL)}")
    if given.lower() in _NO_OPENGL:
        os.environ["MUJOCO_GL"] = "osmesa" if ctypes.util.find_library("OSMesa") else "egl"


EVALUATION = 0x65_76_61_6C  # sets these episodes apart from those of a run with the same seed
