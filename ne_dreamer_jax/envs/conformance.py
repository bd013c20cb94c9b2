"""What every environment promises, as a check to run on one's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs.base import Env, EnvState
from ne_dreamer_jax.envs.vector import VectorEnv, check_env
from ne_dreamer_jax.types import Array, ContinuousAction, TimeStep

Kind = Literal["key", "dtype", "shape", "bound", "flag", "determinism", "compilation", "error"]


class Finding(NamedTuple):
    """A promise that an environment breaks."""

    where: str  # such as obs['image'], reward, state.faults
    kind: Kind  # key: the names in a dict or the fields of a state; bound: of values and actions
    expected: str
    got: str

    def __str__(self) -> str:
        return f"{self.where}: {self.kind}: expected {self.expected}, got {self.got}"


class _Report:
    """Collects findings, the first of each kind in each place."""

    def __init__(self) -> None:
        self.found: dict[tuple[str, Kind], Finding] = {}

    def add(self, where: str, kind: Kind, expected: str, got: str) -> None:
        self.found.setdefault((where, kind), Finding(where, kind, expected, got))

    def expect(self, fine: Any, where: str, kind: Kind, expected: str, got: str) -> None:
        if not bool(fine):
            self.add(where, kind, expected, got)

    def same(self, where: str, actual: Any, expected: Any, promise: str) -> None:
        """Bit for bit equal pytrees of one structure."""
        for (path, a), b in zip(_leaves(actual), jax.tree.leaves(expected), strict=True):
            if _is_key(a):
                a, b = jax.random.key_data(a), jax.random.key_data(b)
            a, b = np.asarray(a), np.asarray(b)
            if not np.array_equal(a, b):
                differ = f"{int(np.sum(a != b))} of {a.size} numbers that differ"
                self.add(f"{where}{jax.tree_util.keystr(path)}", "determinism", f"the same bits: {promise}", differ)


def check(
    env: Env | VectorEnv,
    key: Array,
    num_envs: int = 2,
    num_steps: int = 5,
    beginning_steps: int = 50,
    echo: Callable[[str], None] = print,
) -> None:
    """Runs some environments at once and checks what a learner relies on; arguments as of ``findings``.

    Raises:
      AssertionError: promises are broken; the message says which, what was expected and what was got.
    """
    found = findings(env, key, num_envs, num_steps, beginning_steps, echo)
    if found:
        raise AssertionError("\n".join(map(str, found)))


def findings(
    env: Env | VectorEnv,
    key: Array,
    num_envs: int = 2,
    num_steps: int = 5,
    beginning_steps: int = 50,
    echo: Callable[[str], None] = print,
) -> list[Finding]:
    """Runs some environments at once and says what of that which a learner relies on is not so.

    First the shapes and dtypes of all functions, without running them; where those are at fault, nothing more.

    Args:
      env: what ``envs.make`` or ``envs.base.from_core`` returns, or any other ``Env``; or a ``VectorEnv``, of which
        ``num_envs`` play ``2 * num_steps + beginning_steps`` steps, twice over.
      key: typed key [], for episodes and random actions.
      num_envs: how many run side by side under ``vmap``.
      num_steps: steps before a restart is forced, and after it.
      beginning_steps: steps for which episodes that begin in different ways are compared.
      echo: takes a line on each part of the check, before it begins.

    Raises:
      ValueError: ``env`` is not an environment but what one might be made of.
    """
    check_env(env)
    report = _Report()
    if isinstance(env, VectorEnv):
        before = env.host.failure if env.host is not None else None
        try:
            _check_vector(env, report, key, num_envs, 2 * num_steps + beginning_steps, echo)
        except jax.errors.JaxRuntimeError as error:  # what the host raised
            failure = env.host.failure if env.host is not None else None
            why = failure if failure is not None and failure != before else _first_line(error)
            report.add("prepare or step", "error", "environments that can be stepped", why)
        return list(report.found.values())
    echo("Looking at shapes and dtypes.")
    try:
        _check_types(env, report)
    except Exception as error:
        report.add("reset or step", "error", "functions that can be traced", _first_line(error))
    if not report.found:
        _check_episodes(env, report, key, num_envs, num_steps, beginning_steps, echo)
    return list(report.found.values())


def random_action(env: Env | VectorEnv, key: Array, num_envs: int) -> Array:
    """Uniformly random actions, [num_envs, *action.shape]."""
    spec = env.spec.action
    if isinstance(spec, ContinuousAction):
        return jax.random.uniform(key, (num_envs, *spec.shape), jnp.float32, -1.0, 1.0)
    return jax.random.randint(key, (num_envs,), 0, spec.size, jnp.int32)


# Shapes and dtypes.


def _check_spec(env: Env | VectorEnv, report: _Report) -> None:
    for name, spec in env.spec.observation.items():
        image = len(spec.shape) == 3 and spec.dtype == jnp.uint8
        vector = len(spec.shape) <= 1 and spec.dtype == jnp.float32
        expected = "uint8[height,width,channels] or float32[size] or float32[]"
        got = f"{jnp.dtype(spec.dtype).name}{list(spec.shape)}"
        report.expect(image or vector, f"spec.observation[{name!r}]", "dtype", expected, got)


def _check_types(env: Env, report: _Report) -> None:
    _check_spec(env, report)
    key = jax.eval_shape(lambda: jax.random.key(0))
    action = jax.ShapeDtypeStruct(env.spec.action.shape, env.spec.action.dtype)
    state, timestep = jax.eval_shape(env.reset, key)
    _check_timestep_types(env, timestep, report, "reset")
    stepped, timestep = jax.eval_shape(env.step, state, action)
    _check_timestep_types(env, timestep, report, "step")
    _check_observation_types(env, jax.eval_shape(env.observe, state), report, "observe")
    _check_state_types(state, stepped, report, "step")
    _check_state_types(state, jax.eval_shape(env.prepare, key), report, "prepare")


def _check_timestep_types(
    env: Env | VectorEnv, timestep: TimeStep, report: _Report, function: str, batch: tuple[int, ...] = ()
) -> None:
    _check_observation_types(env, timestep.obs, report, function, batch)
    for name, dtype in (("reward", "float32"), ("is_first", "bool"), ("is_last", "bool"), ("is_terminal", "bool")):
        expected = jax.ShapeDtypeStruct(batch, jnp.dtype(dtype))
        _expect_type(report, f"{function}: {name}", expected, getattr(timestep, name))


def _check_observation_types(
    env: Env | VectorEnv, obs: Mapping[str, Any], report: _Report, function: str, batch: tuple[int, ...] = ()
) -> None:
    wanted = env.spec.observation
    report.expect(set(obs) == set(wanted), f"{function}: obs", "key", f"names {sorted(wanted)}", f"{sorted(obs)}")
    for name in sorted(set(obs) & set(wanted)):
        spec = jax.ShapeDtypeStruct((*batch, *wanted[name].shape), jnp.dtype(wanted[name].dtype))
        _expect_type(report, f"{function}: obs[{name!r}]", spec, obs[name])


def _check_state_types(state: Any, other: Any, report: _Report, function: str) -> None:
    """A state changes no shape, dtype or weak type."""
    leaves, others = _leaves(state), _leaves(other)
    names, other_names = ([jax.tree_util.keystr(path) for path, _ in each] for each in (leaves, others))
    if names != other_names:
        fields = [sorted(set(a) - set(b))[:3] for a, b in ((names, other_names), (other_names, names))]
        report.add(
            f"{function}: state", "key", "the fields of reset's", f"without {fields[0]}, and with {fields[1]} too"
        )
        return
    for name, (_, leaf), (_, changed) in zip(names, leaves, others, strict=True):
        where = f"{function}: state{name}"
        _expect_type(report, where, leaf, changed)
        weak = [getattr(x, "weak_type", False) for x in (leaf, changed)]
        kinds = ["a weak type" if x else "a dtype of its own" for x in weak]
        report.expect(weak[0] == weak[1], where, "dtype", f"{kinds[0]}, as from reset", kinds[1])


def _expect_type(report: _Report, where: str, expected: Any, got: Any) -> None:
    if not (hasattr(got, "shape") and hasattr(got, "dtype")):
        report.add(where, "dtype", str(expected.dtype), f"{type(got).__name__} {got!r}")
        return
    report.expect(expected.dtype == got.dtype, where, "dtype", str(expected.dtype), str(got.dtype))
    shapes = [list(expected.shape), list(got.shape)]
    report.expect(shapes[0] == shapes[1], where, "shape", f"{shapes[0]}", f"{shapes[1]}")


# Episodes.


def _check_episodes(
    env: Env,
    report: _Report,
    key: Array,
    num_envs: int,
    num_steps: int,
    beginning_steps: int,
    echo: Callable[[str], None],
) -> None:
    reset, step, observe = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(env.observe))
    reset_key, action_key = jax.random.split(key)
    keys = jax.random.split(reset_key, num_envs)
    echo("Compiling reset and step, and resetting.")
    state, timestep = reset(keys)
    report.same("reset", reset(keys), (state, timestep), "reset with the same key")
    _check_first(timestep, report, "reset")
    _check_values(timestep, report, "reset")

    echo(f"Stepping {num_envs} environments {2 * num_steps} times, with a restart in between.")
    for number in range(2 * num_steps):
        restart = number == num_steps
        if restart:
            state = state._replace(needs_reset=jnp.ones(num_envs, bool))
        action = random_action(env, jax.random.fold_in(action_key, number), num_envs)
        before, last = state, timestep.is_last | restart
        state, timestep = step(before, action)
        when = f"step {number + 1}"
        _check_values(timestep, report, when)
        wrong = np.asarray(timestep.is_first != last)
        expected = "True right after is_last and nowhere else"
        report.expect(not wrong.any(), "is_first", "flag", expected, f"{np.asarray(timestep.is_first)} at {when}")
        report.same("observe", observe(state), timestep.obs, "observe of the returned state")
        if number == 0:
            report.same("step", step(before, action), (state, timestep), "step with the same arguments")
            if isinstance(env.spec.action, ContinuousAction):
                _check_bounds(step, before, jnp.sign(action), report)
        if restart:
            _check_restart(env, step, before, action, state, timestep, report)

    echo(f"Comparing episodes that begin by reset, by prepare and by auto-reset, for {beginning_steps} steps.")
    _check_beginnings(env, reset, step, state, jax.random.fold_in(action_key, 2 * num_steps), beginning_steps, report)
    for name, function in (("reset", reset), ("step", step)):
        times = _compilations(function)
        report.expect(times == 1, name, "compilation", "one compilation", f"{times}")


def _check_vector(
    env: VectorEnv, report: _Report, key: Array, num_envs: int, num_steps: int, echo: Callable[[str], None]
) -> None:
    """What can be asked of N environments that can't be stepped one by one, nor from the same state twice."""
    echo("Looking at shapes and dtypes.")
    _check_spec(env, report)
    reset_key, action_key = jax.random.split(key)
    keys = jax.random.split(reset_key, num_envs)
    actions = [random_action(env, jax.random.fold_in(action_key, number), num_envs) for number in range(num_steps)]
    state = jax.eval_shape(env.prepare, keys)
    stepped, timestep = jax.eval_shape(env.step, state, actions[0])
    _check_timestep_types(env, timestep, report, "step", (num_envs,))
    _check_state_types(state, stepped, report, "step")
    if report.found:
        return

    echo(f"Stepping {num_envs} environments {num_steps} times, and again from the same keys.")
    step = jax.jit(env.step)
    played = [_played(env, step, keys, actions, report) for _ in range(2)]
    for number, (timestep, again) in enumerate(zip(*played, strict=True)):
        report.same("step", again, timestep, f"{number} steps after prepare with the same keys")
    if isinstance(env.spec.action, ContinuousAction) and not report.found:
        sides = ([factor * jnp.sign(action) for action in actions[:5]] for factor in (1, 7))
        at, beyond = (np.concatenate(_numbers(*_played(env, step, keys, side, report))) for side in sides)
        expected = "an action out of bounds to act as the bound"
        report.expect(np.array_equal(at, beyond), "action", "bound", expected, "another time step")
    times = _compilations(step)
    report.expect(times == 1, "step", "compilation", "one compilation", f"{times}")


def _played(
    env: VectorEnv, step: Callable[..., Any], keys: Array, actions: list[Array], report: _Report
) -> list[TimeStep]:
    """The time steps of episodes from the beginning, each looked at."""
    state, last, timesteps = env.prepare(keys), np.ones(len(keys), bool), []
    for number, action in enumerate(actions):
        state, timestep = step(state, action)
        when = f"step {number + 1}"
        _check_values(timestep, report, when)
        if number == 0:
            _check_first(timestep, report, "the first step")
        first = np.asarray(timestep.is_first)
        expected = "True right after is_last and nowhere else"
        report.expect(np.array_equal(first, last), "is_first", "flag", expected, f"{first} at {when}")
        fresh = np.where(first, np.asarray(timestep.reward), 0.0)
        report.expect(not fresh.any(), "reward", "bound", "0 where an episode starts", f"{fresh} at {when}")
        last = np.asarray(timestep.is_last)
        timesteps.append(timestep)
    cuts = env.cuts(state)
    failed = np.asarray(cuts.faults)
    lines = env.host.lines()[:3] if env.host is not None else []
    report.expect(
        not failed.any() and not lines,
        "episodes",
        "error",
        "none that the environment cut or could not begin",
        "; ".join([f"{failed.sum()} that were cut", *lines]),
    )
    if env.release is not None:
        env.release(state)
    return timesteps


def _check_bounds(step: Callable[..., Any], state: EnvState, bound: Array, report: _Report) -> None:
    beyond, at = (np.asarray(leaf) for leaf in _numbers(step(state, 7 * bound), step(state, bound)))
    expected = "an action out of bounds to act as the bound"
    report.expect(np.array_equal(beyond, at), "action", "bound", expected, "another state or time step")


def _check_restart(
    env: Env,
    step: Callable[..., Any],
    before: EnvState,
    action: Array,
    state: EnvState,
    timestep: TimeStep,
    report: _Report,
) -> None:
    _check_first(timestep, report, "a restart")
    other = -action if isinstance(env.spec.action, ContinuousAction) else action * 0
    report.same("a restart", step(before, other)[1], timestep, "a restart, whatever the action")
    changed = np.asarray(jax.random.key_data(state.key) != jax.random.key_data(before.key)).any(-1)
    expected = "a restart to move on to a new key"
    report.expect(changed.all(), "state.key", "determinism", expected, "the key of the episode before")


def _check_beginnings(
    env: Env,
    reset: Callable[..., Any],
    step: Callable[..., Any],
    old: EnvState,
    key: Array,
    num_steps: int,
    report: _Report,
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
            report.same(name, seen, timestep, promise)
            if number:  # before the first step there may be leftovers that nothing reads
                settled = other._replace(faults=state.faults, bad_actions=state.bad_actions)
                report.same(f"{name}: state", settled, state, promise)
        if number < num_steps:
            action = random_action(env, jax.random.fold_in(key, number), num_envs)
            begun = {name: step(state, action) for name, (state, _) in begun.items()}


def _check_values(timestep: TimeStep, report: _Report, when: str) -> None:
    for name, value in (
        *((f"obs[{name!r}]", value) for name, value in timestep.obs.items()),
        ("reward", timestep.reward),
    ):
        numbers = np.asarray(value)
        wrong = ~np.isfinite(numbers)
        got = f"{numbers[wrong].flat[0]} at {when}" if wrong.any() else ""
        report.expect(not wrong.any(), name, "bound", "finite numbers", got)
    alone = np.asarray(timestep.is_terminal & ~timestep.is_last)
    report.expect(not alone.any(), "is_terminal", "flag", "is_last wherever it is set", f"it alone at {when}")


def _check_first(timestep: TimeStep, report: _Report, when: str) -> None:
    reward, first, last = (np.asarray(x) for x in (timestep.reward, timestep.is_first, timestep.is_last))
    report.expect(not reward.any(), "reward", "bound", "0 where an episode starts", f"{reward} at {when}")
    report.expect(first.all(), "is_first", "flag", "True where an episode starts", f"{first} at {when}")
    report.expect(not last.any(), "is_last", "flag", "an episode longer than its first step", f"{last} at {when}")


def _numbers(*trees: Any) -> list[np.ndarray]:
    """Each pytree as one vector of float64 numbers, keys as their data."""
    vectors = []
    for tree in trees:
        leaves = [jax.random.key_data(x) if _is_key(x) else x for x in jax.tree.leaves(tree)]
        vectors.append(np.concatenate([np.asarray(x, np.float64).reshape(-1) for x in leaves]))
    return vectors


def _leaves(tree: Any) -> list[tuple[Any, Any]]:
    return jax.tree_util.tree_flatten_with_path(tree)[0]


def _is_key(x: Any) -> bool:
    return jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"


def _compilations(function: Callable[..., Any]) -> int:
    return function._cache_size()  # type: ignore[attr-defined]
