"""A configuration made real: its environment, its agent and its loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from jax.sharding import Mesh

from ne_dreamer_jax import loop as loops
from ne_dreamer_jax.agents import make_agent
from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.config import Config, check
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.envs.base import Env
from ne_dreamer_jax.envs.config import OwnConfig
from ne_dreamer_jax.envs.vector import Host, VectorEnv, check_env
from ne_dreamer_jax.loop import Loop, LoopState
from ne_dreamer_jax.runs.schedule import Schedule


class Run(NamedTuple):
    """A configuration made real."""

    config: Config
    agent: Agent
    loop: Loop
    shapes: LoopState  # shapes and dtypes of the whole state
    step_seconds: float | None = None  # simulated time of an agent step
    host: Host | None = None  # where the environments are, if they are not in the program
    release: Callable[[Any], None] | None = None  # of environments' states that are stepped no more, as of `VectorEnv`

    @property
    def schedule(self) -> Schedule:
        """When chunks end and evaluations are due."""
        return Schedule.of(self.config, self.loop)


def own(config: Config) -> Config:
    """The configuration of a run on an environment that is given as an object: it says so.

    Each of its steps counts for one environment step, unless the configuration says otherwise in an `OwnConfig`.
    """
    return config if isinstance(config.env, OwnConfig) else replace(config, env=OwnConfig())


def build(config: Config, env: Env | VectorEnv | None = None, mesh: Mesh | None = None) -> Run:
    """Makes the environment, the agent and the loop of a configuration; allocates nothing.

    Args:
      env: what to train in, instead of the environment that the configuration names.
      mesh: of `system.parallel`, to train on several devices.

    Raises:
      ValueError: what does not fit together, or not into memory.
    """
    check(config)
    if env is None:
        env = env_configs.make(config.env)
    else:
        config = own(config)
    check_env(env)
    agent = make_agent(config.agent, env.spec)
    loop = loops.make(config.loop, env, agent, config.env.action_repeat, mesh)
    host, release = (env.host, env.release) if isinstance(env, VectorEnv) else (None, None)
    return Run(config, agent, loop, loop.state_shapes(), env.step_seconds, host, release)
