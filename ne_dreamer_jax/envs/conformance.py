"""What every environment promises, as a check to run on one's own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs.base import Env, EnvState
from ne_dreamer_jax.types import Array, ContinuousAction, TimeStep


def check(
    env: Env,
    key: Array,
    num_envs: int = 2,
    num_steps: int = 5,
    beginning_steps: int = 50,
    echo: Callable[[str], None] = print,
) -> None:
    """Runs some environments at once and checks what a learner relies on.

    Args:
      env: what ``envs.make`` or ``envs.base.from_core`` returns.
      key: typed key [], for episodes and random actions.
      num_envs: how many run side by side under ``vmap``.
      num_steps: steps before a restart is forced, and after it.
      beginning_steps: steps for which episodes that begin in different ways are compared.
      echo: takes a line on each part of the check, before it begins.

    Raises:
      AssertionError: a promise is broken; the message says which.
    """
    reset, step, observe = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(env.observe))
    reset_key, action_key = jax.random.split(key)
    keys = jax.random.split(reset_key, num_envs)
    echo("Compiling reset and step, and resetting.")
    state, timestep = reset(keys)
    _expect_same(reset(keys), (state, timestep), "reset with the same key")
    _expect_first(timestep)
    _check_timestep(env, timestep, num_envs)

    echo(f"Stepping {num_envs} environments {2 * num_steps} times, with a restart in between.")
    for number in range(2 * num_steps):
        restart = number == num_steps
        if restart:
            state = state._replace(needs_reset=jnp.ones(num_envs, bool))
        action = random_action(env, jax.random.fold_in(action_key, number), num_envs)
        before, last = state, timestep.is_last | restart
        state, timestep = step(before, action)
        _check_timestep(env, timestep, num_envs)
        _expect(_kinds(state) == _kinds(before), "a step changes no shape, dtype or weak type of the state")
        _expect_equal(timestep.is_first, last, "is_first comes right after is_last and nowhere else")
        _expect_same(observe(state), timestep.obs, "observe of the returned state")
        if number == 0:
            _expect_same(step(before, action), (state, timestep), "step with the same arguments")
            if isinstance(env.spec.action, ContinuousAction):
                bound = jnp.sign(action)
                _expect_same(step(before, 7 * bound), step(before, bound), "an action out of bounds acts as the bound")
        if restart:
            _expect_first(timestep)
            other = step(before, -action) if isinstance(env.spec.action, ContinuousAction) else step(before, action * 0)
            _expect_same(other[1], timestep, "a restart, whatever the action")
            changed = jax.random.key_data(state.key) != jax.random.key_data(before.key)
            _expect(bool(changed.any(-1).all()), "a restart moves on to a new key")

    echo(f"Comparing episodes that begin by reset, by prepare and by auto-reset, for {beginning_steps} steps.")
    _check_beginnings(env, reset, step, state, jax.random.fold_in(action_key, 2 * num_steps), beginning_steps)
    for name, function in (("reset", reset), ("step", step)):
        _expect(_compilations(function) == 1, f"{name} compiles once")


def _check_beginnings(
    env: Env, reset: Callable[..., Any], step: Callable[..., Any], old: EnvState, key: Array, num_steps: int
) -> None:
    """An episode is the same, bit for bit, however it begins.

    Args:
      old: states of N environments that have played for a while.
    """
    num_envs = len(old.needs_reset)
    key, reset_key = jax.random.split(key)
    keys = jax.random.split(reset_key, num_envs)
    action = random_action(env, key, num_envs)
    begun = {
        "reset": reset(keys),
        "prepare and step": step(jax.vmap(env.prepare)(keys), action),
        "auto-reset": step(old._replace(key=keys, needs_reset=jnp.ones(num_envs, bool)), action),
    }
    for number in range(num_steps + 1):
        state, timestep = begun["reset"]
        for name, (other, seen) in begun.items():
            promise = f"an episode begun by {name} as by reset, after {number} steps"
            _expect_same(seen, timestep, promise)
            if number:  # before the first step there may be leftovers that nothing reads
                _expect_same(other._replace(faults=state.faults, bad_actions=state.bad_actions), state, promise)
        if number < num_steps:
            action = random_action(env, jax.random.fold_in(key, number), num_envs)
            begun = {name: step(state, action) for name, (state, _) in begun.items()}


def random_action(env: Env, key: Array, num_envs: int) -> Array:
    """Uniformly random actions, [num_envs, *action.shape]."""
    spec = env.spec.action
    if isinstance(spec, ContinuousAction):
        return jax.random.uniform(key, (num_envs, *spec.shape), jnp.float32, -1.0, 1.0)
    return jax.random.randint(key, (num_envs,), 0, spec.size, jnp.int32)


def _check_timestep(env: Env, timestep: TimeStep, num_envs: int) -> None:
    _expect(set(timestep.obs) == set(env.spec.observation), f"observations named {sorted(env.spec.observation)}")
    for name, spec in env.spec.observation.items():
        value = timestep.obs[name]
        expected = ((num_envs, *spec.shape), jnp.dtype(spec.dtype))
        _expect((value.shape, value.dtype) == expected, f"{name} of {expected}, got {(value.shape, value.dtype)}")
        _expect(bool(jnp.isfinite(value).all()), f"finite {name}")
    for name, dtype in (("reward", "float32"), ("is_first", "bool"), ("is_last", "bool"), ("is_terminal", "bool")):
        value = getattr(timestep, name)
        _expect((value.shape, value.dtype.name) == ((num_envs,), dtype), f"{name}: one {dtype} for each environment")
    _expect(bool(jnp.isfinite(timestep.reward).all()), "finite rewards")
    _expect(bool((timestep.is_last | ~timestep.is_terminal).all()), "is_terminal implies is_last")


def _expect_first(timestep: TimeStep) -> None:
    nothing = jnp.zeros_like(timestep.reward)
    _expect_equal(timestep.reward, nothing, "reward 0 where an episode starts")
    _expect(bool(timestep.is_first.all()), "is_first where an episode starts")
    _expect(not bool(timestep.is_last.any()), "an episode longer than its first step")


def _expect(condition: bool, promise: str) -> None:
    if not condition:
        raise AssertionError(f"expected {promise}")


def _expect_equal(actual: Any, expected: Any, promise: str) -> None:
    _expect(bool((jnp.asarray(actual) == jnp.asarray(expected)).all()), promise)


def _expect_same(actual: Any, expected: Any, promise: str) -> None:
    """Bit for bit equal pytrees."""
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        _expect(np.array_equal(a, b), f"the same results: {promise}")


def _kinds(state: EnvState) -> Any:
    return jax.tree.map(lambda x: (x.shape, str(x.dtype), getattr(x, "weak_type", False)), state)


def _compilations(function: Callable[..., Any]) -> int:
    return function._cache_size()  # type: ignore[attr-defined]
