"""DrQ-v2's four functions: how it begins, acts and learns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from ne_dreamer_jax import shapes
from ne_dreamer_jax.agents import guard
from ne_dreamer_jax.agents.drqv2.config import DrQv2Config
from ne_dreamer_jax.agents.drqv2.networks import Networks
from ne_dreamer_jax.agents.drqv2.transitions import Transitions, n_step, random_shift
from ne_dreamer_jax.system.compilation import jit_to_run_once
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import Array, Batch, EnvSpec, Latent, Metrics, Params, TimeStep

BOUND = 1.0 - 1e-6  # of sampled actions


Functions = tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any], Callable[..., Any]]


class Policy(NamedTuple):
    """What acting carries from one step to the next, for N environments."""

    latent: Latent  # [N, 0], [N, 0, 1]: nothing, where the world-model agents have their state
    prev_action: Array  # float32 [N, A], the action taken from the newest observation
    stacked: dict[str, Array]  # [N, S, ...], the newest S observations of the episode, oldest first
    step: Array  # int32 [], agent steps of all N environments so far


class State(NamedTuple):
    """Everything a train step changes."""

    params: dict[str, Params]  # encoder, actor, critic
    target: Params  # moving average of params["critic"]
    optimizer: dict[str, Any]  # "critic" (with the encoder) and "actor": Adam's moments
    key: Array  # typed key []
    update: Array  # int32 [], updates done


def noise(config: DrQv2Config, step: Array) -> Array:
    """Standard deviation of the policy at an agent step (a number of any dtype []), float32 []."""
    mix = jnp.clip(step.astype(jnp.float32) / config.noise_steps, 0.0, 1.0)
    return (1.0 - mix) * config.noise_first + mix * config.noise_last


def sample(key: Array, mean: Array, std: Array, clip: float) -> Array:
    """Actions ``[N, A]`` around the means, the noise bounded by ``clip``; the bounds of actions pass gradients."""
    action = mean + jnp.clip(std * jax.random.normal(key, mean.shape), -clip, clip)
    return action + jax.lax.stop_gradient(jnp.clip(action, -BOUND, BOUND) - action)


def critic_loss(values: Array, target: Array, valid: Array) -> Array:
    """Both critics' squared errors ``values [B, 2]`` against ``target [B]``, summed, averaged where ``valid``."""
    return _mean(jnp.sum(jnp.square(values - target[:, None]), axis=1), valid)


@in_32_bits
def build(config: DrQv2Config, spec: EnvSpec) -> Functions:
    """``init``, ``init_policy``, ``act`` and ``train_step``, as `Agent` describes them.

    Raises ValueError where the environment does not fit (discrete actions, images too small), and for a setting out
    of its range.
    """
    nets = Networks.build(config, spec)
    adam = optax.flatten(optax.adam(config.learning_rate))  # one vector: few kernels to compile and to launch

    def init(key: Array) -> State:
        keys = jax.random.split(key, 4)
        params = nets.init(keys[:3])
        optimizer = {"critic": adam.init(_of_critic(params)), "actor": adam.init(params["actor"])}
        target = jax.tree.map(jnp.copy, params["critic"])
        return State(params, target, optimizer, keys[3], jnp.zeros((), jnp.int32))

    def init_policy(num_envs: int) -> Policy:
        lead = (num_envs, config.frame_stack)
        stacked = {name: jnp.zeros((*lead, *s.shape), s.dtype) for name, s in spec.observation.items()}
        action = jnp.zeros((num_envs, *spec.action.shape), spec.action.dtype)
        return Policy(nothing(num_envs), action, stacked, jnp.zeros((), jnp.int32))

    def act(
        params: Params, policy: Policy, timestep: TimeStep, key: Array, mode: str = "sample"
    ) -> tuple[Policy, Array]:
        if mode not in ("sample", "mode"):
            raise ValueError(f"mode: expected 'sample' or 'mode', got {mode!r}.")
        count = policy.prev_action.shape[0]
        shapes.check(_observations(spec, (count,)), dict(timestep.obs), "the agent")
        stacked = {name: push(policy.stacked[name], x, timestep.is_first) for name, x in timestep.obs.items()}
        action = nets.mean(params["actor"], nets.encode(params["encoder"], stacked))
        if mode == "sample":
            noise_key, random_key = jax.random.split(key)
            action = sample(noise_key, action, noise(config, policy.step), jnp.inf)
            random = jax.random.uniform(random_key, action.shape, minval=-1.0, maxval=1.0)
            action = jnp.where(policy.step < config.random_steps, random, action)
        step = jnp.minimum(policy.step, jnp.iinfo(jnp.int32).max - count) + count  # stays there, and never wraps round
        return Policy(policy.latent, action, stacked, step), action

    def critic_losses(params: Params, state: State, keys: Array, data: Transitions, std: Array) -> tuple[Array, Any]:
        obs = random_shift(keys[0], data.obs, config.shift)
        next_obs = random_shift(keys[1], data.next_obs, config.shift)
        encoding = nets.encode(params["encoder"], obs)
        next_encoding = jax.lax.stop_gradient(nets.encode(params["encoder"], next_obs))
        next_action = sample(keys[2], nets.mean(state.params["actor"], next_encoding), std, config.noise_clip)
        next_value = jnp.min(nets.values(state.target, next_encoding, next_action), axis=1)
        target = jax.lax.stop_gradient(data.reward + data.discount * next_value)
        values = nets.values(params["critic"], encoding, data.action)
        return critic_loss(values, target, data.valid), (encoding, _mean(target, data.valid))

    def actor_loss(params: Params, critic: Params, key: Array, encoding: Array, valid: Array, std: Array) -> Array:
        action = sample(key, nets.mean(params, encoding), std, config.noise_clip)
        return -_mean(jnp.min(nets.values(critic, encoding, action), axis=1), valid)

    def train_step(state: State, batch: Batch) -> tuple[State, Latent, Metrics]:
        length = config.batch_length
        shapes.check(_batch_shapes(spec, batch.reward.shape[0], length), batch, "the agent")
        key, loss_key = jax.random.split(state.key)
        keys = jax.random.split(loss_key, 4)
        step = config.random_steps + config.steps_per_update * state.update.astype(jnp.float32)
        std = noise(config, step)
        data = n_step(batch, config.frame_stack, config.discount)

        of_critic = _of_critic(state.params)
        (error, (encoding, target)), critic_grads = jax.value_and_grad(critic_losses, has_aux=True)(
            of_critic, state, keys[:3], data, std
        )
        of_critic, critic_optimizer = descend(of_critic, critic_grads, state.optimizer["critic"])
        # The critic as it is now, but the encodings that the batch had before the update.
        loss, grads = jax.value_and_grad(actor_loss)(
            state.params["actor"],
            of_critic["critic"],
            keys[3],
            jax.lax.stop_gradient(encoding),
            data.valid,
            std,
        )
        actor, actor_optimizer = descend(state.params["actor"], grads, state.optimizer["actor"])
        new = State(
            params={**of_critic, "actor": actor},
            target=jax.tree.map(
                lambda slow, fast: slow + config.target_rate * (fast - slow), state.target, of_critic["critic"]
            ),
            optimizer={"critic": critic_optimizer, "actor": actor_optimizer},
            key=key,
            update=state.update + 1,
        )
        metrics = {"loss/critic": error, "loss/actor": loss, "loss/total": error + loss, "target": target, "noise": std}
        finite, what_is_not = guard.check({"critic": error, "actor": loss}, {**critic_grads, "actor": grads})
        new = guard.update_if(finite, lambda state, new: new, state, new)
        return new, nothing(batch.reward.shape[0], length), metrics | what_is_not

    def descend(params: Params, grads: Params, optimizer: Any) -> tuple[Params, Any]:
        with jax.numpy_dtype_promotion("standard"):  # optax raises floats to int32 powers
            updates, optimizer = adam.update(grads, optimizer)
        return optax.apply_updates(params, updates), optimizer

    return (
        jit_to_run_once(in_32_bits(init)),
        in_32_bits(init_policy),
        jax.jit(in_32_bits(act), static_argnames="mode"),
        jax.jit(in_32_bits(train_step), donate_argnums=0),
    )


def push(stacked: Array, newest: Array, is_first: Array) -> Array:
    """The stack ``[N, S, ...]`` with ``newest [N, ...]`` in and the oldest out; where ``is_first``, full of it."""
    fresh = jnp.repeat(newest[:, None], stacked.shape[1], axis=1)
    moved = jnp.concatenate([stacked[:, 1:], newest[:, None]], axis=1)
    return jnp.where(jnp.expand_dims(is_first, range(1, stacked.ndim)), fresh, moved)


def nothing(*lead: int) -> Latent:
    """A latent without elements, for replay."""
    return Latent(jnp.zeros((*lead, 0)), jnp.zeros((*lead, 0, 1)))


def _of_critic(params: Params) -> dict[str, Params]:
    return {name: params[name] for name in ("encoder", "critic")}


def _mean(x: Array, valid: Array) -> Array:
    weight = valid.astype(jnp.float32)
    return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def _observations(spec: EnvSpec, lead: tuple[int, ...]) -> dict[str, Any]:
    return {name: jax.ShapeDtypeStruct((*lead, *s.shape), s.dtype) for name, s in spec.observation.items()}


def _batch_shapes(spec: EnvSpec, batch: int, length: int) -> Batch:
    """What a batch must be: ShapeDtypeStructs in the arrays' places."""

    def array(dtype: Any, *shape: int) -> Any:
        return jax.ShapeDtypeStruct((batch, length, *shape), dtype)

    action, flag = array(spec.action.dtype, *spec.action.shape), array(jnp.bool_)
    context: Any = jax.eval_shape(lambda: nothing(batch))
    return Batch(
        obs=_observations(spec, (batch, length)),
        action=action,
        prev_action=action,
        reward=array(jnp.float32),
        is_first=flag,
        is_last=flag,
        is_terminal=flag,
        context=context,
        index=array(jnp.int32),
    )
