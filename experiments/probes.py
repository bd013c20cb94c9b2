"""What each method reaches in the probes: environments with known optima that ask for one ability each.

All seeds of a method train at once, at a size that learns in a minute or two on a CPU.

Usage: ``python -m experiments.probes --probe cue --probe cue_again --seeds 5``
"""

from __future__ import annotations

import time

import click

from ne_dreamer_jax.commands.options import Name, find_devices, refusing, say
from ne_dreamer_jax.settings import names

UPDATES = {"bandit": 600, "two_steps": 1_200, "cue": 5_000, "cue_again": 5_000, "target": 4_000, "echo": 1_200}
"""Probe -> updates of a world model. The cues ask for three things at once: to see it, to keep it, to use it."""
DRQV2_UPDATES = 2_000


def updates(method: str, name: str) -> int:
    """How many updates a method gets in a probe."""
    return DRQV2_UPDATES if method == names.DRQV2 else UPDATES[name]


@click.command(help=__doc__, context_settings={"show_default": True})
@click.option("--method", "methods", type=Name("method", names.METHODS), multiple=True, help="Default: all of them.")
@click.option("--probe", "chosen", type=Name("probe", tuple(UPDATES)), multiple=True, help="Default: all of them.")
@click.option("--seeds", type=click.IntRange(1, 1000), default=5, help="Seeds 0, 1, ... of each, all at once.")
def main(methods: tuple[str, ...], chosen: tuple[str, ...], seeds: int) -> None:
    """Prints a row of the table as soon as it is measured."""
    import numpy as np

    from experiments import probe_learning
    from ne_dreamer_jax.envs import probes

    with refusing(ValueError):
        find_devices()
    say("| method | probe | blind | median | seeds | minutes |\n| --- | --- | --- | --- | --- | --- |")
    for method in methods or names.METHODS:
        for name in chosen or UPDATES:
            begin = time.monotonic()
            with refusing(ValueError):
                found = probe_learning.returns(method, name, range(seeds), updates(method, name))
            blind, minutes = probes.PROBES[name]().blind, (time.monotonic() - begin) / 60
            each = " ".join(f"{value:.2f}" for value in found)
            say(f"| `{method}` | {name} | {blind:.2f} | {np.median(found):.2f} | {each} | {minutes:.1f} |")


if __name__ == "__main__":
    main()
