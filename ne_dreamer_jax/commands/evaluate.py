"""Evaluates the policy of a run: ``python -m ne_dreamer_jax evaluate --help``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from ne_dreamer_jax.commands.options import Run, Task, find_devices, refusing, say
from ne_dreamer_jax.runs import run_directory
from ne_dreamer_jax.system.quiet import quiet


@click.command(context_settings={"max_content_width": 110})
@click.argument("logdir", type=Run(), metavar="DIRECTORY")
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
    "--also",
    type=Task(),
    help="Play as many episodes in this environment, too, such as dm_control:walker_walk for a run of dmc/walker_walk.",
)
@click.option("--video", "with_video", is_flag=True, help="Write one episode to policy.mp4 in the directory.")
def main(
    logdir: Path,
    episodes: int,
    prefer: Literal["best", "newest"],
    seed: int,
    also: str | None,
    with_video: bool,
) -> None:
    """Play episodes with the trained policy of a run, beside a random policy's on the same task.

    The actions are the policy's mode, the episodes none that training or its evaluations had. The result is printed
    and written to evaluation.json in DIRECTORY. The replay buffer is not read.
    """
    quiet()
    from ne_dreamer_jax.runs import checkpoint, evaluation
    from ne_dreamer_jax.system import compile_cache

    compile_cache.enable()
    with refusing(run_directory.RefusedError, FileNotFoundError, checkpoint.DamagedError, ValueError):
        find_devices()
        evaluation.evaluate(
            logdir, None, episodes=episodes, prefer=prefer, seed=seed, with_video=with_video, also=also, echo=say
        )
