"""A new run that begins with the agent of another.

It takes over the train state of the other's newest good checkpoint, bit for bit: parameters, optimiser, return scale,
its key and the number of updates. Replay and the environments are new, since what was seen under other settings, or in
another task, may be no part of the new run; so it collects ``loop.prefill`` steps before it learns, with the policy
that it took over, and counts its steps from 0, by which DrQ-v2 acts at random again at first, and with its first noise.
``parent.json`` in its directory then says where the agent came from.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ne_dreamer_jax.config import Config
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.envs.config import GIVEN
from ne_dreamer_jax.runs import checkpoint, run_directory
from ne_dreamer_jax.runs.run_directory import RefusedError, RunDirectory, typed
from ne_dreamer_jax.settings import as_text
from ne_dreamer_jax.types import EnvSpec


def check(parent: Path, path: Path) -> None:
    """Refuses a parent that is no run, and a directory whose run began otherwise; touches nothing.

    Raises:
      RefusedError: the message says what to do.
    """
    if parent.resolve() == path.resolve():
        raise RefusedError(f"--fork {typed(parent)}: expected another run than the one in --logdir")
    if _has_begun(path):
        begun = parent_of(RunDirectory(path))
        if begun != parent.resolve():
            raise RefusedError(
                f"{path} holds a run that began {'anew' if begun is None else f'with the agent of {begun}'}. Leave out "
                "--fork to go on with it, or choose another --logdir"
            )
        return
    run_directory.read_config(parent, Config)
    _newest(parent)


def check_agent(parent: Path, path: Path, config: Config, spec: EnvSpec, like: Any) -> None:
    """Refuses a parent whose agent the run in a directory can't begin with; touches nothing.

    Args:
      config: of the new run.
      spec: of the new run's environment.
      like: the new run's train state, as arrays or `jax.ShapeDtypeStruct`.

    Raises:
      ValueError: the parent's agent has other arrays, or a continuation head that learned something else, or its
        environment other observations or actions.
      RefusedError: it has no checkpoint.
    """
    if _has_begun(path):
        return
    stored = run_directory.read_config(parent, Config)
    # Shapes of parameters don't tell all: four actions to choose from look like two with mean and deviation.
    if stored.env != config.env:
        theirs = None if stored.env.task == GIVEN else env_configs.make(stored.env).spec
        if theirs not in (None, spec):
            raise ValueError(
                f"--fork {typed(parent)}: expected an environment with the same observations and actions, got\n"
                f"  {stored.env.task}: {theirs}\n  {config.env.task}: {spec}"
            )
    setting = "discount_in_head"
    head, wanted = (getattr(getattr(each.agent, "behavior", None), setting, None) for each in (stored, config))
    if None not in (head, wanted) and head != wanted:
        raise ValueError(
            f"--fork {typed(parent)}: expected agent.behavior.{setting} as its continuation head was trained, "
            f"{as_text(head)}, got {as_text(wanted)}; add --set agent.behavior.{setting}={as_text(head)}"
        )
    try:
        checkpoint.check_fit(_newest(parent), "agent", like)
    except ValueError as error:
        raise ValueError(f"--fork {typed(parent)}: expected an agent of the same shapes. {error}") from error


def agent(parent: Path, like: Any, echo: Callable[[str], None]) -> tuple[Any, dict[str, Any]]:
    """The train state of another run's newest good checkpoint, and what ``parent.json`` is to say of it.

    Raises:
      ValueError: its arrays are others than ``like`` says.
      FileNotFoundError, DamagedError: there is no checkpoint, or none that is intact.
    """
    restored = checkpoint.restore(RunDirectory(parent).checkpoints, {"agent": like})
    for reason in restored.skipped:
        echo(f"Passed over a damaged checkpoint: {reason}")
    found = restored.checkpoint
    echo(f"Took over the agent of {found.path}, after {found.step:,} environment steps; replay is new.")
    origin = {"path": str(parent.resolve()), "env_step": found.step, "agent_sha256": checkpoint.digest(found, "agent")}
    return restored.items["agent"], origin


def parent_of(files: RunDirectory) -> Path | None:
    """The run that this one's agent is from; None for one that began anew.

    Raises:
      RefusedError: ``parent.json`` can't be read.
    """
    if not files.parent.exists():
        return None
    try:
        return Path(json.loads(files.parent.read_text(encoding="utf-8"))["path"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise RefusedError(
            f"{files.parent} is damaged: expected the path of a run in it ({error!r}). Restore it, or give --fork "
            "with another --logdir"
        ) from error


def _has_begun(path: Path) -> bool:
    """Whether the run in a directory has a checkpoint of its own, and needs its parent no more."""
    return bool(checkpoint.checkpoints(RunDirectory(path).checkpoints))


def _newest(parent: Path) -> checkpoint.Checkpoint:
    found = [each for each in checkpoint.checkpoints(RunDirectory(parent).checkpoints) if "agent" in each.items]
    if not found:
        raise RefusedError(f"--fork {typed(parent)}: expected a run with a checkpoint, and it has none that is intact")
    return found[0]
