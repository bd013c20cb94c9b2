"""Small environments in the styles of gymnasium and dm_env, for workers to hold."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

import dm_env
import gymnasium
import numpy as np
from dm_env import specs


class Counting(gymnasium.Env):
    """Counts its steps from a random start; an episode is terminal at ``terminal`` steps, cut at ``limit``."""

    def __init__(self, terminal: int = 1_000, limit: int = 1_000, discrete: bool = True, pixels: bool = False) -> None:
        self.terminal, self.limit, self.pixels, self.t, self.start = terminal, limit, pixels, 0, 0
        self.last_action: Any = None
        self.action_space = (
            gymnasium.spaces.Discrete(3, start=5) if discrete else gymnasium.spaces.Box(-2.0, 4.0, (2,), np.float32)
        )
        spaces = {"count": gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)}
        if pixels:
            spaces["image"] = gymnasium.spaces.Box(0, 255, (32, 32, 3), np.uint8)
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t, self.start = 0, int(self.np_random.integers(1_000))
        return self._obs(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.t, self.last_action = self.t + 1, action
        return self._obs(), float(np.sum(action)), self.t >= self.terminal, self.t >= self.limit, {}

    def _obs(self) -> Any:
        obs = {"count": np.array([self.t, self.start], np.float64)}
        return obs | ({"image": np.full((32, 32, 3), self.t, np.uint8)} if self.pixels else {})


class Failing(Counting):
    """Does something wrong at its third step, in the process whose file ``mark`` is not there yet, or each time."""

    def __init__(self, how: str, mark: str | None = None) -> None:
        super().__init__()
        self.how, self.mark = how, mark

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        result = super().step(action)
        if self.t < 3 or (self.mark is not None and os.path.exists(self.mark)):
            return result
        if self.mark is not None:
            with open(self.mark, "w"):
                pass
        if self.how == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.how == "exits":
            os._exit(7)
        if self.how == "hangs":
            time.sleep(1_000)
        if self.how == "raises":
            raise RuntimeError("the door is stuck")
        obs = result[0]
        if self.how == "nan":
            obs["count"][0] = np.nan
        if self.how == "shape":
            obs["count"] = np.zeros(5)
        return obs, *result[1:]


class SlowToBegin(Counting):
    """Takes a second to begin an episode."""

    def reset(self, **options: Any) -> Any:
        time.sleep(1.0)
        return super().reset(**options)


class BeginsOnce(Counting):
    """Begins an episode where the file ``mark`` is not there yet, or never."""

    def __init__(self, mark: str | None = None) -> None:
        super().__init__()
        self.mark = mark

    def reset(self, **options: Any) -> Any:
        if self.mark is None or os.path.exists(self.mark):
            raise RuntimeError("no level found")
        with open(self.mark, "w"):
            pass
        return super().reset(**options)


class Walk(dm_env.Environment):
    """A dm_env environment that ends at six steps, terminal where ``discount`` is 0."""

    def __init__(self, discount: float = 1.0) -> None:
        self.discount, self.t = discount, 0

    def reset(self) -> dm_env.TimeStep:
        self.t = 0
        return dm_env.restart(self._obs())

    def step(self, action: Any) -> dm_env.TimeStep:
        assert np.shape(action) == (1,), action
        assert np.abs(action[0]) <= 3.0, action
        self.t += 1
        if self.t == 6:
            return dm_env.TimeStep(dm_env.StepType.LAST, float(action[0]), self.discount, self._obs())
        return dm_env.transition(float(action[0]), self._obs())

    def observation_spec(self) -> Any:
        return {"t": specs.Array((), np.int64), "phase": specs.DiscreteArray(4)}

    def action_spec(self) -> Any:
        return specs.BoundedArray((1,), np.float64, -3.0, 3.0)

    def _obs(self) -> Any:
        return {"t": np.int64(self.t), "phase": np.int32(self.t % 4)}


class Stumbling(Walk):
    """The reward of its third step is not finite."""

    def step(self, action: Any) -> dm_env.TimeStep:
        timestep = super().step(action)
        return timestep._replace(reward=np.nan) if self.t == 3 else timestep


def make_walk() -> dm_env.Environment:
    """For ``dm_env:tests.envs.host_fakes:make_walk``."""
    return Walk()
