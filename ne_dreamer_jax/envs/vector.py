"""N environments, stepped together: what the training loop and `loop.play` see of an environment.

``jax.vmap`` of an `Env` is one way to get it (`vectorize`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax

from ne_dreamer_jax.envs.base import Core, Env, Pictures
from ne_dreamer_jax.types import Array, EnvSpec, TimeStep


class Cuts(NamedTuple):
    """Episodes that each environment has cut since it was prepared, int32 [N]."""

    faults: Array  # because its simulation broke down
    bad_actions: Array  # because an action was not finite


class Host(Protocol):
    """Environments that are stepped outside of the compiled program, in processes of their own."""

    failure: str | None
    """Why they were given up, where they were; the program's call has then raised."""
    should_stop: bool
    """Whether something failed that is to end a training run at the next opportunity."""

    def lines(self) -> list[str]:
        """What happened to them since this was last asked, a line each."""
        ...

    def close(self) -> None:
        """Ends the processes."""
        ...


class VectorEnv(NamedTuple):
    """Functions of N environments at once; N is that of the arguments. Pure, but for environments on the `Host`."""

    spec: EnvSpec
    """Of one environment."""
    prepare: Callable[[Array], Any]
    """typed keys [N] -> states from which the first ``step`` begins the episodes, whatever its actions."""
    step: Callable[[Any, Array], tuple[Any, TimeStep]]
    """(states, actions [N, ...]) -> new states and time steps [N, ...]; after ``is_last`` an episode begins anew."""
    cuts: Callable[[Any], Cuts]
    """states -> the episodes cut so far."""
    pictures: Pictures | None = None
    """How images can be drawn again: ``record`` of states [N], ``redraw`` of one record."""
    step_seconds: float | None = None
    """Simulated time of an agent step, where the environment has such."""
    start: Callable[[Any, Array], Any] | None = None
    """(states, actions) -> states, to be stepped with these actions: where steps take place elsewhere, they begin."""
    release: Callable[[Any], None] | None = None
    """Of states that are stepped no more, where they hold anything; no part of a compiled program."""
    host: Host | None = None
    """Where the environments are, if they are not in the program."""


def vectorize(env: Env) -> VectorEnv:
    """N environments of one kind under ``jax.vmap``."""
    pictures = env.pictures
    if pictures is not None:
        pictures = pictures._replace(record=jax.vmap(pictures.record))
    return VectorEnv(
        spec=env.spec,
        prepare=jax.vmap(env.prepare),
        step=jax.vmap(env.step),
        cuts=lambda state: Cuts(state.faults, state.bad_actions),
        pictures=pictures,
        step_seconds=env.step_seconds,
    )


def as_vector(env: Any) -> VectorEnv:
    """N environments at once of a single one; what is of that kind already stays as it is. Raises as `check_env`."""
    check_env(env)
    return env if isinstance(env, VectorEnv) else vectorize(env)


def check_env(env: Any) -> None:
    """Raises ValueError where ``env`` is no environment, saying what to make of it."""
    if isinstance(env, Env | VectorEnv):
        return
    what = f"expected an envs.base.Env (or an envs.vector.VectorEnv), got a {type(env).__name__}"
    if callable(env) and not isinstance(env, tuple):
        raise ValueError(f"env: {what}; call it, and give what it returns")
    if {"simulation", "observe"} <= set(getattr(env, "_fields", ())):
        raise ValueError(f"env: {what}; envs.dmc.from_task(task) makes one of it")
    if isinstance(env, Core):
        raise ValueError(f"env: {what}; envs.base.from_core(core) makes one of it")
    raise ValueError(f"env: {what}; see envs.base.from_core, and envs.adapters for those of other libraries")
