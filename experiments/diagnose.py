"""Says what the agent of a run knows, and what holds it back: ``python -m experiments.diagnose --help``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from ne_dreamer_jax.commands.options import Run, find_devices, refusing, say
from ne_dreamer_jax.runs import run_directory
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet


@click.command(context_settings={"max_content_width": 110})
@click.argument("logdir", type=Run(), metavar="DIRECTORY")
@click.option("--episodes", type=click.IntRange(2), default=16, show_default=True, help="Half of them are fitted to.")
@click.option(
    "--horizon", type=click.IntRange(1, 10_000), default=15, show_default=True, help="Steps that the model predicts."
)
@click.option(
    "--decoder-updates",
    type=click.IntRange(0),
    default=1_000,
    show_default=True,
    help="Of the decoder that is made of the frozen latents; 0 for none.",
)
@click.option(
    "--checkpoint",
    "prefer",
    type=click.Choice(["best", "newest"]),
    default="newest",
    show_default=True,
    help="The checkpoint with the best evaluation return during training, or the last one.",
)
@click.option(
    "--actions",
    type=click.Choice(["mode", "sample"]),
    default="mode",
    show_default=True,
    help="The policy's mode, or samples, with which more varies where the task is solved.",
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True)
def main(
    logdir: Path,
    episodes: int,
    horizon: int,
    decoder_updates: int,
    prefer: Literal["best", "newest"],
    actions: Literal["mode", "sample"],
    seed: int,
) -> None:
    """Play episodes with the policy of a run, and say what its agent knows of them.

    How much of what the environment knows as vectors is in the latent state, and in what the model predicts; what the
    critic's values are beside the returns that came; how often the policy's mean is where it can hardly learn. All is
    printed and written to diagnosis.json in DIRECTORY. Where there are images, decoded.png shows frames, and what a
    decoder that was trained afterwards draws of the latents and of the model's predictions.
    """
    quiet()
    from ne_dreamer_jax.runs import checkpoint, diagnosis
    from ne_dreamer_jax.system import compile_cache

    compile_cache.enable()
    with refusing(run_directory.RefusedError, FileNotFoundError, checkpoint.DamagedError, ValueError):
        find_devices()
        diagnosis.diagnose(
            logdir,
            episodes=episodes,
            horizon=horizon,
            decoder_updates=decoder_updates,
            prefer=prefer,
            actions=actions,
            seed=seed,
            echo=say,
        )


if __name__ == "__main__":
    use_large_pages("experiments.diagnose")
    main()
