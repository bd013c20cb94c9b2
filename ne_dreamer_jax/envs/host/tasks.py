"""Makes environments in worker processes, by name or by a factory."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from ne_dreamer_jax.envs.config import HostConfig
from ne_dreamer_jax.envs.host import names
from ne_dreamer_jax.envs.host.factories import PLAYERS, Made
from ne_dreamer_jax.envs.host.players import DmEnvPlayer, GymnasiumPlayer, Options
from ne_dreamer_jax.envs.host.pool import Workers
from ne_dreamer_jax.envs.host.vector import host_env
from ne_dreamer_jax.envs.vector import VectorEnv


def from_gymnasium(
    factory: Callable[[], Any], options: Options | None = None, workers: Workers | None = None
) -> VectorEnv:
    """N environments of a ``gymnasium.Env``, each made by ``factory`` in a worker process.

    Args:
      factory: without arguments; pickled by value where it stands in a script, so that its imports should too.

    Raises:
      ValueError: it can't be made, or an agent can't see it or act in it; the message says why.
    """
    return _made(GymnasiumPlayer, factory, options, workers)


def from_dm_env(
    factory: Callable[[], Any], options: Options | None = None, workers: Workers | None = None
) -> VectorEnv:
    """N environments of a ``dm_env.Environment``; arguments and errors as of `from_gymnasium`."""
    return _made(DmEnvPlayer, factory, options, workers)


def _made(player: Any, factory: Callable[[], Any], options: Options | None, workers: Workers | None) -> VectorEnv:
    options, workers = options or Options(), workers or Workers()
    check(options, workers)
    return host_env(Made(player, factory, options), workers, draws=options.observe != "own")


def check(options: Options, workers: Workers) -> None:
    """Raises ValueError for what no configuration may have either."""
    size = HostConfig.image_size if options.image_size is None else options.image_size
    HostConfig(
        obs=options.observe,
        image_size=size,
        action_repeat=options.action_repeat,
        workers=workers.processes,
        step_seconds=workers.step_seconds,
        on_failure=workers.on_failure,
    )


def make(
    name: str,
    *,
    obs: str = "own",
    image_size: int | None = 64,
    action_repeat: int = 1,
    workers: int | None = None,
    step_seconds: float = 60.0,
    on_failure: Any = "restart",
) -> VectorEnv:
    """N environments by name.

    Args:
      obs: what the environment observes itself, a picture of it (``pixels``), or both; of dm_control, ``vector`` is
        what it observes itself.
      image_size: height and width of all images; None leaves them as they are.
      action_repeat: environment steps per step; their rewards are added up.
      workers, step_seconds, on_failure: as of `Workers`.

    Raises:
      ValueError: as `from_gymnasium`; or the name is unknown, or its library not installed.
    """
    names.check(name)
    own: Any = "own" if obs == "vector" and name.startswith(names.DM_CONTROL) else obs
    options, spread = Options(own, image_size, action_repeat), Workers(workers, step_seconds, on_failure)
    check(options, spread)
    for prefix, player in PLAYERS.items():
        if name.startswith(prefix):
            return host_env(partial(player, name.removeprefix(prefix), options), spread, draws=own != "own")
    raise AssertionError(name)
