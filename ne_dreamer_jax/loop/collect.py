"""Step the environments, act, and store what was seen."""

from __future__ import annotations

import operator
from typing import Any, Literal

import jax
import jax.numpy as jnp

from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.envs.vector import VectorEnv
from ne_dreamer_jax.loop.state import Episodes, Finished, LoopState
from ne_dreamer_jax.replay import ring
from ne_dreamer_jax.replay.storage import Storage
from ne_dreamer_jax.system import parallel
from ne_dreamer_jax.types import Array, PolicyState, TimeStep, Transition

TimeLimits = Literal["marked", "unmarked", "terminal"]


def collect(
    env: VectorEnv,
    agent: Agent,
    storage: Storage,
    time_limits: TimeLimits,
    state: LoopState,
    finished: Finished,
    key: Array,
) -> tuple[LoopState, Finished]:
    """One step of all N environments: with the actions chosen before, then new ones for what is seen now.

    Args:
      finished: sums over the episodes that ended so far, to be added to.
      key: consumed, for the agent's samples.

    Returns:
      The state with one more row in replay, and the sums.
    """
    step_share = parallel.per_shard(env.step, (parallel.SPLIT, parallel.SPLIT), parallel.SPLIT)
    with jax.named_scope("environments"):
        env_state, timestep = step_share(state.env, state.policy.prev_action)
    with jax.named_scope("acting"):
        policy, action = agent.act(state.train.params, state.policy, timestep, key)
    if env.start is not None:  # the environments take their step while the agent learns
        env_state = env.start(env_state, action)
    with jax.named_scope("replay"):
        obs = storage.encode_obs(env_state, timestep.obs, ring.next_row(state.replay))
        cut = jax.tree.map(operator.ne, env.cuts(env_state), env.cuts(state.env))
        step = transition(
            time_limits, timestep._replace(obs=obs), policy, action, jnp.logical_or(cut.faults, cut.bad_actions)
        )
        replay = ring.add(state.replay, step)

    ret = jnp.where(timestep.is_first, 0.0, state.episodes.ret) + timestep.reward
    length = jnp.where(timestep.is_first, 0, state.episodes.length + 1)
    ended = timestep.is_last
    finished = Finished(
        episodes=finished.episodes + jnp.sum(ended).astype(jnp.float32),
        returns=finished.returns + jnp.sum(jnp.where(ended, ret, 0.0)),
        lengths=finished.lengths + jnp.sum(jnp.where(ended, length, 0)).astype(jnp.float32),
    )
    return state._replace(env=env_state, policy=policy, replay=replay, episodes=Episodes(ret, length)), finished


def transition(time_limits: TimeLimits, timestep: TimeStep, policy: PolicyState, action: Any, cut: Array) -> Transition:
    """What replay holds of a step.

    Args:
      time_limits: as in `LoopConfig`.
      cut: bool [N], episodes that a fault has cut and no time limit: last, and never terminal.
    """
    is_last, is_terminal = timestep.is_last, timestep.is_terminal
    by_limit = is_last & ~is_terminal & ~cut
    if time_limits == "unmarked":
        is_last = is_last & ~by_limit
    if time_limits == "terminal":
        is_terminal = is_terminal | by_limit
    return Transition(timestep.obs, action, timestep.reward, timestep.is_first, is_last, is_terminal, policy.latent)
