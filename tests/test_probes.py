"""Each method on each probe: who should solve it does, and who lacks what it asks for doesn't."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax import config as configs
from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.dreamer.agent import AgentConfig
from ne_dreamer_jax.agents.dreamer.behavior import BehaviorConfig
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.agents.optim import OptimizerConfig
from ne_dreamer_jax.envs import probes
from ne_dreamer_jax.nets.encoder import EncoderConfig
from ne_dreamer_jax.nets.heads import HeadsConfig
from ne_dreamer_jax.nets.predictor import PredictorConfig
from ne_dreamer_jax.nets.rssm import RSSMConfig
from ne_dreamer_jax.objectives import DreamerPro, NextEmbedding
from ne_dreamer_jax.replay import ring as replay
from ne_dreamer_jax.types import EnvSpec, TimeStep, Transition

NUM_ENVS, STEPS, CAPACITY = 8, 32, 16_384

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
    steps_per_update=8.0,
)
UPDATES = {"bandit": 600, "two_steps": 1_200, "echo": 1_200, "target": 4_000, "cue": 5_000}
"""Probe -> updates of a world model. The cue asks for three things at once: to see it, to keep it, to use it."""
DRQV2_UPDATES = 2_000


def world_model(method: str) -> AgentConfig:
    """The agent of a method, at a size that learns in a minute or two."""
    return configs.with_method(configs.Config(agent=WORLD_MODEL), method).agent


LEARNERS: dict[str, Any] = {
    "drqv2": DRQV2,
    "ne_dreamer": WORLD_MODEL,
    "dreamerv3": world_model("dreamerv3"),
    "r2dreamer": world_model("r2dreamer"),
    "dreamerpro": dataclasses.replace(
        world_model("dreamerpro"), objective=DreamerPro(prototypes=64, frozen_updates=1_000)
    ),
    "dreamer_no_reconstruction": world_model("dreamer_no_reconstruction"),
}

PICTURES = {"dreamerpro"}
"""They need images."""

SOLVED = {"target": 0.7}
"""Share of the way from blind to optimal that counts as solved, where it isn't 0.8: a number has to pass through
latents of which each step has one nat for nothing."""

SEEDS = {"cue": 3}
"""Probe -> seeds of which one has to solve it, where that isn't the first: until cue, memory and use come together by
chance there is nothing to learn from, and in 5,000 updates that happens with most seeds, not with all."""

UNABLE = {
    ("drqv2", "cue"): "it sees three frames and remembers nothing",
    (
        "dreamer_no_reconstruction",
        "cue",
    ): "nothing tells it that there is a cue until a reward depends on it, much later",
}


class Trainer:
    """An agent, compiled once for all probes: their spec is the same."""

    def __init__(self, config: Any, spec: EnvSpec = probes.SPEC) -> None:
        self.agent, self.config = make_agent(config, spec), config
        self.learn = jax.jit(self._learn, donate_argnums=(0, 1))

    def _learn(self, state: Any, ring: Any, key: Any) -> Any:
        batch = replay.sample(ring, key, self.config.batch_size, self.config.batch_length)
        state, latents, metrics = self.agent.train_step(state, batch)
        return state, replay.write_latents(ring, batch.index, latents), metrics

    def play(self, env: Any, mode: str) -> Any:
        """(params, environment states, policy, key) -> these after `STEPS` vector steps, and what was seen."""

        def step(carry: Any, _: None) -> Any:
            params, env_state, policy, key = carry
            key, act_key = jax.random.split(key)
            env_state, timestep = jax.vmap(env.step)(env_state, policy.prev_action)
            policy, action = self.agent.act(params, policy, timestep, act_key, mode=mode)
            return (params, env_state, policy, key), transition(timestep, policy, action)

        @jax.jit
        def run(params: Any, env_state: Any, policy: Any, key: Any) -> Any:
            carry, seen = jax.lax.scan(step, (params, env_state, policy, key), None, length=STEPS)
            return carry[1:3], seen

        return run

    def train(self, probe: probes.Probe, updates: int, seed: int = 0) -> tuple[Any, list[dict[str, float]]]:
        """The parameters after these many updates, one every 8 agent steps."""
        key = jax.random.key(seed)
        state, policy = self.agent.init(key), self.agent.init_policy(NUM_ENVS)
        env_state = jax.vmap(probe.env.prepare)(jax.random.split(key, NUM_ENVS))
        run, add = self.play(probe.env, "sample"), jax.jit(_add_all, donate_argnums=0)
        (env_state, policy), seen = run(state.params, env_state, policy, key)
        ring = add(replay.init(jax.tree.map(lambda x: x[0], seen), CAPACITY, NUM_ENVS), seen)
        each, history = STEPS * NUM_ENVS // 8, []
        for number in range(-(-updates // each)):
            for _ in range(4 if number == 0 else 1):  # the first updates see a thousand steps
                key, run_key = jax.random.split(key)
                (env_state, policy), seen = run(state.params, env_state, policy, run_key)
                ring = add(ring, seen)
            for _ in range(each):
                key, learn_key = jax.random.split(key)
                state, ring, metrics = self.learn(state, ring, learn_key)
            history.append({name: float(value) for name, value in jax.device_get(metrics).items()})
        return state.params, history

    def evaluate(self, probe: probes.Probe, params: Any, episodes: int = 256) -> float:
        """Mean return of the policy's mode, over whole episodes."""
        env_state = jax.vmap(probe.env.prepare)(jax.random.split(jax.random.key(99), episodes))
        run = self.play(probe.env, "mode")
        _, seen = run(params, env_state, self.agent.init_policy(episodes), jax.random.key(98))
        whole = STEPS // (probe.length + 1) * (probe.length + 1)  # all episodes begin and end together
        reward, last = np.asarray(seen.reward)[:whole], np.asarray(seen.is_last)[:whole]
        assert last.sum() == episodes * (whole // (probe.length + 1))
        return float(reward.sum() / last.sum())


def transition(timestep: TimeStep, policy: Any, action: Any) -> Transition:
    flags = (timestep.is_first, timestep.is_last, timestep.is_terminal)
    return Transition(timestep.obs, action, timestep.reward, *flags, policy.latent)


def _add_all(ring: Any, seen: Transition) -> Any:
    return jax.lax.scan(lambda ring, step: (replay.add(ring, step), None), ring, seen)[0]


@functools.cache
def trainer(method: str) -> Trainer:
    return Trainer(LEARNERS[method], probes.PICTURE if method in PICTURES else probes.SPEC)


@pytest.mark.slow
@pytest.mark.parametrize("name", probes.PROBES)
@pytest.mark.parametrize("method", LEARNERS)
def test_who_should_solve_a_probe_does_and_who_lacks_the_ability_does_not(method, name, record_property):
    probe = probes.PROBES[name]()
    if method in PICTURES:
        probe = probes.as_picture(probe)
    solved = probe.blind + SOLVED.get(name, 0.8) * (probe.optimum - probe.blind)
    returns = []
    for seed in range(SEEDS.get(name, 1)):
        params, _ = trainer(method).train(probe, DRQV2_UPDATES if method == "drqv2" else UPDATES[name], seed)
        returns.append(trainer(method).evaluate(probe, params))
        if returns[-1] > solved:
            break
    record_property("returns", returns)
    reached = ", ".join(f"{value:.3f}" for value in returns)
    print(f"{method} on {name}: {reached} of {probe.optimum} (blind {probe.blind})")
    if (method, name) in UNABLE:
        assert max(returns) < probe.blind + 0.1, f"expected not to solve it: {UNABLE[method, name]}"
    else:
        assert returns[-1] > solved


@pytest.mark.slow
def test_drqv2_solves_the_cue_once_its_stack_reaches_back_to_it():
    """So that what it lacks is memory, and nothing else."""
    probe = probes.cue(delay=4)
    seeing = Trainer(dataclasses.replace(DRQV2, frame_stack=5))
    params, _ = seeing.train(probe, DRQV2_UPDATES)
    assert seeing.evaluate(probe, params) > 0.9


@pytest.mark.slow
def test_the_next_embedding_of_an_echo_is_predicted_from_the_action_alone():
    """With the action before it instead, as the authors' code has it, there is nothing to predict it from."""
    probe = probes.echo()
    loss = {}
    for action in ("current", "previous"):
        objective = dataclasses.replace(WORLD_MODEL.objective, action=action)
        # A policy that stays random: its last action says nothing of the next.
        behavior = dataclasses.replace(WORLD_MODEL.behavior, entropy=10.0)
        config = dataclasses.replace(WORLD_MODEL, objective=objective, behavior=behavior)
        _, history = Trainer(config).train(probe, 600)
        loss[action] = np.mean([line["loss/next_embedding"] for line in history[-5:]])
    print(loss)
    assert loss["current"] < 0.5 * loss["previous"]


def test_a_trainer_takes_any_learner():
    """The driver itself, without waiting for an agent to learn."""
    quick = Trainer(dataclasses.replace(DRQV2, batch_size=8, features=4, units=8))
    probe = probes.target()
    params, history = quick.train(probe, 1)
    assert np.isfinite(list(history[-1].values())).all()
    assert -1.0 <= quick.evaluate(probe, params, episodes=4) <= 1.0
    assert jnp.isfinite(jax.tree.leaves(params)[0]).all()
