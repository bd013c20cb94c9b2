"""What an environment is, and how a bare simulation becomes one.

A ``Core`` is a simulation without bookkeeping: pure functions that start an episode, advance it and look at it.
``from_core`` turns it into an ``Env``, adding what every environment needs: flags, auto-reset, and a guard against
simulations that stop being finite. Everything is written for ONE environment; ``jax.vmap`` makes many.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from ne_dreamer_jax.numerics import in_32_bits
from ne_dreamer_jax.types import Array, ContinuousAction, EnvSpec, TimeStep

CoreState = Any  # a pytree of arrays, without weak types
T = TypeVar("T")


class Progress(NamedTuple):
    """What one step of a simulation tells besides its new state."""

    reward: Array  # float32 []
    is_last: Array  # bool [], a time limit or a terminal state was reached
    is_terminal: Array  # bool [], implies is_last
    is_sound: Array  # bool [], False where the simulation broke down


class Pictures(NamedTuple):
    """How to keep what an image is drawn from in place of the image: far fewer bytes, for the time to draw again."""

    record: Callable[[Any], Array]  # state -> float32 [P]
    redraw: Callable[[Array], Array]  # float32 [P] -> the observation's "image", to the bit


class Core(NamedTuple):
    """A simulation as pure functions.

    ``step(state, action, restart, key)`` advances by one step or, where the bool ``restart`` is set, returns what
    ``reset(key)`` would; action and progress are then without meaning. Starting inside of ``step`` lets a simulation
    share code, and so compile time, between the two; ``restart_or_step`` is for those that have nothing to share.
    """

    spec: EnvSpec
    reset: Callable[[Array], CoreState]  # key -> first state of an episode
    step: Callable[[CoreState, Array, Array, Array], tuple[CoreState, Progress]]
    observe: Callable[[CoreState], dict[str, Array]]  # as spec.observation; the only place where pixels are drawn
    pictures: Pictures | None = None  # where the observation has an "image" that can be drawn again


class EnvState(NamedTuple):
    """State of one environment. Opaque to agents; ``physics`` is for checks and plots."""

    core: CoreState
    key: Array  # typed key [], what the coming episodes are drawn from
    needs_reset: Array  # bool [], the last time step was the last of its episode
    faults: Array  # int32 [], episodes cut because the simulation broke down, since reset

    @property
    def physics(self) -> Any:
        """The ``mjx.Data`` of a DMC task."""
        return self.core.physics


class Env(NamedTuple):
    """An environment as pure functions, each for one environment and each jittable.

    ``reset(key) -> (EnvState, TimeStep)``; ``step(state, action) -> (EnvState, TimeStep)``;
    ``observe(state) -> obs``, the observation of the state's time step over again;
    ``prepare(key) -> EnvState``, a state from which the first ``step`` begins an episode. A program that starts there
    needs no ``reset``, whose compilation costs as much as that of ``step``;
    ``pictures``, how images can be drawn again from less, or None.

    After a time step with ``is_last`` the next ``step`` ignores its action and returns the first time step of a new
    episode (``is_first``, reward 0), started from a key never used before.
    """

    spec: EnvSpec
    reset: Callable[[Array], tuple[EnvState, TimeStep]]
    step: Callable[[EnvState, Array], tuple[EnvState, TimeStep]]
    observe: Callable[[EnvState], dict[str, Array]]
    prepare: Callable[[Array], EnvState]
    pictures: Pictures | None = None


def if_needed(needed: Array, compute: Callable[[], T], otherwise: T) -> T:
    """``compute()`` where ``needed``, else ``otherwise``; under ``vmap`` computed only if some of the batch need it.

    A loop of one turn or none. ``lax.cond`` would, under ``vmap``, compute both sides at every step.
    """
    done = jnp.zeros((), bool)
    return jax.lax.while_loop(lambda carry: carry[0], lambda _: (done, compute()), (needed, otherwise))[1]


def restart_or_step(
    reset: Callable[[Array], CoreState], step: Callable[[CoreState, Array], tuple[CoreState, Progress]]
) -> Callable[[CoreState, Array, Array, Array], tuple[CoreState, Progress]]:
    """Makes a ``Core.step`` out of a plain ``step(state, action)`` and the core's ``reset``."""

    def step_or_restart(state: CoreState, action: Array, restart: Array, key: Array) -> tuple[CoreState, Progress]:
        state, progress = step(state, action)
        return if_needed(restart, lambda: reset(key), state), progress

    return step_or_restart


def from_core(core: Core) -> Env:
    """Adds flags, clipping of actions, auto-reset and the guard against non-finite values to a simulation.

    Where the simulation says that it broke down, or its reward or observation is not finite, the episode ends
    there (``is_last``, not ``is_terminal``) with reward 0 and zeros for the non-finite components of the
    observation, and ``EnvState.faults`` counts it.
    """

    def emit(
        state: CoreState, key: Array, faults: Array, is_first: Array, progress: Progress
    ) -> tuple[EnvState, TimeStep]:
        nothing = Progress(jnp.zeros((), jnp.float32), *jnp.array([False, False, True]))
        progress = jax.tree.map(lambda first, later: jnp.where(is_first, first, later), nothing, progress)
        obs = core.observe(state)
        sound = progress.is_sound & jnp.isfinite(progress.reward)
        for value in obs.values():
            sound &= jnp.isfinite(value).all()
        timestep = TimeStep(
            obs={name: jnp.where(jnp.isfinite(value), value, jnp.zeros_like(value)) for name, value in obs.items()},
            reward=jnp.where(sound, progress.reward, nothing.reward),
            is_first=is_first,
            is_last=progress.is_last | ~sound,
            is_terminal=progress.is_terminal & sound,
        )
        return EnvState(state, key, timestep.is_last, faults + (~sound).astype(jnp.int32)), timestep

    def reset(key: Array) -> tuple[EnvState, TimeStep]:
        key, episode_key = jax.random.split(key)
        first = jnp.ones((), bool)
        progress = Progress(jnp.zeros((), jnp.float32), ~first, ~first, first)
        return emit(core.reset(episode_key), key, jnp.zeros((), jnp.int32), first, progress)

    def step(state: EnvState, action: Array) -> tuple[EnvState, TimeStep]:
        if isinstance(core.spec.action, ContinuousAction):
            action = jnp.clip(action, -1.0, 1.0)
        key, episode_key = jax.random.split(state.key)
        key = jnp.where(state.needs_reset, key, state.key)
        stepped, progress = core.step(state.core, action, state.needs_reset, episode_key)
        return emit(stepped, key, state.faults, state.needs_reset, progress)

    @functools.cache
    def core_shapes() -> CoreState:
        return jax.eval_shape(core.reset, jax.random.key(0))

    def prepare(key: Array) -> EnvState:
        # What stands in the core is never used: a step from a state that needs a reset starts an episode.
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), core_shapes())
        return EnvState(nothing, key, jnp.ones((), bool), jnp.zeros((), jnp.int32))

    pictures = core.pictures
    if pictures is not None:
        record, redraw = pictures.record, pictures.redraw
        pictures = Pictures(in_32_bits(lambda state: record(state.core)), in_32_bits(redraw))
    return Env(
        core.spec,
        in_32_bits(reset),
        in_32_bits(step),
        in_32_bits(lambda state: core.observe(state.core)),
        in_32_bits(prepare),
        pictures,
    )
