"""The least agent in a one-dimensional world."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from ne_dreamer_jax import config as configs
from ne_dreamer_jax.config import Config
from ne_dreamer_jax.envs import base
from ne_dreamer_jax.types import Array, ArraySpec, ContinuousAction, EnvSpec

LENGTH = 7  # steps of an episode


def config(**loop) -> Config:
    """The smoke preset made as small as it goes."""
    smoke = configs.preset("smoke", "1m")
    agent = smoke.agent
    objective = replace(
        agent.objective,
        predictor=replace(agent.objective.predictor, layers=1, width=8, heads=1, feedforward=8, positions=8),
    )
    agent = replace(
        agent,
        encoder=replace(agent.encoder, units=8, layers=1),
        rssm=replace(agent.rssm, deter=16, hidden=8, stoch=2, classes=4, blocks=2),
        heads=replace(agent.heads, units=8, actor_layers=1, critic_layers=1, bins=9),
        behavior=replace(agent.behavior, horizon=3),
        objective=objective,
        batch_size=2,
        batch_length=4,
    )
    settings = {
        "env_steps": 120,
        "num_envs": 2,
        "replay_ratio": 1.0,
        "prefill": 20,
        "chunk_steps": 8,
        "eval_every": 48,
        "eval_episodes": 2,
    }
    env = replace(smoke.env, action_repeat=1)
    return replace(smoke, env=env, agent=agent, loop=replace(smoke.loop, **(settings | loop)))


def env(image: bool = False) -> base.Env:
    """A point on a line; the reward is minus its distance from 0. An image would show nothing of it."""

    def reset(key: Array):
        return jax.random.normal(key), jnp.zeros((), jnp.int32)

    def step(state, action: Array):
        position, time = state
        position = position + 0.1 * action[0]
        last = time + 1 >= LENGTH
        progress = base.Progress(-jnp.abs(position), last, jnp.zeros((), bool), jnp.ones((), bool))
        return (position, time + 1), progress

    blank = {"image": jnp.zeros((4, 4, 3), jnp.uint8)} if image else {}
    observation = {"position": ArraySpec((1,), jnp.float32)} | {
        name: ArraySpec(x.shape, x.dtype) for name, x in blank.items()
    }
    spec = EnvSpec(observation, ContinuousAction(1))
    return base.from_core(
        base.Core(spec, reset, base.restart_or_step(reset, step), lambda state: {"position": state[0][None]} | blank)
    )


def seen() -> base.Env:
    """The same with an image, to be named as ``tests.experiments.toy:seen``."""
    return env(image=True)
