"""Stores short trajectories of dm_control, which the tests compare our Control Suite tasks with.

Of one task a domain: segments of a few agent steps under random actions, from states at the start and in the middle
of episodes. The tests then run no episodes of dm_control, and compile a domain's physics once. From the repository's
root::

    python -m benchmarks.dmc_trajectories --out tests/envs/trajectories.npz
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import click
import jax
import numpy as np

from benchmarks import dmc_equality as equality
from benchmarks.dmc_equality import Arrays
from ne_dreamer_jax.commands.options import UserPath
from ne_dreamer_jax.envs.dmc.common import Episode

TASKS = (
    "dmc/acrobot_swingup",
    "dmc/ball_in_cup_catch",
    "dmc/cartpole_swingup",
    "dmc/cheetah_run",
    "dmc/finger_turn_hard",
    "dmc/hopper_hop",
    "dmc/pendulum_swingup",
    "dmc/quadruped_walk",
    "dmc/reacher_hard",
    "dmc/walker_walk",
)
SEGMENTS, STEPS = 8, 5
_APART = 45  # agent steps from the start of a segment to that of the next
_EPISODE = 90  # agent steps from a reset to the next


class Segments(NamedTuple):
    """K segments of T agent steps of dm_control; numbers are float32."""

    start: Arrays  # [K, ...], the integrated fields of MuJoCo's data
    episode: Episode  # [K, ...]
    action: np.ndarray  # [T, K, A], in [-1, 1]
    reward: np.ndarray  # [T, K]
    obs: Arrays  # [T, K, ...]


def record(name: str, seed: int = 0) -> Segments:
    """Plays a task in dm_control."""
    whole = equality.record(name, SEGMENTS * _APART, seed, restart_every=_EPISODE)
    first = np.arange(SEGMENTS) * _APART
    steps = first + np.arange(STEPS)[:, None]
    segments = Segments(
        jax.tree.map(lambda x: x[first], whole.start),
        jax.tree.map(lambda x: x[first], whole.episode),
        *jax.tree.map(lambda x: x[steps], (whole.action, whole.reward, whole.obs)),
    )
    return jax.tree.map(lambda x: x.astype(np.float32), segments)


def load(path: Path, name: str) -> Segments:
    """The segments of a task out of a file that ``main`` wrote."""
    with np.load(path) as file:
        values = {key.removeprefix(f"{name}/"): file[key] for key in file.files if key.startswith(f"{name}/")}
    parts: dict[str, Arrays] = {"start": {}, "obs": {}}
    for key in list(values):
        part, _, field = key.partition("/")
        if field:
            parts[part][field] = values.pop(key)
    return Segments(parts["start"], values.get("episode", ()), values["action"], values["reward"], parts["obs"])


def flat(name: str, segments: Segments) -> Arrays:
    """The arrays of some segments under the names that they have in a file."""
    arrays = {f"{name}/{part}": getattr(segments, part) for part in ("action", "reward")}
    if not isinstance(segments.episode, tuple):
        arrays[f"{name}/episode"] = segments.episode
    for part in ("start", "obs"):
        arrays |= {f"{name}/{part}/{field}": value for field, value in getattr(segments, part).items()}
    return arrays


@click.command(help=__doc__, context_settings={"show_default": True})
@click.option("--out", type=UserPath(), required=True, help="The file to write.")
def main(out: Path) -> None:
    """Writes the file."""
    arrays: Arrays = {}
    for name in TASKS:
        arrays |= flat(name, record(name))
    np.savez_compressed(out, **arrays)  # type: ignore[arg-type]
    click.echo(f"{out}: {len(TASKS)} tasks, {SEGMENTS} segments of {STEPS} agent steps, {out.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
