"""Which settings of a run may change when it goes on, and which replay's capacity it then has."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from ne_dreamer_jax import settings
from ne_dreamer_jax.config import Config
from ne_dreamer_jax.envs.config import WorkersConfig
from ne_dreamer_jax.loop import Budget
from ne_dreamer_jax.runs import run_directory
from ne_dreamer_jax.runs.run_directory import RunDirectory

MAY_GROW = "loop.env_steps"
"""The setting that may change to a larger number: a run that was to end goes on."""
MAY_CHANGE = ("loop.eval_every", "loop.eval_episodes", "loop.eval_max_steps", "loop.chunk_steps", "loop.max_skipped")
"""The settings that decide what is measured, how often the host hears of it and when a diverged run stops, and not what
is learned: the same bits come out with any."""


MAY_DIFFER = ("microbatches",)
"""Settings of the agent that may change, too, with which the same update is computed in another order of additions."""


def settle(path: Path, asked: Config) -> Config:
    """The configuration with which the run in a directory goes on; the one asked for where there is none.

    A ``loop.capacity`` of none stands for what the run has. So a run that goes on beyond its first end keeps the replay
    that it was made with, and forgets its oldest steps where that is full: it does what a run with that capacity and
    the larger number of steps would have done from the start.

    Raises:
      RefusedError: the run has other settings, of which some may not change; or its configuration can't be read.
    """
    if not RunDirectory(path).config.exists():
        return asked
    stored = run_directory.read_config(path, Config)
    if asked.loop.capacity is None and stored.loop != asked.loop:
        kept = stored.loop.capacity
        if kept is None and stored.loop.env_steps != asked.loop.env_steps:
            kept = _capacity(stored)
        asked = replace(asked, loop=replace(asked.loop, capacity=kept))
    run_directory.check_same(path, asked, differences)
    return asked


def differences(stored: Config, asked: Config) -> list[str]:
    """What differs between a run's configuration and the one asked for, and may not, a line each."""
    names = [path.removeprefix("loop.") for path in MAY_CHANGE]
    if asked.loop.env_steps > stored.loop.env_steps:
        names.append("env_steps")
    if stored.loop.capacity is None and asked.loop.capacity == _capacity(stored):
        names.append("capacity")
    agreed: Any = {name: getattr(asked.loop, name) for name in names}
    agreed = replace(stored, loop=replace(stored.loop, **agreed))
    if type(stored.agent) is type(asked.agent):
        shared = {name: getattr(asked.agent, name) for name in MAY_DIFFER if hasattr(asked.agent, name)}
        agreed = replace(agreed, agent=replace(stored.agent, **shared))
    if isinstance(stored.env, WorkersConfig) and type(stored.env) is type(asked.env):
        workers: Any = {field.name: getattr(asked.env, field.name) for field in fields(WorkersConfig)}
        agreed = replace(agreed, env=replace(stored.env, **workers))
    lines = settings.differences(agreed, asked)
    hint = f" ({MAY_GROW} may only grow)"
    return [line + hint if line.startswith(f"{MAY_GROW}:") else line for line in lines]


def changes(path: Path, asked: Config) -> list[str]:
    """What is other than when the run in a directory was last started, a line each; empty where there is none."""
    if not RunDirectory(path).config.exists():
        return []
    lines = settings.differences(run_directory.read_config(path, Config), asked)
    return [f"{line} (replay keeps its size)" if line.startswith("loop.capacity: None") else line for line in lines]


def _capacity(config: Config) -> int:
    """The transitions that replay holds under a configuration."""
    agent = config.agent
    return Budget.of(config.loop, agent.batch_size, agent.batch_length, config.env.action_repeat).capacity
