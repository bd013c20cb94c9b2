"""An environment in which everything that happened can be read off what is seen, and a stub that acts in it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.agents.guard import SKIPPED
from ne_dreamer_jax.envs.base import Core, Env, Pictures, Progress, from_core, restart_or_step
from ne_dreamer_jax.types import (
    ArraySpec,
    ContinuousAction,
    DiscreteAction,
    EnvSpec,
    Latent,
    PolicyState,
    ReturnScale,
    TrainState,
)


class Count(NamedTuple):
    """An episode has a name, a step and the last action's effect."""

    name: jax.Array  # int32 [], drawn at the start
    t: jax.Array  # int32 []
    effect: jax.Array  # float32 []


def length_of(name: Any) -> Any:
    """Steps of an episode."""
    return 2 + name % 3


def reward_of(t: Any, effect: Any) -> Any:
    """Received on arrival at step t by an action with this effect."""
    return t + 0.25 * effect


def env(discrete: bool = False, image: bool = True, breaks: bool = False) -> Env:
    """The observation is (name, t, effect of the action that led here), and an image full of t.

    Episodes with an even name end terminally, the others by a time limit. Where it ``breaks``, those whose name three
    divides do so at step 1.
    """
    action = DiscreteAction(3) if discrete else ContinuousAction(1)
    observation = {"vector": ArraySpec((3,), jnp.float32)}
    if image:
        observation["image"] = ArraySpec((8, 8, 3), jnp.uint8)

    def reset(key: jax.Array) -> Count:
        return Count(jax.random.randint(key, (), 0, 1000), jnp.zeros((), jnp.int32), jnp.zeros(()))

    def step(state: Count, action: jax.Array) -> tuple[Count, Progress]:
        effect = action.astype(jnp.float32) if discrete else action[0]
        state = Count(state.name, state.t + 1, effect)
        is_last = state.t >= length_of(state.name)
        reward = reward_of(state.t.astype(jnp.float32), effect)
        broken = (state.name % 3 == 0) & (state.t == 1) & breaks
        return state, Progress(reward, is_last, is_last & (state.name % 2 == 0), ~broken)

    def observe(state: Count) -> dict[str, jax.Array]:
        seen = [state.name.astype(jnp.float32), state.t.astype(jnp.float32), state.effect]
        obs = {"vector": jnp.stack(seen), "image": jnp.full((8, 8, 3), state.t, jnp.uint8)}
        return {name: obs[name] for name in observation}

    pictures = Pictures(
        record=lambda state: state.t.astype(jnp.float32)[None],
        redraw=lambda record: jnp.full((8, 8, 3), record[0].astype(jnp.uint8)),
    )
    spec = EnvSpec(observation, action)
    return from_core(Core(spec, reset, restart_or_step(reset, step), observe, pictures if image else None))


def stub(spec: EnvSpec, batch_size: int = 2, batch_length: int = 3, weight: float = 0.5) -> Any:
    """Stands for an agent in the loop, and compiles in no time.

    It acts at random around ``params``; an update adds one to ``params``, and marks the latents that it was given by
    minus the number of the update. Latents of acting hold the step t.
    """
    discrete = isinstance(spec.action, DiscreteAction)

    def init(key: jax.Array) -> TrainState:
        scale = ReturnScale(jnp.zeros(()), jnp.zeros(()))
        return TrainState(jnp.zeros(()), jnp.zeros(()), {}, {}, scale, key, jnp.zeros((), jnp.int32))

    def latent(mark: jax.Array) -> Latent:
        one_hot = jax.nn.one_hot(jnp.zeros((*mark.shape, 1), jnp.int32), 2)
        return Latent(jnp.stack([mark, mark], axis=-1), one_hot)

    def init_policy(n: int) -> PolicyState:
        return PolicyState(latent(jnp.zeros((n,))), jnp.zeros((n, *spec.action.shape), spec.action.dtype))

    def act(params: Any, policy: PolicyState, timestep: Any, key: jax.Array, mode: str = "sample") -> Any:
        n = timestep.reward.shape[0]
        best = timestep.obs["vector"][:, 1]  # the mode: t
        if discrete:
            drawn = jax.random.randint(key, (n,), 0, 3)
            action = drawn if mode == "sample" else best.astype(jnp.int32) % 3
        else:
            drawn = jax.random.uniform(key, (n, 1), minval=-1.0)
            action = drawn if mode == "sample" else jnp.clip(best[:, None] / 4, -1.0, 1.0)
        return PolicyState(latent(best), action), action

    def train_step(state: TrainState, batch: Any) -> Any:
        update = state.update + 1
        mark = jnp.full(batch.reward.shape, -update, jnp.float32)
        metrics = {"update": update.astype(jnp.float32), "reward": jnp.mean(batch.reward), SKIPPED: jnp.zeros(())}
        return state._replace(params=state.params + weight, update=update), latent(mark), metrics

    config = SimpleNamespace(batch_size=batch_size, batch_length=batch_length)
    return SimpleNamespace(
        init=init,
        init_policy=init_policy,
        act=act,
        train_step=train_step,
        config=config,
        spec=spec,
        working_bytes=lambda params: 0,
    )
