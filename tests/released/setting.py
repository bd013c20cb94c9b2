"""A small agent, its data and its random numbers, at which this package and the authors' released code are compared.

`compare` makes the stored numbers with the authors' code at hand; tests/test_released.py runs without it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.dreamer.agent import AgentConfig
from ne_dreamer_jax.commands import train
from ne_dreamer_jax.nets.encoder import EncoderConfig
from ne_dreamer_jax.nets.heads import HeadsConfig
from ne_dreamer_jax.nets.rssm import RSSMConfig
from ne_dreamer_jax.objectives import DreamerPro, NextEmbedding, Reconstruction
from ne_dreamer_jax.types import ArraySpec, Batch, ContinuousAction, DiscreteAction, EnvSpec
from tests import tiny

STORED = Path(__file__).parent / "stored.npz"
SIDE = 16
UPDATES = 3
SOME = 64
ACTIONS = {"continuous": ContinuousAction(2), "discrete": DiscreteAction(3)}
METHODS = ("ne_dreamer", "ne_dreamer/no_shift", "ne_dreamer/no_projector", "dreamerv3", "r2dreamer", "dreamerpro")
CASES = tuple((method, actions) for method in METHODS for actions in ACTIONS)


def config(method: str) -> AgentConfig:
    """The agent of ``released_code`` at a very small size."""
    agent = train.configure("released_code", "1m", method, {}).agent
    assert isinstance(agent, AgentConfig)
    objective = agent.objective
    if isinstance(objective, NextEmbedding):
        predictor = replace(objective.predictor, width=8, heads=2, feedforward=32)
        objective = replace(objective, predictor=predictor)
    elif isinstance(objective, DreamerPro):
        objective = replace(objective, prototypes=7, dimension=3, max_shift=0.0)
    elif isinstance(objective, Reconstruction):
        objective = replace(objective, blocks=4)
    return replace(
        agent,
        encoder=EncoderConfig(depth=2, multipliers=(2, 4), layers=2, units=8),
        rssm=RSSMConfig(deter=32, stoch=4, classes=4, hidden=8, blocks=4),
        heads=HeadsConfig(units=8, actor_layers=2, critic_layers=2, bins=15, actor_scale=1.0, clip_actions=False),
        objective=objective,
        behavior=replace(agent.behavior, horizon=3),
        optimizer=replace(agent.optimizer, learning_rate=1e-3, warmup=4),
        batch_size=4,
        batch_length=6,
    )


def spec(actions: str, side: int = SIDE) -> EnvSpec:
    """Pictures and a vector."""
    picture, vector = ArraySpec((side, side, 3), jnp.uint8), ArraySpec((3,), jnp.float32)
    return EnvSpec({"image": picture, "vector": vector}, ACTIONS[actions])


def batch(agent: AgentConfig, spec: EnvSpec, seed: int) -> Batch:
    """Noise with an episode's end in it; an episode's first step has a zero action before it, as stored there."""
    made = tiny.batch(spec, (agent.batch_size, agent.batch_length), seed, first=((0, 0), (1, 2), (3, 6)))
    context = tiny.latent((agent.batch_size,), seed, agent.rssm)
    if not isinstance(spec.action, DiscreteAction):
        made = made._replace(prev_action=jnp.where(made.is_first[..., None], 0.0, made.prev_action))
    return made._replace(context=context)


class Draws(NamedTuple):
    """The random numbers of one update, drawn from its key as the agent draws them."""

    observe: np.ndarray  # [B, T, S], uniform: posterior latents
    views: np.ndarray  # [2 * B, T, S], uniform: those of DreamerPro's two views
    action: np.ndarray  # [H, M, A] normal or [H, M] uniform: imagined actions
    imagine: np.ndarray  # [H, M, S], uniform: prior latents


def draws(agent: AgentConfig, action: Any, key: jax.Array) -> Draws:
    """What the update that begins with this state's key draws."""
    rows, length, stoch = agent.batch_size, agent.batch_length, agent.rssm.stoch
    starts, steps = rows * length, agent.behavior.horizon
    _, loss_key = jax.random.split(key)
    observe_key, objective_key, imagine_key = jax.random.split(loss_key, 3)
    _, unroll_key = jax.random.split(objective_key)
    actions, latents = [], []
    for step_key in jax.random.split(imagine_key, steps):
        action_key, latent_key = jax.random.split(step_key)
        discrete = isinstance(action, DiscreteAction)
        draw = jax.random.uniform if discrete else jax.random.normal
        actions.append(draw(action_key, (starts,) if discrete else (starts, action.size)))
        latents.append(jax.random.uniform(latent_key, (starts, stoch)))
    return Draws(
        np.asarray(jax.random.uniform(observe_key, (rows, length, stoch))),
        np.asarray(jax.random.uniform(unroll_key, (2 * rows, length, stoch))),
        np.asarray(actions),
        np.asarray(latents),
    )


class Run(NamedTuple):
    """What is compared: of the first update its losses and gradients, and where several updates lead."""

    losses: dict[str, np.ndarray]  # name -> float32 [UPDATES]
    gradients: dict[str, np.ndarray]  # by the authors' names of parameters
    parameters: dict[str, np.ndarray]  # after UPDATES updates, the first `SOME` of each


def some(named: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The first numbers of each tensor, which are enough to tell what an optimiser does."""
    return {name: np.ravel(x)[:SOME] for name, x in named.items()}


def start(method: str, actions: str) -> tuple[AgentConfig, EnvSpec, Any, Any]:
    """Config, spec, agent and a train state with random parameters."""
    agent_config, env_spec = config(method), spec(actions)
    agent = make_agent(agent_config, env_spec)
    state = tiny.state(agent, seed=1)
    if isinstance(agent_config.objective, DreamerPro):
        own = state.params["objective"]
        own["prototypes"] /= jnp.linalg.norm(own["prototypes"], axis=-1, keepdims=True)  # as they are before an update
        taught = {"encoder": state.params["encoder"], "projection": own["embedding"]}
        state = state._replace(target={**state.target, **jax.tree.map(jnp.copy, taught)})
    return agent_config, env_spec, agent, state
