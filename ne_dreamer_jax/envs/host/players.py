"""One environment of another library, stepped as agents' environments are: what a worker process holds.

A player is made by a factory without arguments and has ``described``, ``reset(seed)``, ``step(action)`` and
``close()``. Nothing here knows JAX, so that workers need not load it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from ne_dreamer_jax.envs.host import spaces
from ne_dreamer_jax.envs.host.spaces import Described

Observe = Literal["own", "pixels", "both"]
PIXELS = "image"
"""The name of a picture that is drawn in addition to what an environment observes."""


class Seen(NamedTuple):
    """What came of a step."""

    obs: dict[str, np.ndarray]
    reward: float
    is_last: bool
    is_terminal: bool
    fault: str = ""  # why the episode is cut here, where it is: set by the worker


class Player(Protocol):
    """An environment in a worker."""

    described: Described

    def reset(self, seed: int | None) -> dict[str, np.ndarray]:
        """Begins an episode; with a seed for all that is random from now on, or going on from before."""
        ...

    def step(self, action: np.ndarray) -> Seen:
        """Takes an action for as many of the environment's steps as are to be one of the agent's."""
        ...

    def close(self) -> None:
        """Frees what the environment holds."""
        ...


class Options(NamedTuple):
    """How an environment is observed and stepped."""

    observe: Observe = "own"  # what it observes itself, a picture of it, or both
    image_size: int | None = 64  # height and width of all images; None leaves them as they are
    action_repeat: int = 1


class _Observed:
    """The parts of an observation, each with what reads it."""

    def __init__(self, space: Any, options: Options, draw: Callable[[], Any]) -> None:
        self._draw = draw if options.observe != "own" else None
        self._readers: dict[str, tuple[str, spaces.Reader]] = {}
        self.specs: dict[str, tuple[tuple[int, ...], str]] = {}
        for name, part in spaces.leaves(space) if options.observe != "pixels" else ():
            seen, shape, dtype, read = spaces.observation(name, part, options.image_size)
            if shape != (0,):
                self._readers[name], self.specs[seen] = (seen, read), (shape, dtype)
        if self._draw is not None:
            if PIXELS in self.specs:
                raise ValueError(f"obs: expected 'own' for an environment that observes {PIXELS!r} itself, got 'both'")
            self._size = options.image_size or 64
            self.specs[PIXELS] = ((self._size, self._size, 3), "uint8")
        if not self.specs:
            raise ValueError(f"expected an observation, got an environment that has none: {space}")

    def __call__(self, obs: Any) -> dict[str, np.ndarray]:
        """What an agent sees of an observation. Raises ValueError where it is none of its space."""
        found = spaces.flat(obs) if self._readers else {}
        seen = {}
        for name, (as_seen, read) in self._readers.items():
            if name not in found:
                raise ValueError(f"observation {name!r}: expected it at every step, got only {sorted(found)}")
            seen[as_seen] = read(found[name])
        if self._draw is not None:
            seen[PIXELS] = spaces.resized(_picture(self._draw()), (self._size, self._size))
        for name, (shape, dtype) in self.specs.items():
            value = seen[name]
            if value.shape != shape or value.dtype != dtype:
                raise ValueError(
                    f"observation {name!r}: expected {dtype} {list(shape)}, got {value.dtype} {list(value.shape)}"
                )
        return seen


class GymnasiumPlayer:
    """A ``gymnasium.Env``: terminated is terminal, truncated is last alone."""

    def __init__(self, env: Any, options: Options) -> None:
        _expect(env, "a gymnasium.Env", ("observation_space", "action_space", "reset", "step"))
        self._env, self._repeat = env, options.action_repeat
        self._observe = _Observed(env.observation_space, options, env.render)
        size, discrete, self._action = spaces.action(env.action_space)
        step = getattr(env.unwrapped, "dt", None)
        seconds = float(step) * options.action_repeat if isinstance(step, int | float) and step > 0 else None
        self.described = Described(self._observe.specs, size, discrete, seconds)

    def reset(self, seed: int | None) -> dict[str, np.ndarray]:
        """Begins an episode."""
        obs, _ = self._env.reset(seed=seed)
        return self._observe(obs)

    def step(self, action: np.ndarray) -> Seen:
        """Rewards are summed over repeated steps, which end with the episode."""
        chosen, total, ended, cut = self._action(action), 0.0, False, False
        for _ in range(self._repeat):
            obs, reward, ended, cut, _ = self._env.step(chosen)
            total += _number(reward)
            if ended or cut:
                break
        return Seen(self._observe(obs), total, bool(ended or cut), bool(ended))

    def close(self) -> None:
        """Closes it."""
        self._env.close()


class DmEnvPlayer:
    """A ``dm_env.Environment``: the last step is terminal where its discount is 0."""

    def __init__(self, env: Any, options: Options, camera: int | str = 0) -> None:
        _expect(env, "a dm_env.Environment", ("observation_spec", "action_spec", "reset", "step"))
        self._env, self._repeat, self._size, self._camera = env, options.action_repeat, options.image_size or 64, camera
        self._observe = _Observed(_without_bounds(env.observation_spec()), options, self._render)
        size, discrete, self._action = spaces.action(_dm_action(env.action_spec()))
        step = getattr(env, "control_timestep", None)
        seconds = float(step()) * options.action_repeat if callable(step) else None
        self.described = Described(self._observe.specs, size, discrete, seconds)

    def reset(self, seed: int | None) -> dict[str, np.ndarray]:
        """Begins an episode. The seed reaches dm_control's environments, of its suite and of its composer."""
        suites = getattr(getattr(self._env, "task", None), "random", None)
        random = suites if suites is not None else getattr(self._env, "random_state", None)
        if seed is not None and isinstance(random, np.random.RandomState):
            random.seed(seed % 2**32)
        return self._observe(self._env.reset().observation)

    def step(self, action: np.ndarray) -> Seen:
        """Rewards are summed over repeated steps, which end with the episode."""
        chosen, total = self._action(action), 0.0
        for _ in range(self._repeat):
            timestep = self._env.step(chosen)
            total += _number(timestep.reward)
            if timestep.last():
                break
        ended = timestep.last()
        return Seen(self._observe(timestep.observation), total, bool(ended), bool(ended and timestep.discount == 0))

    def close(self) -> None:
        """Closes it, and frees what OpenGL holds while its thread still runs."""
        self._env.close()
        physics = getattr(self._env, "physics", None)
        if physics is not None:
            with contextlib.suppress(ReferenceError):  # of a composer's environment it is gone already
                physics.free()

    def _render(self) -> np.ndarray:
        physics = getattr(self._env, "physics", None)
        if physics is None:
            raise ValueError("obs: expected 'own' for a dm_env environment without physics to draw, got pixels")
        return physics.render(self._size, self._size, camera_id=self._camera)


def _expect(env: Any, kind: str, has: tuple[str, ...]) -> None:
    """Raises ValueError for what a factory returned in place of an environment."""
    if missing := [name for name in has if not hasattr(env, name)]:
        raise ValueError(f"expected {kind} of the factory, got {env!r:.80}, which has no {' and no '.join(missing)}")


class _Bounds(NamedTuple):
    low: Any
    high: Any
    shape: tuple[int, ...]
    dtype: Any


class _Discrete(NamedTuple):
    n: int


class _Array(NamedTuple):
    shape: tuple[int, ...]
    dtype: Any


def _without_bounds(spec: Any) -> Any:
    """dm_env's specification of an observation, as spaces."""
    if isinstance(spec, Mapping):
        return {key: _without_bounds(part) for key, part in spec.items()}
    if isinstance(spec, list | tuple) and not hasattr(spec, "dtype"):
        return {str(key): _without_bounds(part) for key, part in enumerate(spec)}
    if hasattr(spec, "num_values"):
        return _Discrete(int(spec.num_values))
    return _Array(tuple(spec.shape), spec.dtype)


def _dm_action(spec: Any) -> Any:
    """dm_env's specification of actions, as a space."""
    if hasattr(spec, "num_values"):
        return _Discrete(int(spec.num_values))
    if not (hasattr(spec, "minimum") and hasattr(spec, "maximum")):
        return spec
    if np.issubdtype(spec.dtype, np.integer) and spec.shape == () and spec.minimum == 0:
        return _Discrete(int(spec.maximum) + 1)
    return _Bounds(spec.minimum, spec.maximum, tuple(spec.shape), spec.dtype)


def _number(reward: Any) -> float:
    if reward is None or np.size(reward) != 1:
        raise ValueError(f"reward: expected a number at every step, got {reward!r}")
    return float(np.asarray(reward).reshape(()))


def _picture(picture: Any) -> np.ndarray:
    picture = np.asarray(picture)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise ValueError(
            "obs: expected a picture, uint8 [height, width, 3], of an environment made with render_mode='rgb_array', "
            f"got {picture.dtype} {list(picture.shape)}"
        )
    return picture
