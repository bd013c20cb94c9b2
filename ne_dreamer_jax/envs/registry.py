"""The one door to all environments: families by the prefix of their names, and people's own.

In plain Python: importing this loads neither JAX nor MuJoCo. A family's module is loaded when an environment of it is
made; its names stand in a module of their own that loads nothing.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

from ne_dreamer_jax.envs.dmc.names import NAMES as DMC_NAMES
from ne_dreamer_jax.envs.host import names as host_names
from ne_dreamer_jax.envs.rooms.names import NAMES as ROOMS_NAMES
from ne_dreamer_jax.settings.text import did_you_mean


class Family(NamedTuple):
    """Environments whose names begin alike."""

    module: str
    """Has ``make(name, **options) -> Env``."""
    names: Callable[[], tuple[str, ...]]
    """Those that can be made, as far as that is known without loading anything."""
    check: Callable[[str], Any] | None = None
    """Raises ValueError for a name that is none, where ``names`` does not say."""
    options: tuple[str, ...] | None = None
    """That ``make`` takes; None where it depends on the environment."""


def _adapters() -> Any:
    return importlib.import_module("ne_dreamer_jax.envs.adapters")  # which loads nothing by itself


FAMILIES: dict[str, Family] = {
    "dmc/": Family(
        "ne_dreamer_jax.envs.dmc.tasks", lambda: DMC_NAMES, options=("obs", "action_repeat", "image_size", "fast")
    ),
    "rooms/": Family("ne_dreamer_jax.envs.rooms.tasks", lambda: ROOMS_NAMES, options=("image_size", "length")),
    "jax:": Family("ne_dreamer_jax.envs.adapters", lambda: (), lambda name: _adapters().check_installed(name)),
    **{prefix: Family("ne_dreamer_jax.envs.host", lambda: (), host_names.check) for prefix in host_names.LIBRARIES},
}
"""Prefix -> family."""

_registered: dict[str, Callable[[], Any]] = {}


def register(name: str, make: Callable[[], Any]) -> None:
    """Gives an environment of one's own a name, in this process: ``--task`` and ``envs.make`` take it from now on.

    Args:
      name: none that a family's prefix begins, and without a colon.
      make: returns an ``envs.base.Env``; called when the environment is asked for.

    Raises:
      ValueError: the name is a family's, or taken.
    """
    if family_of(name) is not None or ":" in name or not name:
        raise ValueError(
            f"expected a name that begins with none of {', '.join(FAMILIES)} and has no colon, got {name!r}"
        )
    if name in _registered and _registered[name] is not make:
        raise ValueError(f"expected a new name, got {name!r}, which another environment has already")
    _registered[name] = make


def names() -> tuple[str, ...]:
    """All names that `make` takes, sorted."""
    return tuple(sorted([*(name for family in FAMILIES.values() for name in family.names()), *_registered]))


def family_of(name: str) -> str | None:
    """The prefix of a name's family; None for environments of people's own."""
    return next((prefix for prefix in FAMILIES if name.startswith(prefix)), None)


def check(name: str) -> None:
    """Raises ValueError, naming the closest matches, unless ``name`` is registered or a ``module:function``."""
    if name in names():
        return
    prefix = family_of(name)
    check_name = None if prefix is None else FAMILIES[prefix].check
    if check_name is not None:
        check_name(name)
        return
    if ":" in name and family_of(name) is None:
        module, _, function = name.partition(":")
        if module.split(".")[0] in sys.stdlib_module_names:  # a configuration may come from anywhere
            raise ValueError(f"expected a function of a module of your own, got {name!r}, of Python's standard library")
        if all(part.isidentifier() for part in [*module.split("."), function]):
            return
        raise ValueError(f"expected module:function, such as mypackage.envs:make, got {name!r}")
    raise ValueError(
        f"no environment is called {name!r}. {did_you_mean(name, names())} One of your own is named as "
        "module:function, or by envs.register(name, make)"
    )


def make(name: str, **options: Any) -> Any:
    """Makes an environment; errors as of `envs.make`."""
    check(name)
    prefix = family_of(name)
    if prefix is not None:
        family = FAMILIES[prefix]
        known = options if family.options is None else family.options
        for option in options:
            if option not in known:
                raise ValueError(f"{name} has no option {option!r}. {did_you_mean(option, known)}")
        return importlib.import_module(family.module).make(name, **options)
    if options:
        raise ValueError(
            f"{name}: expected no options for an environment of one's own, which says itself how it is observed; got "
            f"{', '.join(options)}. config.override(config, 'env.task={name}') puts it in a configuration"
        )
    return (_registered.get(name) or _imported(name))()


def _imported(name: str) -> Callable[[], Any]:
    """What a ``module:function`` names."""
    module_name, _, function = name.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ValueError(f"--task {name}: {error}; run the command where Python finds {module_name}") from error
    found = getattr(module, function, None)
    if not callable(found):
        near = did_you_mean(function, [key for key in vars(module) if not key.startswith("_")])
        raise ValueError(f"--task {name}: expected a function {function} in {module_name}. {near}")
    return found
