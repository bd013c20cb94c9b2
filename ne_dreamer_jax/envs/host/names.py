"""Names of environments of other libraries that run in worker processes, in plain Python."""

from __future__ import annotations

import importlib
import importlib.util
import os
from typing import NamedTuple

from ne_dreamer_jax.envs.host import opengl

GYM, DM_ENV, DM_CONTROL, DMLAB, MEMORY_MAZE = "gym:", "dm_env:", "dm_control:", "dmlab:", "memory_maze:"
MAZES = ("9x9", "11x11", "13x13", "15x15")


class Library(NamedTuple):
    """What a prefix needs."""

    package: str
    install: str
    example: str


LIBRARIES = {
    GYM: Library("gymnasium", "'ne-dreamer-jax[host]'", "gym:CartPole-v1"),
    DM_ENV: Library("dm_env", "dm-env", "dm_env:mymodule:make"),
    DM_CONTROL: Library("dm_control", "'ne-dreamer-jax[train]'", "dm_control:walker_walk"),
    DMLAB: Library("deepmind_lab", "its own build, see github.com/google-deepmind/lab", "dmlab:rooms_watermaze"),
    MEMORY_MAZE: Library("memory_maze", "memory-maze gym", "memory_maze:9x9"),
}


def check(name: str) -> None:
    """Raises ValueError where a name's library is not installed, or where it has no such environment."""
    prefix = next(prefix for prefix in LIBRARIES if name.startswith(prefix))
    task, library = name.removeprefix(prefix), LIBRARIES[prefix]
    if not task:
        raise ValueError(f"expected a name such as {library.example}, got {name!r}")
    for package, install in ((library.package, library.install), ("cloudpickle", "'ne-dreamer-jax[host]'")):
        if importlib.util.find_spec(package) is None:
            raise ValueError(
                f"environments {prefix}... need the package {package}, which is not installed; install it with: "
                f"{'' if install.startswith('its') else 'pip install '}{install}"
            )
    _CHECKS[prefix](name, task)


def _check_gym(name: str, task: str) -> None:
    import gymnasium

    module, colon, _ = task.rpartition(":")
    if colon:
        _check_module(name, module)
        return  # the module registers it when it is imported, in a worker
    if task.startswith("ALE/") and importlib.util.find_spec("ale_py") is None:
        raise ValueError(
            f"{name} needs the package ale_py, which is not installed; install it with: pip install ale-py"
        )
    register_installed()
    try:
        gymnasium.spec(task)
    except gymnasium.error.Error as error:
        from ne_dreamer_jax.settings.text import did_you_mean

        known = [str(known) for known in gymnasium.registry]
        raise ValueError(f"no environment is called {name!r}: {error} {did_you_mean(task, known)}") from error


def register_installed() -> None:
    """Atari's names, where ale-py is installed, which does not register them by itself."""
    import gymnasium

    if importlib.util.find_spec("ale_py") is not None:
        gymnasium.register_envs(importlib.import_module("ale_py"))


def _check_dm_env(name: str, task: str) -> None:
    module, _, function = task.partition(":")
    if not function.isidentifier():
        raise ValueError(f"expected dm_env:module:function, such as {LIBRARIES[DM_ENV].example}, got {name!r}")
    _check_module(name, module)


def _check_module(name: str, module: str) -> None:
    if not all(part.isidentifier() for part in module.split(".")):
        raise ValueError(f"expected the name of a module in {name!r}, got {module!r}")


def _check_dm_control(name: str, task: str) -> None:
    opengl.check(os.environ.get("MUJOCO_GL", ""))
    from ne_dreamer_jax.envs.dmc.names import NAMES
    from ne_dreamer_jax.settings.text import did_you_mean

    known = [known.removeprefix("dmc/") for known in NAMES]
    domain, _, rest = task.rpartition("_")
    if task not in known and not (domain and rest):
        raise ValueError(f"expected dm_control:domain_task, got {name!r}. {did_you_mean(task, known)}")


def _check_maze(name: str, task: str) -> None:
    if task not in MAZES:
        raise ValueError(
            f"no environment is called {name!r}; expected one of {', '.join(MEMORY_MAZE + m for m in MAZES)}"
        )


def _check_dmlab(name: str, task: str) -> None:
    if not task.replace("/", "").isidentifier():
        raise ValueError(f"expected a level of DMLab, such as {LIBRARIES[DMLAB].example}, got {name!r}")


_CHECKS = {
    DMLAB: _check_dmlab,
    GYM: _check_gym,
    DM_ENV: _check_dm_env,
    DM_CONTROL: _check_dm_control,
    MEMORY_MAZE: _check_maze,
}
