"""Environments: one door (`make`, `register`), one interface (`base`, `vector`), and a family a folder.

``names`` and the check of a mistyped name load neither JAX nor MuJoCo; ``make`` does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import lazy_loader

from ne_dreamer_jax.envs import registry
from ne_dreamer_jax.envs.registry import check, names, register

if TYPE_CHECKING:
    from ne_dreamer_jax.envs.base import Env
    from ne_dreamer_jax.envs.vector import VectorEnv

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__, submodules=["base", "config", "conformance", "dmc", "host", "probes", "registry", "rooms", "vector"]
)
__all__ = ["check", "make", "names", "register"]


def make(name: str, **options: Any) -> Env | VectorEnv:
    """Makes the environment called ``name``, e.g. ``"dmc/walker_walk"``, ``"mypackage.envs:make"``.

    Those in worker processes (``"gym:CartPole-v1"``) are N at once, a ``VectorEnv``; all others an ``Env``, of one.

    Options of DMC tasks (see ``envs.dmc.make``): ``obs="pixels" | "vector" | "both"``, ``action_repeat=2``,
    ``image_size=64``, ``fast=False``; of Rooms tasks (``envs.rooms.make``): ``image_size=64``, ``length=None``.
    those in worker processes: see ``envs.host.make``. Environments of people's own take none.

    Raises:
      ValueError: no environment has that name (the message names close matches), or an option has a bad value.
    """
    return registry.make(name, **options)
