"""Training small agents in the probes: all seeds of a method at once, under ``vmap``."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax import config as configs
from ne_dreamer_jax import loop as loops
from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.agents.dreamer.agent import AgentConfig
from ne_dreamer_jax.agents.dreamer.behavior import BehaviorConfig
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.agents.optim import OptimizerConfig
from ne_dreamer_jax.envs import probes
from ne_dreamer_jax.loop import budget
from ne_dreamer_jax.loop.config import LoopConfig
from ne_dreamer_jax.nets.encoder import EncoderConfig
from ne_dreamer_jax.nets.heads import HeadsConfig
from ne_dreamer_jax.nets.predictor import PredictorConfig
from ne_dreamer_jax.nets.rssm import RSSMConfig
from ne_dreamer_jax.objectives import DreamerPro, NextEmbedding
from ne_dreamer_jax.settings import names

NUM_ENVS, CAPACITY, EPISODES = 8, 16_384, 256
STEPS_PER_UPDATE = 8
PREFILL = 1_024
"""Agent steps before the first update."""
EVALUATION = 2**31 - 1
"""The seed of the episodes of evaluations."""

WORLD_MODEL = AgentConfig(
    encoder=EncoderConfig(depth=8, multipliers=(2, 3), layers=1, units=32),
    rssm=RSSMConfig(deter=64, stoch=4, classes=8, hidden=32, blocks=2, prior_layers=1),
    heads=HeadsConfig(units=32, actor_layers=1, critic_layers=1),
    objective=NextEmbedding(PredictorConfig(layers=1, width=32, heads=2, feedforward=64, positions=16)),
    behavior=BehaviorConfig(horizon=6, discount=0.97, entropy=3e-3, return_floor=0.2),
    optimizer=OptimizerConfig(learning_rate=1e-3, warmup=50),
    batch_size=16,
    batch_length=16,
)
DRQV2 = DrQv2Config(
    batch_size=128,
    features=16,
    units=64,
    learning_rate=1e-3,
    target_rate=0.02,
    noise_steps=6_000,
    random_steps=1_000,
    steps_per_update=float(STEPS_PER_UPDATE),
)
PICTURES = {"dreamerpro"}
"""Methods that need images."""


def learner(method: str) -> AgentConfig | DrQv2Config:
    """A method's agent at this size."""
    if method == names.DRQV2:
        return DRQV2
    agent = configs.with_method(configs.Config(agent=WORLD_MODEL), method).agent
    assert isinstance(agent, AgentConfig)
    if isinstance(agent.objective, DreamerPro):
        return dataclasses.replace(agent, objective=DreamerPro(prototypes=64, frozen_updates=1_000))
    return agent


def make_loop(agent: Agent, probe: probes.Probe, updates: int) -> loops.Loop:
    """The training loop with so many updates, one every `STEPS_PER_UPDATE` agent steps."""
    config = agent.config
    options = LoopConfig(
        env_steps=PREFILL + updates * STEPS_PER_UPDATE,
        num_envs=NUM_ENVS,
        replay_ratio=budget.replay_ratio(config.batch_size, config.batch_length, STEPS_PER_UPDATE),
        capacity=CAPACITY,
        prefill=PREFILL,
        eval_episodes=EPISODES,
    )
    return loops.make(options, probe.env, agent, action_repeat=1)


class Learned(NamedTuple):
    """What R seeds of an agent reached."""

    returns: np.ndarray  # float64 [R], mean over the episodes of an evaluation
    metrics: dict[str, np.ndarray]  # name -> [R], mean over the last tenth of the updates


def learn(loop: loops.Loop, seeds: Sequence[int]) -> Learned:
    """Trains with each of the seeds, all of them at once, and evaluates the policies' modes."""
    init, chunk = loops.over_seeds(loop)
    state = init(jnp.stack([jax.random.key(seed) for seed in seeds]))
    last = max(1, (loop.budget.vector_steps - loop.budget.prefill) // 10)
    for steps in (loop.budget.vector_steps - last, last):
        state, report = chunk(state, jnp.asarray(steps, jnp.int32))
    alone = [jax.tree.map(operator.itemgetter(i), state.train.params) for i in range(len(seeds))]
    returns = [np.mean(loop.evaluate(params, jax.random.key(EVALUATION)).returns) for params in alone]
    report = jax.device_get(report)
    return Learned(np.array(returns), {name: x / report.updates for name, x in report.learning.items()})


def returns(method: str, name: str, seeds: Sequence[int], updates: int) -> np.ndarray:
    """Mean return ``[R]`` of each seed's policy after so many updates in a probe."""
    probe = probes.PROBES[name]()
    if method in PICTURES:
        probe = probes.as_picture(probe)
    agent = make_agent(learner(method), probe.env.spec)
    return learn(make_loop(agent, probe, updates), seeds).returns
