"""A policy in environments of its own, episode by episode: for evaluations, videos and diagnostics. No replay."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.agents.base import Agent, Mode
from ne_dreamer_jax.envs.vector import VectorEnv
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import Array, ContinuousAction, Latent, PolicyState, images_of

STEPS = 64
"""Vector steps of one call to the device."""


class Evaluation(NamedTuple):
    """M episodes of a fixed policy."""

    returns: Array  # float32 [M]
    lengths: Array  # int32 [M], agent steps
    complete: Array  # bool [M], False where the environment cut it: by a fault of its own, or an action not finite
    frames: Any = None  # uint8 numpy [steps, H, W, C] of the first episode's first image, or None
    unfinished: int = 0  # episodes that had not ended at the bound
    steps: Any = None  # numpy: `Steps` of all episodes, where they were asked for


class Steps(NamedTuple):
    """What was seen and done, ``[steps, M, ...]``; meaningful where ``counts``."""

    obs: Any  # name -> [steps, M, ...], also what the environment shows and the agent does not see
    action: Any  # taken from obs
    reward: Any  # float32 [steps, M], on arrival at obs
    is_terminal: Any  # bool [steps, M], whether the episode ended there for good
    latent: Latent  # the posterior at obs
    counts: Any  # bool [steps, M], whether the step belongs to the episode


class Playing(NamedTuple):
    """Where M episodes are."""

    env: Any
    policy: PolicyState
    key: Array
    returns: Array  # float32 [M]
    lengths: Array  # int32 [M]
    complete: Array  # bool [M], meaningful where done
    done: Array  # bool [M]


class Play(Protocol):
    """Plays episodes with an agent's actions, or with uniformly random ones."""

    def __call__(
        self, params: Any, key: Array, episodes: int, random: bool = False, frames: bool = False, steps: bool = False
    ) -> Evaluation:
        """(params, key, M) -> the first episode of each of M environments side by side.

        ``frames`` keeps the first environment's images, ``steps`` what was seen and done in all.
        """
        ...


def make_play(env: VectorEnv, agent: Agent, max_steps: int, chunk_steps: int = STEPS, mode: Mode = "mode") -> Play:
    """A function that plays episodes in these environments with this agent.

    Args:
      env: observes at least what the agent does; what it does not see is for `Steps` and the frames alone.
      max_steps: agent steps after which an episode that has not ended is left; `Evaluation.unfinished` counts those.
      chunk_steps: vector steps of one call to the device.
      mode: which actions the agent takes, its policy's mode or samples.
    """
    run = jax.jit(
        in_32_bits(partial(_run, env, agent, chunk_steps, max_steps, mode)),
        static_argnames=("frames", "steps"),
        donate_argnums=1,
    )

    @in_32_bits
    def play(
        params: Any, key: Array, episodes: int, random: bool = False, frames: bool = False, steps: bool = False
    ) -> Evaluation:
        frames = frames and bool(images_of(env.spec))
        carry, clips, seen = begin(env, agent, key, episodes), [], []
        for _ in range(-(-(max_steps + 1) // chunk_steps)):
            carry, (clip, kept) = run(params, carry, jnp.asarray(random), frames=frames, steps=steps)
            if frames:
                images, counts = jax.device_get(clip)
                clips.append(images[counts])
            if steps:
                seen.append(jax.device_get(kept))
            if bool(jnp.all(carry.done | (carry.lengths >= max_steps))):
                break
        if env.release is not None:
            env.release(carry.env)
        return Evaluation(
            returns=carry.returns,
            lengths=carry.lengths,
            complete=carry.complete,
            frames=np.concatenate(clips) if clips else None,
            unfinished=int((~np.asarray(carry.done)).sum()),
            steps=jax.tree.map(lambda *parts: np.concatenate(parts), *seen) if seen else None,
        )

    return play


def begin(env: VectorEnv, agent: Agent, key: Array, episodes: int) -> Playing:
    """Before the first step of so many episodes."""
    env_key, key = jax.random.split(key)
    return Playing(
        env=env.prepare(jax.random.split(env_key, episodes)),
        policy=agent.init_policy(episodes),
        key=key,
        returns=jnp.zeros((episodes,), jnp.float32),
        lengths=jnp.zeros((episodes,), jnp.int32),
        complete=jnp.zeros((episodes,), bool),
        done=jnp.zeros((episodes,), bool),
    )


def random_action(spec: Any, key: Array, n: int) -> Array:
    """Uniform actions [n, ...] for environments of this action spec."""
    if isinstance(spec, ContinuousAction):
        return jax.random.uniform(key, (n, spec.size), jnp.float32, minval=-1.0, maxval=1.0)
    return jax.random.randint(key, (n,), 0, spec.size, jnp.int32)


def _run(
    env: VectorEnv,
    agent: Agent,
    length: int,
    max_steps: int,
    mode: Mode,
    params: Any,
    carry: Playing,
    random: Array,
    frames: bool,
    steps: bool,
) -> tuple[Playing, tuple[Any, Any]]:
    """So many steps of all episodes, and of each step the first one's image and all of it, where they are kept."""

    def step(carry: Playing, _: None) -> tuple[Playing, tuple[Any, Any]]:
        key, act_key, random_key = jax.random.split(carry.key, 3)
        env_state, shown = env.step(carry.env, carry.policy.prev_action)
        timestep = shown._replace(obs={name: shown.obs[name] for name in agent.spec.observation})
        policy, action = agent.act(params, carry.policy, timestep, act_key, mode=mode)
        action = jnp.where(random, random_action(agent.spec.action, random_key, action.shape[0]), action)
        policy = policy._replace(prev_action=action)
        counts, cuts = ~carry.done & (carry.lengths < max_steps), env.cuts(env_state)
        new = Playing(
            env=env_state,
            policy=policy,
            key=key,
            returns=carry.returns + jnp.where(counts, timestep.reward, 0.0),
            lengths=carry.lengths + (counts & ~timestep.is_first).astype(jnp.int32),
            complete=jnp.where(counts, cuts.faults + cuts.bad_actions == 0, carry.complete),
            done=carry.done | (counts & timestep.is_last),
        )
        clip = (shown.obs[next(iter(images_of(env.spec)))][0], counts[0]) if frames else None
        kept = Steps(dict(shown.obs), action, shown.reward, shown.is_terminal, policy.latent, counts) if steps else None
        return new, (clip, kept)

    return jax.lax.scan(step, carry, None, length=length)
