"""What an environment is, and how a bare simulation becomes one.

A ``Core`` is a simulation without bookkeeping: pure functions that start an episode, advance it and look at it.
``from_core`` turns it into an ``Env``, adding what every environment needs: flags, auto-reset, and a guard against
simulations that stop being finite. Everything is written for ONE environment; ``jax.vmap`` makes many.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from ne_dreamer_jax.system.numerics import in_32_bits
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
    ``reset(key)`` would; action and progress are then without meaning. The key is a new one at every step, for
    simulations that are stochastic. Starting inside of ``step`` lets a simulation share code, and so compile time,
    between the two; ``restart_or_step`` is for those that have nothing to share.
    """

    spec: EnvSpec
    reset: Callable[[Array], CoreState]  # key -> first state of an episode
    step: Callable[[CoreState, Array, Array, Array], tuple[CoreState, Progress]]
    observe: Callable[[CoreState], dict[str, Array]]  # as spec.observation; the only place where pixels are drawn
    pictures: Pictures | None = None  # where the observation has an "image" that can be drawn again
    step_seconds: float | None = None  # simulated time of a step, where there is such
    blank: Callable[[], CoreState] | None = None  # a state for ``step`` to begin the first episode from; none: zeros


class EnvState(NamedTuple):
    """State of one environment. Opaque to agents; ``physics`` is for checks and plots."""

    core: CoreState
    key: Array  # typed key [], what the coming episodes are drawn from
    steps: Array  # int32 [], steps of the running episode
    needs_reset: Array  # bool [], the last time step was the last of its episode
    faults: Array  # int32 [], episodes cut because the simulation broke down, since reset
    bad_actions: Array  # int32 [], episodes cut because an action was not finite, since reset

    @property
    def physics(self) -> Any:
        """The ``mjx.Data`` of a DMC task."""
        return self.core.physics

    @property
    def position(self) -> Array:
        """Where the player of a Rooms task is, float32 [2], in DMLab's units."""
        return self.core.position

    @property
    def yaw(self) -> Array:
        """Where it looks, float32 [], radians, counter-clockwise from +x."""
        return self.core.yaw


class Env(NamedTuple):
    """An environment as pure functions, each for one environment and each jittable.

    ``reset(key) -> (EnvState, TimeStep)``; ``step(state, action) -> (EnvState, TimeStep)``;
    ``observe(state) -> obs``, the observation of the state's time step over again;
    ``prepare(key) -> EnvState``, a state from which the first ``step`` begins an episode. A program that starts there
    needs no ``reset``, whose compilation costs as much as that of ``step``;
    ``pictures``, how images can be drawn again from less, or None;
    ``step_seconds``, the simulated time of a step, or None.

    After a time step with ``is_last`` the next ``step`` ignores its action and returns the first time step of a new
    episode (``is_first``, reward 0), started from a key never used before.
    """

    spec: EnvSpec
    reset: Callable[[Array], tuple[EnvState, TimeStep]]
    step: Callable[[EnvState, Array], tuple[EnvState, TimeStep]]
    observe: Callable[[EnvState], dict[str, Array]]
    prepare: Callable[[Array], EnvState]
    pictures: Pictures | None = None
    step_seconds: float | None = None


def if_needed(needed: Array, compute: Callable[[], T], otherwise: T) -> T:
    """``compute()`` where ``needed``, else ``otherwise``; under ``vmap`` computed only if some of the batch need it.

    A loop of one turn or none. ``lax.cond`` would, under ``vmap``, compute both sides at every step.
    """
    done = jnp.zeros((), bool)
    return jax.lax.while_loop(lambda carry: carry[0], lambda _: (done, compute()), (needed, otherwise))[1]


def restart_or_step(
    reset: Callable[[Array], CoreState], step: Callable[..., tuple[CoreState, Progress]], stochastic: bool = False
) -> Callable[[CoreState, Array, Array, Array], tuple[CoreState, Progress]]:
    """Makes a ``Core.step`` out of a plain step and the core's ``reset``.

    Args:
      step: (state, action) -> new state and progress; where ``stochastic``, (state, action, key).
    """

    def step_or_restart(state: CoreState, action: Array, restart: Array, key: Array) -> tuple[CoreState, Progress]:
        stepped, progress = step(state, action, key) if stochastic else step(state, action)
        _expect_structure("the state that step returns", state, stepped)  # dtypes may yet be promoted
        return if_needed(restart, lambda: reset(key), stepped), progress

    return step_or_restart


@in_32_bits
def from_core(core: Core) -> Env:
    """Adds flags, clipping of actions, auto-reset and the guard against non-finite values to a simulation.

    Where the simulation says that it broke down, or its reward or observation is not finite, the episode ends
    there (``is_last``, not ``is_terminal``) with reward 0 and zeros for the non-finite components of the
    observation, and ``EnvState.faults`` counts it. An action that is not finite, which is no fault of the simulation,
    ends the episode likewise, and ``EnvState.bad_actions`` counts it.

    Raises:
      ValueError: the core's functions do not fit each other or the specification (the message says which, with what
        was expected and what was got); from ``step``, an action of another shape or dtype than the specification's.
    """
    for name in ("reset", "step", "observe"):
        if not callable(function := getattr(core, name)):
            raise ValueError(f"Core.{name}: expected a function, got {function!r}")
    # Jitted, so that each is traced once, and not anew for the check, for training and for evaluation.
    core = core._replace(reset=jax.jit(core.reset), step=jax.jit(core.step), observe=jax.jit(core.observe))
    _check_core(core)

    def emit(stepped: CoreState, state: EnvState, progress: Progress, finite: Array) -> tuple[EnvState, TimeStep]:
        """The time step of a core's state; ``state`` has the counts before it."""
        is_first = state.needs_reset
        nothing = Progress(jnp.zeros((), jnp.float32), *jnp.array([False, False, True]))
        progress = jax.tree.map(lambda first, later: jnp.where(is_first, first, later), nothing, progress)
        seen = core.observe(stepped)
        obs = {name: jnp.asarray(seen[name], spec.dtype) for name, spec in core.spec.observation.items()}
        sound = progress.is_sound & jnp.isfinite(progress.reward)
        for value in obs.values():
            sound &= jnp.isfinite(value).all()
        cut = ~(sound & finite)
        timestep = TimeStep(
            obs={name: jnp.where(jnp.isfinite(value), value, jnp.zeros_like(value)) for name, value in obs.items()},
            reward=jnp.where(cut, nothing.reward, progress.reward),
            is_first=is_first,
            is_last=progress.is_last | cut,
            is_terminal=progress.is_terminal & ~cut,
        )
        state = state._replace(
            core=stepped,
            needs_reset=timestep.is_last,
            faults=state.faults + (~sound).astype(jnp.int32),
            bad_actions=state.bad_actions + (~finite).astype(jnp.int32),
        )
        return state, timestep

    def step(state: EnvState, action: Array) -> tuple[EnvState, TimeStep]:
        spec = core.spec.action
        _expect("action", _described(jax.ShapeDtypeStruct(spec.shape, spec.dtype)), _described(action))
        finite = jnp.ones((), bool)
        if isinstance(spec, ContinuousAction):
            finite = jnp.isfinite(action).all() | state.needs_reset
            action = jnp.where(finite, jnp.clip(action, -1.0, 1.0), jnp.zeros_like(action))
        key, episode_key, steps_key = jax.random.split(state.key, 3)
        new_key = jnp.where(state.needs_reset, episode_key, jax.random.fold_in(steps_key, state.steps))
        stepped, progress = core.step(state.core, action, state.needs_reset, new_key)
        state = state._replace(
            key=jnp.where(state.needs_reset, key, state.key), steps=jnp.where(state.needs_reset, 0, state.steps + 1)
        )
        return emit(stepped, state, progress, finite)

    def reset(key: Array) -> tuple[EnvState, TimeStep]:
        # Through the barrier the compiler knows nothing of the state: these are the instructions of any other step,
        # which round alike.
        spec = core.spec.action
        return step(*jax.lax.optimization_barrier((prepare(key), jnp.zeros(spec.shape, spec.dtype))))

    def prepare(key: Array) -> EnvState:
        # What stands in the core is never used: a step from a state that needs a reset starts an episode.
        # Copies, so that the state may be donated.
        zeros = lambda x: jnp.zeros(x.shape, x.dtype)  # of typed keys, too
        blank = core.blank() if core.blank is not None else jax.tree.map(zeros, jax.eval_shape(core.reset, key))
        count = lambda: jnp.zeros((), jnp.int32)
        return EnvState(jax.tree.map(jnp.copy, blank), key, count(), jnp.ones((), bool), count(), count())

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
        core.step_seconds,
    )


def _check_core(core: Core) -> None:
    """Raises ValueError where a core's functions don't fit each other or its specification."""
    key = jax.eval_shape(lambda: jax.random.key(0))
    for name, spec in core.spec.observation.items():
        if not (spec.dtype == jnp.uint8 and len(spec.shape) == 3) and not (
            spec.dtype == jnp.float32 and len(spec.shape) <= 1
        ):
            raise ValueError(
                f"observation {name!r}: expected an image, uint8 [height, width, channels], or a vector, float32 [] or "
                f"[n], got {_described(spec)}"
            )
    state = jax.eval_shape(core.reset, key)
    _expect_arrays("the state that reset returns", state)
    action = jax.ShapeDtypeStruct(core.spec.action.shape, core.spec.action.dtype)
    stepped, progress = jax.eval_shape(core.step, state, action, jax.ShapeDtypeStruct((), jnp.bool_), key)
    expect_same("the state that step returns", state, stepped)
    if core.blank is not None:
        expect_same("the state that blank returns", state, jax.eval_shape(core.blank))
    flag: Any = jax.ShapeDtypeStruct((), jnp.bool_)
    reward: Any = jax.ShapeDtypeStruct((), jnp.float32)
    expect_same("progress", Progress(reward, flag, flag, flag), progress)
    obs = jax.eval_shape(core.observe, state)
    wanted = {name: jax.ShapeDtypeStruct(spec.shape, spec.dtype) for name, spec in core.spec.observation.items()}
    expect_same("what observe returns", wanted, obs)


def expect_same(what: str, expected: Any, got: Any) -> None:
    """Compares shapes and dtypes of two pytrees.

    Raises:
      ValueError: they differ; the message names ``what``, and for the first leaf that differs what was expected
        and got.
    """
    leaves, others = (jax.tree_util.tree_flatten_with_path(tree)[0] for tree in (expected, got))
    _expect_structure(what, expected, got)
    for (path, leaf), (_, other) in zip(leaves, others, strict=True):
        _expect(f"{what}{jax.tree_util.keystr(path)}", _described(leaf), _described(other))


def _expect_structure(what: str, expected: Any, got: Any) -> None:
    structure: Any = jax.tree.structure(expected)
    other_structure: Any = jax.tree.structure(got)
    if structure != other_structure:
        raise ValueError(f"{what}: expected the structure {structure}, got {other_structure}")


def _expect_arrays(what: str, tree: Any) -> None:
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if getattr(leaf, "weak_type", False):
            raise ValueError(
                f"{what}{jax.tree_util.keystr(path)}: expected an array of a dtype of its own, got a Python number, "
                f"whose dtype later operations would change; write jnp.asarray(value, dtype)"
            )


def _expect(what: str, expected: str, got: str) -> None:
    if expected != got:
        raise ValueError(f"{what}: expected {expected}, got {got}")


def _described(x: Any) -> str:
    """Dtype and shape, as in float32[3]."""
    if not (hasattr(x, "shape") and hasattr(x, "dtype")):
        return f"{type(x).__name__} {x!r}"
    dtype = x.dtype if jax.dtypes.issubdtype(x.dtype, jax.dtypes.extended) else jnp.dtype(x.dtype).name
    return f"{dtype}[{','.join(map(str, x.shape))}]"
