"""Probes: the smallest environments that ask for one ability each, with the best return known.

What an agent reaches in them says what of it works: a bandit takes a reward model, two steps the credit for what comes
later, a cue memory, a target continuous actions, an echo a model of what one's own actions do. The idea is that of
bsuite (Osband et al., 2020) and of the probe environments in Andy Jones's "Debugging RL, Without the Agonizing Pain".

All have the same spec, so that one compiled agent takes them all: the observation ``vector``, float32 [3] in [-1, 1],
and one continuous action. Episodes end terminally. `as_picture` is for agents that need images.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.types import Array, ArraySpec, ContinuousAction, EnvSpec, TimeStep

SPEC = EnvSpec({"vector": ArraySpec((3,), jnp.float32)}, ContinuousAction(1))


class Probe(NamedTuple):
    """An environment and what there is to reach in it, as mean return of an episode."""

    env: base.Env
    length: int  # steps of an episode
    optimum: float  # of the best policy
    blind: float  # of the best policy that lacks the ability that the probe asks for


class State(NamedTuple):
    """Where an episode is."""

    t: Array  # int32 [], steps so far
    memory: Array  # float32 [M], what the environment knows


def bandit() -> Probe:
    """One decision, always the same: a positive action is worth 1. Blind: either sign by chance."""

    def step(state: State, action: Array) -> tuple[Array, Array]:
        return state.memory, positive(action)

    return Probe(make(1, 1, lambda key: jnp.zeros(1), lambda state: vector(1.0), step), 1, 1.0, 0.5)


def two_steps() -> Probe:
    """The first action is worth 0.25 at once where it is negative, 1 one step later where it is positive.

    The second action does nothing. Blind: what is best at once, 0.25.
    """

    def step(state: State, action: Array) -> tuple[Array, Array]:
        begins = state.t == 0
        chosen = jnp.where(begins, positive(action), state.memory[0])
        return chosen[None], jnp.where(begins, 0.25 * (1.0 - chosen), chosen)

    def observe(state: State) -> Array:
        return vector(equals(state.t, 0), equals(state.t, 1) * state.memory[0])

    return Probe(make(2, 1, lambda key: jnp.zeros(1), observe, step), 2, 1.0, 0.25)


def cue(delay: int = 4) -> Probe:
    """A sign is shown at the start; ``delay`` steps later an action of that sign is worth 1.

    In between there is nothing to see, and actions do nothing. Blind: without memory, either sign by chance.
    """

    def step(state: State, action: Array) -> tuple[Array, Array]:
        right = positive(action * state.memory)
        return state.memory, equals(state.t, delay) * right

    def observe(state: State) -> Array:
        return vector(equals(state.t, 0) * state.memory[0], equals(state.t, delay))

    first = lambda key: jax.random.rademacher(key, (1,), jnp.float32)
    return Probe(make(delay + 1, 1, first, observe, step), delay + 1, 1.0, 0.5)


def cue_again(delay: int = 4) -> Probe:
    """As `cue`, but the last observation, after the action, shows the sign again, as a door that opens might.

    What a later observation depends on is asked for by predicting observations or their embeddings; in `cue` only the
    reward asks for it. Blind: as in `cue`.
    """

    def step(state: State, action: Array) -> tuple[Array, Array]:
        return state.memory, equals(state.t, delay) * positive(action * state.memory)

    def observe(state: State) -> Array:
        return vector((equals(state.t, 0) + equals(state.t, delay + 1)) * state.memory[0], equals(state.t, delay))

    first = lambda key: jax.random.rademacher(key, (1,), jnp.float32)
    return Probe(make(delay + 1, 1, first, observe, step), delay + 1, 1.0, 0.5)


def target(length: int = 4) -> Probe:
    """An episode shows a number in [-1, 1]; the return is 1 minus the mean distance of the actions from it.

    Blind: the best constant action, 0, has 0.5.
    """

    def step(state: State, action: Array) -> tuple[Array, Array]:
        return state.memory, (1.0 - jnp.abs(action[0] - state.memory[0])) / length

    first = lambda key: jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
    return Probe(make(length, 1, first, lambda state: vector(state.memory[0]), step), length, 1.0, 0.5)


def echo(length: int = 8) -> Probe:
    """Each observation is the action before it, and known from nothing else; an action of the other sign is rewarded.

    Blind: without seeing what one did, either sign by chance.
    """

    def step(state: State, action: Array) -> tuple[Array, Array]:
        return action, positive(-action * state.memory) / length

    first = lambda key: jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
    return Probe(make(length, 1, first, lambda state: vector(state.memory[0]), step), length, 1.0, 0.5)


def make(
    length: int,
    size: int,
    first: Callable[[Array], Array],
    observe: Callable[[State], Array],
    step: Callable[[State, Array], tuple[Array, Array]],
) -> base.Env:
    """An environment of ``length`` steps.

    Args:
      size: M.
      first: key -> the memory ``[M]`` that an episode starts with.
      observe: what is seen, ``[3]``.
      step: (state, action ``[1]``) -> the new memory and the reward [].
    """

    def reset(key: Array) -> State:
        return State(jnp.zeros((), jnp.int32), first(key).reshape(size))

    def advance(state: State, action: Array) -> tuple[State, base.Progress]:
        memory, reward = step(state, action)
        t = state.t + 1
        last = t >= length
        return State(t, memory), base.Progress(reward, last, last, jnp.ones((), bool))

    see = lambda state: {"vector": observe(state)}
    return base.from_core(base.Core(SPEC, reset, base.restart_or_step(reset, advance), see))


def as_picture(probe: Probe, side: int = 8) -> Probe:
    """The probe with an image of one colour in the vector's place, red, green and blue for its components.

    Images are ``side`` pixels wide and high.
    """
    image = ArraySpec((side, side, 3), jnp.uint8)

    def see(obs: dict[str, Array]) -> dict[str, Array]:
        colour = jnp.round(127.5 * (obs["vector"] + 1.0)).astype(jnp.uint8)
        return {"image": jnp.broadcast_to(colour, image.shape)}

    def seen(result: tuple[base.EnvState, TimeStep]) -> tuple[base.EnvState, TimeStep]:
        state, timestep = result
        return state, timestep._replace(obs=see(dict(timestep.obs)))

    env = probe.env
    picture = base.Env(
        EnvSpec({"image": image}, SPEC.action),
        lambda key: seen(env.reset(key)),
        lambda state, action: seen(env.step(state, action)),
        lambda state: see(env.observe(state)),
        env.prepare,
    )
    return probe._replace(env=picture)


def vector(*components: float | Array) -> Array:
    """An observation of up to three components, the others zero."""
    padded = [*components, *[0.0] * (3 - len(components))]
    return jnp.stack([jnp.asarray(x, jnp.float32) for x in padded])


def positive(x: Array) -> Array:
    """1 where ``x [1]`` is above zero, else 0, as float32 []."""
    return (x[0] > 0).astype(jnp.float32)


def equals(t: Array, value: int) -> Array:
    """1 at a step, else 0, as float32 []."""
    return (t == value).astype(jnp.float32)


PROBES: dict[str, Callable[[], Probe]] = {
    "bandit": bandit,
    "two_steps": two_steps,
    "cue": cue,
    "cue_again": cue_again,
    "target": target,
    "echo": echo,
}
