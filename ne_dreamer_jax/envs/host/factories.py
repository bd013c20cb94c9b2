"""What workers make their environments with, by name or by a factory."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ne_dreamer_jax.envs.host import names, opengl
from ne_dreamer_jax.envs.host.dmlab import LabPlayer
from ne_dreamer_jax.envs.host.players import DmEnvPlayer, GymnasiumPlayer, Options, Player, Seen


@dataclass(frozen=True)
class Made:
    """A player of what a factory makes."""

    player: Callable[[Any, Options], Player]
    factory: Callable[[], Any]
    options: Options

    def __call__(self) -> Player:
        return self.player(self.factory(), self.options)


def _gymnasium(task: str, options: Options) -> Player:
    import gymnasium

    names.register_installed()
    module, colon, name = task.rpartition(":")
    if colon:
        factory = getattr(_imported(module, f"gym:{task}"), name, None)
        if name not in gymnasium.registry:
            if not callable(factory):
                raise ValueError(f"gym:{task}: expected an environment that {module} registers, or a function of it")
            return GymnasiumPlayer(factory(), options)
    drawn = None if options.observe == "own" else "rgb_array"
    return GymnasiumPlayer(gymnasium.make(task, render_mode=drawn), options)


def _imported(module: str, name: str) -> Any:
    """Raises ValueError where the environment's ``name`` names a module that can't be imported."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ValueError(f"{name}: {error}; run the command where Python finds {module}") from error


def _dm_env(task: str, options: Options) -> Player:
    module, _, function = task.partition(":")
    factory = getattr(_imported(module, f"dm_env:{task}"), function, None)
    if not callable(factory):
        raise ValueError(f"dm_env:{task}: expected a function {function} in {module}")
    return DmEnvPlayer(factory(), options)


def _dm_control(task: str, options: Options) -> Player:
    from absl import logging

    opengl.allow()
    logging.set_verbosity(logging.ERROR)  # some models are in an older style, and MuJoCo says so each time
    from dm_control import suite

    domain, name = next(((domain, name) for domain, name in suite.ALL_TASKS if f"{domain}_{name}" == task), ("", ""))
    if not domain:
        from ne_dreamer_jax.settings.text import did_you_mean

        known = [f"{domain}_{name}" for domain, name in suite.ALL_TASKS]
        raise ValueError(f"no task of dm_control is called {task!r}. {did_you_mean(task, known)}")
    env, camera = suite.load(domain, name), _CAMERAS.get(domain, 0)
    if options.observe != "own":
        try:
            env.physics.render(8, 8, camera_id=camera)
        except Exception as error:
            raise opengl.missing(error) from error
    return DmEnvPlayer(env, options, camera)


def _dmlab(task: str, options: Options) -> Player:
    if options.observe != "own":
        raise ValueError(f"obs: expected 'own' for DMLab, which shows pictures, got {options.observe!r}")
    return LabPlayer(task, options)


class _Remade:
    """An environment that takes its seed when it is made, and is made anew for each."""

    def __init__(self, make: Callable[[int | None], Player]) -> None:
        self._make = make
        self._player = make(None)
        self.described = self._player.described

    def reset(self, seed: int | None) -> dict[str, np.ndarray]:
        """Begins an episode."""
        if seed is not None:
            self._player.close()
            self._player = self._make(seed)
        return self._player.reset(None)

    def step(self, action: np.ndarray) -> Seen:
        """As the environment's own."""
        return self._player.step(action)

    def close(self) -> None:
        """Closes it."""
        self._player.close()


def _memory_maze(task: str, options: Options) -> Player:
    opengl.allow()
    from memory_maze import tasks

    return _Remade(lambda seed: DmEnvPlayer(getattr(tasks, f"memory_maze_{task}")(seed=seed), options))


_CAMERAS = {"quadruped": 2}
"""Domain -> the camera of a pixel agent, where it is not the first."""
PLAYERS: dict[str, Callable[[str, Options], Player]] = {
    names.GYM: _gymnasium,
    names.DM_ENV: _dm_env,
    names.DM_CONTROL: _dm_control,
    names.DMLAB: _dmlab,
    names.MEMORY_MAZE: _memory_maze,
}
"""Prefix -> what makes a player of the rest of a name."""
