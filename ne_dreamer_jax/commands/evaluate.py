"""Evaluates the policy of a run: ``python -m ne_dreamer_jax evaluate --help``."""

from __future__ import annotations

import ctypes.util
import os
from pathlib import Path
from typing import Any, Literal

import click

from ne_dreamer_jax import settings
from ne_dreamer_jax.commands.options import UserPath, find_devices, refusing, say
from ne_dreamer_jax.runs import run_directory
from ne_dreamer_jax.system.quiet import quiet


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
    if not os.path.exists(run_directory.RunDirectory(logdir).marker):  # False for what can be no path, too
        raise click.UsageError(
            f"expected the --logdir of a run, got {logdir}: there is no {run_directory.MARKER} in it"
        )
    quiet()
    if backend == "dm_control":
        with refusing(ValueError):
            allow_opengl()
    from ne_dreamer_jax.runs import checkpoint, evaluation
    from ne_dreamer_jax.system import compile_cache

    compile_cache.enable()
    options: dict[str, Any] = {"episodes": episodes, "prefer": prefer, "seed": seed, "with_video": with_video}
    with refusing(run_directory.RefusedError, FileNotFoundError, checkpoint.DamagedError, ValueError):
        find_devices()
        if backend == "mjx":
            evaluation.evaluate(logdir, None, echo=say, **options)
            return
    _in_both(logdir, options)


def _in_both(logdir: Path, options: dict[str, Any]) -> None:
    """Plays in dm_control, too."""
    from ne_dreamer_jax.envs.config import DmcConfig
    from ne_dreamer_jax.runs import checkpoint, control_suite, evaluation

    with refusing(run_directory.RefusedError, FileNotFoundError, checkpoint.DamagedError, ValueError):
        loaded = evaluation.load(logdir, prefer=options["prefer"])
        env = loaded.config.env
        if not isinstance(env, DmcConfig):
            raise ValueError(f"--backend dm_control: expected a run of a dmc task, got one of {env.task}")
        content = evaluation.evaluate(logdir, None, echo=say, **options)
    theirs = {}
    for name, key in evaluation.keys(options["seed"]).items():
        with refusing(RuntimeError):
            played = control_suite.evaluate(
                env, loaded.agent, loaded.state.params, key, options["episodes"], random=name == "random"
            )
        theirs[name] = evaluation.summary(played)
        say(evaluation.line(name, played, " in dm_control"))
    run_directory.write_evaluation(run_directory.RunDirectory(logdir), content | {"dm_control": theirs})


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
