"""Environments in worker processes as a `VectorEnv`: the compiled program calls back to the host for each step."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback

from ne_dreamer_jax.envs.host.players import Player, Seen
from ne_dreamer_jax.envs.host.pool import HostEnvError, Pools, Workers
from ne_dreamer_jax.envs.vector import Cuts, VectorEnv
from ne_dreamer_jax.types import Array, ArraySpec, ContinuousAction, DiscreteAction, EnvSpec, TimeStep


class HostState(NamedTuple):
    """What the program knows of N environments, which are elsewhere."""

    pool: Array  # int32 [], the number of the pool that holds them
    number: Array  # int32 [], of the coming step
    seeds: Array  # uint32 [N]
    needs_reset: Array  # bool [N], the last time step was the last of its episode
    obs: dict[str, Array]  # [N, ...], of the last time step: the last of an episode whose worker is lost
    faults: Array  # int32 [N], episodes cut because an environment or its worker failed
    bad_actions: Array  # int32 [N], episodes cut because an action was not finite


class _Answer(NamedTuple):
    """Of all environments, from the host."""

    pool: Any  # int32 []
    obs: Any  # name -> [N, ...]
    reward: Any  # float32 [N]
    is_last: Any  # bool [N]
    is_terminal: Any  # bool [N]
    lost: Any  # bool [N], the episode is gone, and nothing above has a meaning
    fault: Any  # bool [N], a number was not finite, and the episode ends here


def host_env(factory: Callable[[], Player], workers: Workers | None = None, draws: bool = False) -> VectorEnv:
    """N environments of one kind in worker processes.

    An episode whose worker dies or hangs, or whose environment raises, ends with the last observation over again
    (``is_last``, not ``is_terminal``, reward 0) and is counted; so do those of a training run that goes on in another
    process. ``VectorEnv.host`` has what can be asked of the workers.

    Args:
      draws: whether pictures of the environments are drawn.

    Raises:
      ValueError: the environment can't be made or begin an episode, or an agent can't see it or act in it.
    """
    try:
        pools = Pools(factory, workers, draws)
    except HostEnvError as error:
        raise ValueError(str(error)) from error
    described = pools.described
    observation = {
        name: ArraySpec(tuple(shape), jnp.dtype(dtype)) for name, (shape, dtype) in described.observations.items()
    }
    action = DiscreteAction(described.actions) if described.discrete else ContinuousAction(described.actions)
    spec = EnvSpec(observation, action)
    return VectorEnv(
        spec=spec,
        prepare=partial(_prepare, _opener(pools), spec),
        step=partial(_step, pools, spec),
        cuts=lambda state: Cuts(state.faults, state.bad_actions),
        step_seconds=described.step_seconds,
        start=partial(_start, pools),
        release=lambda state: pools.release(int(state.pool)),
        host=pools,
    )


def _opener(pools: Pools) -> Callable[[Any], np.ndarray]:
    """The callback of `_prepare`: one and the same, since JAX keeps a program for each, and what it holds, for ever."""
    there = weakref.ref(pools)

    def opened(seeds: Any) -> np.ndarray:
        found = there()
        if found is None:
            raise HostEnvError("the environments' workers have ended with the VectorEnv that they belonged to")
        return np.asarray(found.open(np.asarray(seeds).tolist()), np.int32)

    return opened


def _prepare(opened: Callable[[Any], np.ndarray], spec: EnvSpec, keys: Array) -> HostState:
    """From keys [N]; the episodes begin with the first step."""
    if keys.ndim != 1:
        raise ValueError(
            f"prepare: expected N keys, [N], got {list(keys.shape)}; environments in worker processes are N at once: "
            "call prepare and step without jax.vmap"
        )
    n = keys.shape[0]
    seeds = jax.vmap(lambda key: jax.random.bits(key, (), jnp.uint32))(keys)
    count = lambda: jnp.zeros((n,), jnp.int32)
    return HostState(
        pool=io_callback(opened, _int(), seeds),
        number=jnp.zeros((), jnp.int32),
        seeds=seeds,
        needs_reset=jnp.ones((n,), bool),
        obs={name: jnp.zeros((n, *s.shape), s.dtype) for name, s in spec.observation.items()},
        faults=count(),
        bad_actions=count(),
    )


def _start(pools: Pools, state: HostState, action: Array) -> HostState:
    """Sends the actions off; the state says so only to what has to come later."""

    def ask(pool: Any, number: Any, action: Any, restart: Any) -> np.ndarray:
        found = pools.get(int(pool))
        if found is not None:
            found.start(int(number), np.asarray(action), np.asarray(restart))
        return np.asarray(pool)

    action = _finite(action)[0]
    return state._replace(pool=io_callback(ask, _int(), state.pool, state.number, action, state.needs_reset))


def _step(pools: Pools, spec: EnvSpec, state: HostState, action: Array) -> tuple[HostState, TimeStep]:
    n, first = state.needs_reset.shape[0], state.needs_reset
    action, finite = _finite(action)
    flag = jax.ShapeDtypeStruct((n,), jnp.bool_)
    shapes = _Answer(
        pool=_int(),
        obs={name: jax.ShapeDtypeStruct((n, *s.shape), s.dtype) for name, s in spec.observation.items()},
        reward=jax.ShapeDtypeStruct((n,), jnp.float32),
        is_last=flag,
        is_terminal=flag,
        lost=flag,
        fault=flag,
    )
    answer = io_callback(
        partial(_ask, pools, spec), shapes, state.pool, state.number, action, state.needs_reset, state.seeds
    )
    lost = answer.lost & ~first
    bad = ~finite & ~first
    cut = lost | answer.fault | bad
    keep = lambda old, new: jnp.where(lost.reshape(-1, *[1] * (new.ndim - 1)), old, new)
    obs = jax.tree.map(keep, state.obs, answer.obs)
    timestep = TimeStep(
        obs=obs,
        reward=jnp.where(cut | first, 0.0, answer.reward),
        is_first=first,
        is_last=cut | answer.is_last,
        is_terminal=answer.is_terminal & ~cut,
    )
    state = HostState(
        pool=answer.pool,
        number=state.number + 1,
        seeds=state.seeds,
        needs_reset=timestep.is_last,
        obs=obs,
        faults=state.faults + (lost | answer.fault).astype(jnp.int32),
        bad_actions=state.bad_actions + bad.astype(jnp.int32),
    )
    return state, timestep


def _ask(
    pools: Pools, spec: EnvSpec, number_of_pool: Any, number: Any, action: Any, restart: Any, seeds: Any
) -> _Answer:
    """A step of all environments, or their beginning where they are another process's."""
    action, restart, seeds = np.asarray(action), np.asarray(restart), np.asarray(seeds)
    pool, lost = pools.get(int(number_of_pool)), np.zeros(len(restart), bool)
    if pool is None:
        number_of_pool, lost = pools.open(_later(seeds, int(number))), ~restart
        pool = pools.get(number_of_pool)
        assert pool is not None
        if lost.any():
            pools.report(f"{lost.sum()} episodes of another process are cut; others begin.")
        restart = np.ones_like(restart)
    try:
        pool.start(int(number), action, restart)
        answers = pool.finish(action, restart)
    except HostEnvError as error:
        pools.failure = str(error)
        raise
    lost = lost | np.array([not isinstance(answer, Seen) for answer in answers])
    rows = [answer if isinstance(answer, Seen) else None for answer in answers]
    column = lambda name, dtype: np.array([getattr(row, name) if row else 0 for row in rows], dtype)
    blank = {name: np.zeros(s.shape, s.dtype) for name, s in spec.observation.items()}
    return _Answer(
        pool=np.int32(number_of_pool),
        obs={name: np.stack([row.obs[name] if row else blank[name] for row in rows]) for name in blank},
        reward=column("reward", np.float32),
        is_last=column("is_last", np.bool_),
        is_terminal=column("is_terminal", np.bool_),
        lost=lost,
        fault=np.array([bool(row and row.fault) for row in rows]),
    )


def _later(seeds: np.ndarray, number: int) -> list[int]:
    """Seeds for episodes that begin in another process: those of before would begin the same ones again."""
    return [int(seed) + (number << 32) for seed in seeds]


def _finite(action: Array) -> tuple[Array, Array]:
    """Actions [N, ...] with zeros for those that are not finite, and which are, bool [N]."""
    if not jnp.issubdtype(action.dtype, jnp.floating):
        return action, jnp.ones(action.shape[:1], bool)
    finite = jnp.isfinite(action).all(axis=1)
    return jnp.where(finite[:, None], action, jnp.zeros_like(action)), finite


def _int() -> Any:
    return jax.ShapeDtypeStruct((), jnp.int32)
