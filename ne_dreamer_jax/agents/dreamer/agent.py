"""The agent: configs and networks in, four pure functions out."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import optax

from ne_dreamer_jax import shapes
from ne_dreamer_jax.agents import guard, optim
from ne_dreamer_jax.agents.base import Agent, Heads, Imagined, Inspection
from ne_dreamer_jax.agents.dreamer import behavior, world_model
from ne_dreamer_jax.agents.dreamer.behavior import BehaviorConfig
from ne_dreamer_jax.agents.dreamer.world_model import WorldModelConfig
from ne_dreamer_jax.agents.optim import OptimizerConfig
from ne_dreamer_jax.losses.twohot import symexp_bins, twohot_mean
from ne_dreamer_jax.nets.encoder import EncoderConfig
from ne_dreamer_jax.nets.heads import HeadsConfig, decode_action, encode_action, policy
from ne_dreamer_jax.nets.networks import Networks
from ne_dreamer_jax.nets.rssm import RSSM, RSSMConfig, feature, initial_latent
from ne_dreamer_jax.objectives import AnyObjective, Model, NextEmbedding
from ne_dreamer_jax.settings import names, ranges
from ne_dreamer_jax.settings.ranges import Count, NonNegative, Range
from ne_dreamer_jax.system.compilation import jit_to_run_once
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import (
    Array,
    ArraySpec,
    Batch,
    EnvSpec,
    Latent,
    Metrics,
    Params,
    PolicyState,
    ReturnScale,
    Rollout,
    TimeStep,
    TrainState,
)

BASE_LOSS_SCALES = {
    "dynamics": 1.0,
    "representation": 0.1,
    "reward": 1.0,
    "continue": 1.0,
    "actor": 1.0,
    "critic": 1.0,
    "replay_critic": 0.3,
}


REINFORCE_ARRAYS = 7.5
"""Arrays as large as all imagined features that an update needs at once, measured by benchmarks.memory."""
DYNAMICS_ARRAYS = 23.5
"""The same where the actor's gradient passes the world model."""
FRAME_BYTES = 140_000
"""Bytes that the encoder's gradient needs for each step of a batch, measured likewise."""


@dataclass(frozen=True)
class AgentConfig:
    """Everything that defines a world-model agent and its update."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    rssm: RSSMConfig = field(default_factory=RSSMConfig)
    heads: HeadsConfig = field(default_factory=HeadsConfig)
    world_model: WorldModelConfig = field(default_factory=WorldModelConfig)
    objective: AnyObjective = field(default_factory=NextEmbedding)
    behavior: BehaviorConfig = field(default_factory=BehaviorConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    loss_scales: Mapping[str, NonNegative] = field(default_factory=lambda: {**BASE_LOSS_SCALES, "next_embedding": 1.0})
    """Weight of every named loss; the keys must be exactly the names of the losses."""
    batch_size: Annotated[int, Range(1, 1_000_000)] = 16
    """B, sequences in a batch."""
    batch_length: Annotated[int, Range(2, 1_000_000)] = 64
    """T, steps in a sequence."""
    microbatches: Count = 1
    """Parts in which an update's sequences, and the trajectories imagined from them, go one after the other through
    what takes most memory: encoder, recurrence, predictor or decoder, and imagination. The update is the same, its
    losses are taken over the whole batch; of what those need for the gradient there is one part in memory at a time,
    for one more forward pass. Divides ``batch_size``."""
    compute_dtype: Literal["float32", "bfloat16"] = "float32"
    """Of the matrix products: float32 or bfloat16. Parameters, statistics and losses are float32. (GPUs with
    TensorFloat-32 take it for float32 products, unless JAX's ``jax_default_matmul_precision`` says otherwise.)"""

    def __post_init__(self) -> None:
        ranges.check(self)
        if self.batch_size % self.microbatches:
            divisors = [str(n) for n in range(1, self.batch_size + 1) if self.batch_size % n == 0]
            raise ValueError(
                f"agent.microbatches: expected a divisor of agent.batch_size {self.batch_size} "
                f"({', '.join(divisors)}), got {self.microbatches}."
            )

    @property
    def method(self) -> str:
        """Name of the method that these settings are."""
        return names.method_of(self.objective)

    @property
    def latent_sizes(self) -> tuple[int, int, int]:
        """D, S, K of the latents in replay."""
        return (self.rssm.deter, self.rssm.stoch, self.rssm.classes)


@in_32_bits
def make_world_model_agent(config: AgentConfig, spec: EnvSpec) -> Agent:
    """The world-model agent of ``config`` for environments of ``spec``.

    Raises ValueError where the config and the environment do not fit: observations that no encoder takes, loss scales
    whose names are not the losses', sequences longer than the predictor's positions.
    """
    dtype = _compute_dtype(config.compute_dtype)
    nets = Networks.build(spec, config.encoder, config.rssm, config.heads, dtype)
    objective = config.objective.build(world_model_of(nets, config.batch_length, config.microbatches))
    optimizer = optim.make(config.optimizer)
    _check_loss_scales(config)

    def init(key: Array) -> TrainState:
        nets_key, objective_key, state_key = jax.random.split(key, 3)
        params = nets.init(nets_key)
        params["objective"] = objective.init(objective_key)
        return TrainState(
            params=params,
            slow_critic=jax.tree.map(jnp.copy, params["critic"]),
            target=objective.init_target(params),
            optimizer=optimizer.init(params),
            return_scale=ReturnScale(jnp.zeros(()), jnp.zeros(())),
            key=state_key,
            update=jnp.zeros((), jnp.int32),
        )

    def init_policy(num_envs: int) -> PolicyState:
        action = jnp.zeros((num_envs, *spec.action.shape), spec.action.dtype)
        return PolicyState(initial_latent(config.rssm, (num_envs,)), action)

    def act(
        params: Params, state: PolicyState, timestep: TimeStep, key: Array, mode: str = "sample"
    ) -> tuple[PolicyState, Array]:
        if mode not in ("sample", "mode"):
            raise ValueError(f"mode: expected 'sample' or 'mode', got {mode!r}.")
        lead = state.prev_action.shape[:1]
        shapes.check(_arrays(spec.observation, lead), dict(timestep.obs), "the agent")
        latent_key, action_key = jax.random.split(key)
        latent = world_model.posterior_step(nets, params, latent_key, state, timestep)
        distribution = policy(config.heads, spec.action, nets.apply("actor", params, feature(latent)))
        raw = distribution.sample(action_key) if mode == "sample" else distribution.mode()
        action = decode_action(spec.action, raw, config.heads.clip_actions)
        return PolicyState(latent, action), action

    def losses(params: Params, state: TrainState, key: Array, batch: Batch) -> tuple[Array, tuple]:
        observe_key, objective_key, imagine_key = jax.random.split(key, 3)
        rollout, posterior = world_model.posterior_rollout(nets, params, observe_key, batch, config.microbatches)
        model, model_metrics = world_model.prediction_losses(
            nets, config.world_model, params, rollout, posterior, behavior.head_discount(config.behavior)
        )
        with jax.named_scope("objective"):
            representation, objective_metrics = objective.loss(params, state.target, objective_key, rollout)
        actor_critic, scale, behavior_metrics = behavior.actor_critic_losses(
            nets,
            config.behavior,
            params,
            state.slow_critic,
            state.return_scale,
            imagine_key,
            rollout,
            state.update,
            config.microbatches,
        )
        named = {**model, **representation, **actor_critic}
        total = sum((config.loss_scales[name] * value for name, value in named.items()), jnp.zeros(()))
        metrics = {f"loss/{name}": value for name, value in named.items()} | {"loss/total": total}
        metrics |= model_metrics | objective_metrics | behavior_metrics
        return total, (rollout.latent, scale, metrics)

    def train_step(state: TrainState, batch: Batch) -> tuple[TrainState, Latent, Metrics]:
        if batch.reward.ndim != 2:
            raise ValueError(f"batch.reward: expected [B, T], got {list(batch.reward.shape)}")
        shapes.check(_batch_shapes(config, spec, *batch.reward.shape), batch, "the agent")
        key, loss_key = jax.random.split(state.key)
        grads, (latent, scale, metrics) = jax.grad(losses, has_aux=True)(state.params, state, loss_key, batch)
        named = {name: metrics[f"loss/{name}"] for name in config.loss_scales}
        finite, what_is_not = guard.check(named, grads)
        metrics |= {"gradient_norm": optax.tree.norm(grads)} | what_is_not
        return guard.update_if(finite, descend, state, grads, scale, key), jax.lax.stop_gradient(latent), metrics

    @jax.named_scope("optimizer")
    def descend(state: TrainState, grads: Params, scale: ReturnScale, key: Array) -> TrainState:
        updates, optimizer_state = optimizer.update(grads, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        update, rate = state.update + 1, config.behavior.slow_rate
        return TrainState(
            params=params,
            slow_critic=jax.tree.map(
                lambda slow, fast: slow + rate * (fast - slow), state.slow_critic, params["critic"]
            ),
            target=objective.after_update(params, state.target, update),
            optimizer=optimizer_state,
            return_scale=scale,
            key=key,
            update=update,
        )

    return Agent(
        init=jit_to_run_once(in_32_bits(init)),
        init_policy=in_32_bits(init_policy),
        act=jax.jit(in_32_bits(act), static_argnames="mode"),
        train_step=jax.jit(in_32_bits(train_step), donate_argnums=0),
        config=config,
        spec=spec,
        working_bytes=lambda params: _working_bytes(config, nets.feature, params),
        inspection=inspection(config, nets),
    )


def inspection(config: AgentConfig, nets: Networks) -> Inspection:
    """The world model's functions, for looking into it."""
    bins = symexp_bins(config.heads.bins)

    def posterior(params: Params, key: Array, batch: Batch) -> Rollout:
        return world_model.posterior_rollout(nets, params, key, batch)[0]

    def heads(params: Params, feature: Array) -> Heads:
        distribution = policy(config.heads, nets.spec.action, nets.apply("actor", params, feature))
        return Heads(
            reward=twohot_mean(nets.apply("reward", params, feature), bins),
            discount=behavior.expected_discount(config.behavior, nets.apply("continue", params, feature)),
            value=twohot_mean(nets.apply("critic", params, feature), bins),
            action=decode_action(nets.spec.action, distribution.mode(), config.heads.clip_actions),
        )

    def imagine(params: Params, key: Array, latent: Latent, horizon: int) -> Imagined:
        noise = behavior.imagination_noise(nets, key, latent.deter.shape[0], horizon)
        trajectory = behavior.imagine(nets, params, noise, latent)
        features = jnp.concatenate([trajectory.seen, trajectory.last[None]])
        action = decode_action(nets.spec.action, trajectory.action, config.heads.clip_actions)
        return Imagined(features, action, heads(params, features))

    def open_loop(params: Params, key: Array, latent: Latent, actions: Array) -> Latent:
        encoded = encode_action(nets.spec.action, actions, config.heads.clip_actions)
        noise = behavior.imagination_noise(nets, key, latent.deter.shape[0], actions.shape[0])

        def step(latent: Latent, taken: tuple[Array, Array]) -> tuple[Latent, Latent]:
            after: Any = nets.rssm.apply({"params": params["rssm"]}, latent, *taken, method=RSSM.imagine_step)
            return after, after

        return jax.lax.scan(step, latent, (encoded, noise.latent))[1]

    return Inspection(
        posterior=jax.jit(in_32_bits(posterior)),
        imagine=jax.jit(in_32_bits(imagine), static_argnums=3),
        open_loop=jax.jit(in_32_bits(open_loop)),
        heads=jax.jit(in_32_bits(heads)),
    )


def world_model_of(nets: Networks, length: int, microbatches: int = 1) -> Model:
    """What objectives are built for: networks, and sequences of ``length`` steps."""
    unroll = lambda params, key, batch: world_model.posterior_rollout(nets, params, key, batch, microbatches)[0]
    return Model(nets, length, unroll, microbatches)


def parameter_counts(params: Params) -> dict[str, int]:
    """Number of parameters by module name."""
    return {name: sum(x.size for x in jax.tree.leaves(tree)) for name, tree in params.items()}


def _working_bytes(config: AgentConfig, feature: int, params: Params) -> int:
    """The gradients; as much as some arrays of all imagined features of a microbatch; the encoder's, by frames.

    Imagined from all states: with fewer (`BehaviorConfig.imagine_last`) the peak lies elsewhere, and little below.
    """
    steps = config.batch_size * config.batch_length // config.microbatches
    imagined = 4 * feature * steps * (config.behavior.horizon + 1)
    arrays = REINFORCE_ARRAYS if config.behavior.gradient == "reinforce" else DYNAMICS_ARRAYS
    return 4 * sum(parameter_counts(params).values()) + int(arrays * imagined) + FRAME_BYTES * steps


def _compute_dtype(name: str) -> Any:
    return {"float32": jnp.float32, "bfloat16": jnp.bfloat16}[name]


def _check_loss_scales(config: AgentConfig) -> None:
    names = (*world_model.LOSSES, *behavior.LOSSES, *config.objective.losses)
    missing = sorted(set(names) - set(config.loss_scales))
    unknown = sorted(set(config.loss_scales) - set(names))
    if missing or unknown:
        hints = [f"{u!r} (nearest: {difflib.get_close_matches(u, names, 1, 0.0)[0]!r})" for u in unknown]
        raise ValueError(
            f"agent.loss_scales: expected exactly the losses {sorted(names)}; missing {missing}, unknown {hints}."
        )


def _arrays(specs: Mapping[str, ArraySpec], lead: tuple[int, ...]) -> dict[str, Any]:
    return {name: jax.ShapeDtypeStruct((*lead, *s.shape), s.dtype) for name, s in specs.items()}


def _batch_shapes(config: AgentConfig, spec: EnvSpec, batch: int, length: int) -> Batch:
    """What a batch of B sequences of T steps must be: ShapeDtypeStructs in the arrays' places."""
    lead, rssm = (batch, length), config.rssm
    action: Any = jax.ShapeDtypeStruct((*lead, *spec.action.shape), spec.action.dtype)
    flag: Any = jax.ShapeDtypeStruct(lead, jnp.bool_)
    deter: Any = jax.ShapeDtypeStruct((batch, rssm.deter), jnp.float32)
    stoch: Any = jax.ShapeDtypeStruct((batch, rssm.stoch, rssm.classes), jnp.float32)
    reward: Any = jax.ShapeDtypeStruct(lead, jnp.float32)
    index: Any = jax.ShapeDtypeStruct(lead, jnp.int32)
    return Batch(
        obs=_arrays(spec.observation, lead),
        action=action,
        prev_action=action,
        reward=reward,
        is_first=flag,
        is_last=flag,
        is_terminal=flag,
        context=Latent(deter, stoch),
        index=index,
    )
