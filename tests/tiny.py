"""The smallest agent that has every part, data for it, and states made without compiling anything."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.agents.dreamer.agent import BASE_LOSS_SCALES, AgentConfig, world_model_of
from ne_dreamer_jax.agents.dreamer.behavior import BehaviorConfig
from ne_dreamer_jax.agents.optim import OptimizerConfig
from ne_dreamer_jax.nets.encoder import EncoderConfig
from ne_dreamer_jax.nets.heads import HeadsConfig
from ne_dreamer_jax.nets.networks import Networks
from ne_dreamer_jax.nets.predictor import PredictorConfig
from ne_dreamer_jax.nets.rssm import RSSMConfig
from ne_dreamer_jax.objectives import DreamerPro, Model, NextEmbedding, NoObjective, Reconstruction, SameStep
from ne_dreamer_jax.types import ArraySpec, Batch, ContinuousAction, DiscreteAction, EnvSpec, Latent

IMAGE, VECTOR = ArraySpec((8, 8, 3), jnp.uint8), ArraySpec((3,), jnp.float32)
BOTH = EnvSpec({"image": IMAGE, "vector": VECTOR}, ContinuousAction(2))
VECTORS = EnvSpec({"vector": VECTOR}, ContinuousAction(2))
DISCRETE = EnvSpec({"vector": VECTOR}, DiscreteAction(3))

CONFIG = AgentConfig(
    encoder=EncoderConfig(depth=1, multipliers=(2, 3), kernel=3, layers=1, units=8),
    rssm=RSSMConfig(deter=32, stoch=4, classes=4, hidden=8, blocks=4, prior_layers=1),
    heads=HeadsConfig(units=8, actor_layers=1, critic_layers=1, bins=15, actor_scale=1.0),
    objective=NextEmbedding(PredictorConfig(layers=1, width=8, heads=2, feedforward=16, positions=8)),
    behavior=BehaviorConfig(horizon=3),
    optimizer=OptimizerConfig(learning_rate=1e-3, warmup=2),
    batch_size=2,
    batch_length=5,
)


OBJECTIVES: dict[str, Any] = {
    "ne_dreamer": CONFIG.objective,
    "dreamerv3": Reconstruction(blocks=1),
    "r2dreamer": SameStep(),
    "dreamerpro": DreamerPro(prototypes=7, dimension=3),
    "dreamer_no_reconstruction": NoObjective(),
}
"""Method -> its objective at the tiny agent's size."""


def networks(spec: EnvSpec = BOTH, config: AgentConfig = CONFIG, dtype: Any = jnp.float32) -> Networks:
    """The networks of an agent."""
    return Networks.build(spec, config.encoder, config.rssm, config.heads, dtype)


def model(nets: Networks, config: AgentConfig = CONFIG) -> Model:
    """What an objective of the agent is built for."""
    return world_model_of(nets, config.batch_length)


def with_method(objective: Any, config: AgentConfig = CONFIG) -> AgentConfig:
    """The tiny agent with another objective, its losses weighed as its authors do."""
    return replace(config, objective=objective, loss_scales={**BASE_LOSS_SCALES, **objective.losses})


def fill(shapes: Any, seed: int = 0, std: float = 0.3) -> Any:
    """Random arrays of these shapes: normal where they are float32 (norms' scales around one), zero elsewhere."""
    rng = np.random.default_rng(seed)

    def array(path: Any, x: Any) -> jax.Array:
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.key(seed)
        if x.dtype != jnp.float32:
            return jnp.zeros(x.shape, x.dtype)
        offset = 1.0 if "scale" in jax.tree_util.keystr(path) else 0.0
        return jnp.asarray(rng.normal(offset, std, x.shape).astype(np.float32))

    return jax.tree_util.tree_map_with_path(array, shapes)


def params(nets: Networks, seed: int = 0) -> dict[str, Any]:
    """Random parameters of the networks, none of them zero."""
    return fill(jax.eval_shape(nets.init, jax.random.key(0)), seed)


def state(agent: Any, seed: int = 0) -> Any:
    """A train state with random parameters, and all else as at the start."""
    shapes = jax.eval_shape(agent.init, jax.random.key(0))
    filled = fill(shapes.params, seed)
    rest = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes._replace(params=None, key=None))
    return rest._replace(params=filled, slow_critic=jax.tree.map(jnp.copy, filled["critic"]), key=jax.random.key(seed))


def latent(shape: tuple[int, ...], seed: int = 0, config: RSSMConfig = CONFIG.rssm) -> Latent:
    """Random latents with leading axes ``shape``."""
    rng = np.random.default_rng(seed)
    deter = rng.uniform(-1, 1, (*shape, config.deter)).astype(np.float32)
    classes = rng.integers(config.classes, size=(*shape, config.stoch))
    return Latent(jnp.asarray(deter), jnp.asarray(np.eye(config.classes, dtype=np.float32)[classes]))


def batch(spec: EnvSpec = BOTH, shape: tuple[int, int] = (2, 5), seed: int = 0, first: Any = ((0, 0), (1, 2))) -> Batch:
    """A batch of noise, with actions that leave their bounds, whose episodes begin at the indices ``first``.

    Each episode but the first of a row ends terminally.
    """
    rng = np.random.default_rng(seed)
    rows, length = shape
    is_first = np.zeros((rows, length + 1), bool)
    for row, t in first:
        is_first[row, t] = True
    is_last = is_first[:, 1:]
    obs = {}
    for name, (extent, dtype) in spec.observation.items():
        whole = dtype == jnp.uint8
        x = rng.integers(0, 256, (*shape, *extent)) if whole else rng.normal(0, 2, (*shape, *extent))
        obs[name] = jnp.asarray(x.astype(dtype))
    if isinstance(spec.action, DiscreteAction):
        action = rng.integers(spec.action.size, size=(rows, length + 1)).astype(np.int32)
    else:
        action = rng.uniform(-1.2, 1.2, (rows, length + 1, spec.action.size)).astype(np.float32)
    return Batch(
        obs=obs,
        action=jnp.asarray(action[:, 1:]),
        prev_action=jnp.asarray(action[:, :-1]),
        reward=jnp.asarray(rng.normal(0, 1, shape).astype(np.float32)),
        is_first=jnp.asarray(is_first[:, :-1]),
        is_last=jnp.asarray(is_last),
        is_terminal=jnp.asarray(is_last),
        context=latent((rows,), seed),
        index=jnp.arange(rows * length, dtype=jnp.int32).reshape(shape),
    )


def with_objective(**changes: Any) -> AgentConfig:
    """The tiny agent with another next-embedding objective."""
    return replace(CONFIG, objective=replace(CONFIG.objective, **changes))


def program(function: Any, *args: Any) -> str:
    """What a function computes, as text: equal for equal computations."""
    jaxpr = jax.make_jaxpr(function)(*args)
    return re.sub(r" at 0x[0-9a-f]+", "", f"{jaxpr} {jaxpr.consts}")


def assert_same(got: Any, want: Any) -> None:
    """All leaves are equal to the bit."""
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for (path, x), y in zip(jax.tree.leaves_with_path(got), jax.tree.leaves(want), strict=True):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y), err_msg=jax.tree_util.keystr(path))


def is_zero(tree: Any) -> bool:
    """Whether every leaf is zero everywhere."""
    return not any(np.any(np.asarray(x)) for x in jax.tree.leaves(tree))
