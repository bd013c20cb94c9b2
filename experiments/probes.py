"""What each method reaches in the probes: environments with known optima that ask for one ability each.

All seeds of a method train at once, under ``vmap``, at a size that learns in a minute or two on a CPU.

Usage: ``python -m experiments.probes --probe cue --probe cue_again --seeds 5``
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Sequence
from typing import Any

import click
import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax import config as configs
from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.dreamer.agent import AgentConfig
from ne_dreamer_jax.agents.dreamer.behavior import BehaviorConfig
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.agents.optim import OptimizerConfig
from ne_dreamer_jax.commands.options import Name
from ne_dreamer_jax.envs import base, probes
from ne_dreamer_jax.nets.encoder import EncoderConfig
from ne_dreamer_jax.nets.heads import HeadsConfig
from ne_dreamer_jax.nets.predictor import PredictorConfig
from ne_dreamer_jax.nets.rssm import RSSMConfig
from ne_dreamer_jax.objectives import DreamerPro, NextEmbedding
from ne_dreamer_jax.replay import ring as replay
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.types import Array, EnvSpec, Metrics, Params, TimeStep, Transition

NUM_ENVS, STEPS, CAPACITY = 8, 32, 16_384
STEPS_PER_UPDATE = 8
PREFILL = 4
"""Rounds of `STEPS` that are played before the first with updates."""
EVALUATION = 2**31 - 1
"""The seed of the episodes of evaluations."""

WORLD_MODEL = AgentConfig(
    encoder=EncoderConfig(depth=8, layers=1, units=32),
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
UPDATES = {"bandit": 600, "two_steps": 1_200, "echo": 1_200, "target": 4_000, "cue": 5_000, "cue_again": 5_000}
"""Probe -> updates of a world model. The cues ask for three things at once: to see it, to keep it, to use it."""
DRQV2_UPDATES = 2_000

PICTURES = {"dreamerpro"}
"""They need images."""


def learner(method: str) -> AgentConfig | DrQv2Config:
    """A method's agent at this size."""
    if method == names.DRQV2:
        return DRQV2
    agent = configs.with_method(configs.Config(agent=WORLD_MODEL), method).agent
    assert isinstance(agent, AgentConfig)
    if isinstance(agent.objective, DreamerPro):
        return dataclasses.replace(agent, objective=DreamerPro(prototypes=64, frozen_updates=1_000))
    return agent


def probe_for(method: str, name: str) -> probes.Probe:
    """A probe as the method takes it, as pictures where it needs them."""
    probe = probes.PROBES[name]()
    return probes.as_picture(probe) if method in PICTURES else probe


class Trainer:
    """An agent and its updates, compiled once for all probes, since their spec is the same."""

    def __init__(self, config: Any, spec: EnvSpec = probes.SPEC) -> None:
        self.agent, self.config = make_agent(config, spec), config
        self._learn = jax.jit(jax.vmap(self._updates), donate_argnums=(0, 1))

    def train(
        self, probe: probes.Probe, updates: int, seeds: Sequence[int] = (0,)
    ) -> tuple[Params, list[dict[str, np.ndarray]]]:
        """The parameters after at least so many updates, and the metrics of the last update of each round.

        Returns:
          Parameters ``[R, ...]`` of R seeds, and for each round of `STEPS` vector steps the metrics ``[R]``.
        """
        keys = jnp.stack([jax.random.key(seed) for seed in seeds])
        play = jax.jit(jax.vmap(functools.partial(self._collect, probe.env)), donate_argnums=2)
        split = jax.vmap(jax.random.split)(keys)
        keys, init_keys = split[:, 0], split[:, 1]
        state, playing, ring = jax.jit(jax.vmap(functools.partial(self._init, probe.env)))(init_keys)
        history, rounds = [], -(-updates // (STEPS * NUM_ENVS // STEPS_PER_UPDATE))
        for number in range(PREFILL + rounds):
            split = jax.vmap(lambda key: jax.random.split(key, 3))(keys)
            keys, play_keys, learn_keys = split[:, 0], split[:, 1], split[:, 2]
            playing, ring = play(state.params, playing, ring, play_keys)
            if number >= PREFILL:
                state, ring, metrics = self._learn(state, ring, learn_keys)
                history.append(jax.device_get(metrics))
        return state.params, history

    def evaluate(self, probe: probes.Probe, params: Params, episodes: int = 256) -> np.ndarray:
        """Mean returns ``[R]`` of the policy's mode, over whole episodes, for parameters ``[R, ...]``."""
        env_key, key = jax.random.split(jax.random.key(EVALUATION))
        env_state = jax.vmap(probe.env.prepare)(jax.random.split(env_key, episodes))
        policy = self.agent.init_policy(episodes)
        play = jax.jit(jax.vmap(lambda params: self._play(probe.env, "mode", params, (env_state, policy), key)[1]))
        seen = play(params)
        whole = STEPS // (probe.length + 1) * (probe.length + 1)  # all episodes begin and end together
        reward, last = (np.asarray(x)[:, :whole].sum((1, 2)) for x in (seen.reward, seen.is_last))
        assert (last == episodes * (whole // (probe.length + 1))).all()
        return reward / last

    def _init(self, env: base.Env, key: Array) -> tuple[Any, Any, replay.Replay]:
        agent_key, env_key = jax.random.split(key)
        state = self.agent.init(agent_key)
        playing = (jax.vmap(env.prepare)(jax.random.split(env_key, NUM_ENVS)), self.agent.init_policy(NUM_ENVS))
        seen = jax.eval_shape(lambda: self._play(env, "sample", state.params, playing, key)[1])
        row = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), seen)
        return state, playing, replay.init(row, CAPACITY, NUM_ENVS)

    def _play(self, env: base.Env, mode: str, params: Params, playing: Any, key: Array) -> tuple[Any, Transition]:
        """`STEPS` vector steps: environment and policy states after them, and what was seen ``[STEPS, N, ...]``."""

        def step(carry: Any, key: Array) -> tuple[Any, Transition]:
            env_state, policy = carry
            env_state, timestep = jax.vmap(env.step)(env_state, policy.prev_action)
            policy, action = self.agent.act(params, policy, timestep, key, mode=mode)
            return (env_state, policy), transition(timestep, policy, action)

        return jax.lax.scan(step, playing, jax.random.split(key, STEPS))

    def _collect(self, env: base.Env, params: Params, playing: Any, ring: replay.Replay, key: Array) -> Any:
        playing, seen = self._play(env, "sample", params, playing, key)
        return playing, jax.lax.scan(lambda ring, row: (replay.add(ring, row), None), ring, seen)[0]

    def _updates(self, state: Any, ring: replay.Replay, key: Array) -> tuple[Any, replay.Replay, Metrics]:
        def update(carry: Any, key: Array) -> tuple[Any, Metrics]:
            state, ring = carry
            batch = replay.sample(ring, key, self.config.batch_size, self.config.batch_length)
            before = state.update
            state, latents, metrics = self.agent.train_step(state, batch)
            ring = replay.write_latents(ring, batch.index, latents, where=state.update > before)
            return (state, ring), metrics

        keys = jax.random.split(key, STEPS * NUM_ENVS // STEPS_PER_UPDATE)
        (state, ring), metrics = jax.lax.scan(update, (state, ring), keys)
        return state, ring, jax.tree.map(lambda x: x[-1], metrics)


def transition(timestep: TimeStep, policy: Any, action: Array) -> Transition:
    """A row of replay."""
    flags = (timestep.is_first, timestep.is_last, timestep.is_terminal)
    return Transition(timestep.obs, action, timestep.reward, *flags, policy.latent)


@functools.cache
def trainer(method: str) -> Trainer:
    """A method's, made once."""
    return Trainer(learner(method), probes.PICTURE if method in PICTURES else probes.SPEC)


def returns(method: str, name: str, seeds: Sequence[int]) -> np.ndarray:
    """Mean return ``[R]`` of each seed's policy after the probe's number of updates."""
    probe, updates = probe_for(method, name), DRQV2_UPDATES if method == names.DRQV2 else UPDATES[name]
    params, _ = trainer(method).train(probe, updates, seeds)
    return trainer(method).evaluate(probe, params)


@click.command(help=__doc__, context_settings={"show_default": True})
@click.option("--method", "methods", type=Name("method", names.METHODS), multiple=True, help="Default: all of them.")
@click.option(
    "--probe", "chosen", type=Name("probe", tuple(probes.PROBES)), multiple=True, help="Default: all of them."
)
@click.option("--seeds", type=click.IntRange(1, 1000), default=5, help="Seeds 0, 1, ... of each, all at once.")
def main(methods: tuple[str, ...], chosen: tuple[str, ...], seeds: int) -> None:
    """Prints a row of the table as soon as it is measured."""
    click.echo("| method | probe | blind | median | seeds | minutes |\n| --- | --- | --- | --- | --- | --- |")
    for method in methods or names.METHODS:
        for name in chosen or probes.PROBES:
            begin = time.monotonic()
            found, blind = returns(method, name, range(seeds)), probes.PROBES[name]().blind
            each, minutes = " ".join(f"{value:.2f}" for value in found), (time.monotonic() - begin) / 60
            click.echo(f"| `{method}` | {name} | {blind:.2f} | {np.median(found):.2f} | {each} | {minutes:.1f} |")


if __name__ == "__main__":
    main()
