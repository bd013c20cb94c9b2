"""Environments that others wrote in JAX, as environments of this package: ``make("jax:gymnax/Pong-misc")``.

One module a library; each has ``names()``, ``make(task, **options)`` and a function for environments of one's own in
that library's style: `gymnax.from_gymnax`, `brax.from_brax`, `xminigrid.from_xminigrid`. They run inside of the
compiled program, one key a step. None of the libraries is needed to import this package.

What all share, in `common`:

- Images (rank 3, uint8 or in [0, 1]) become uint8 ``[image_size, image_size, C]``; all else becomes float32 vectors,
  flattened; a ``Discrete`` observation becomes a one-hot vector. A single observation is called ``image`` or
  ``vector``; those of a dict keep their names, nested ones joined by ``/``.
- ``Discrete`` actions stay; bounded ``Box`` actions are scaled from [-1, 1] to their bounds.
- A time limit ends an episode with ``is_last`` alone; each module says how it knows one. The observation of the last
  step is kept: auto-resetting steps of the libraries are never called.
- The libraries compute by JAX's standard promotion rules, in 32 bits, whatever the user's program is set to.

Which versions work beside the JAX that this package asks for is in `BACKENDS`. gymnax and stable-gymnax (which
popgym-arcade needs) install the same import name: of these two backends an installation has one, and
``jax:gymnax/...`` runs on what stable-gymnax has, too.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import inspect
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from ne_dreamer_jax.envs.base import Env

PREFIX = "jax:"


class Backend(NamedTuple):
    """A library of environments."""

    package: str  # what is imported
    requirement: str  # what pip installs


BACKENDS: dict[str, Backend] = {
    "brax": Backend("brax", "brax==0.14.2"),
    "craftax": Backend("craftax", "craftax==1.6.1"),
    "gymnax": Backend("gymnax", "gymnax==1.0.1 six"),
    "playground": Backend("mujoco_playground", "playground==0.2.0"),
    "popgym_arcade": Backend("popgym_arcade", "popgym-arcade==0.0.7 six"),
    "xminigrid": Backend("xminigrid", "xminigrid==0.9.3"),
}
"""Backend (a module of this package of that name) -> the library it needs. gymnax imports six without asking for it."""


def make(name: str, **options: Any) -> Env:
    """Makes the environment called ``name``, such as ``"jax:gymnax/MemoryChain-bsuite"``.

    Args:
      options: those of the backend's ``make``, for all of them ``image_size``.

    Raises:
      ValueError: no backend or environment has that name (the message names close matches), the library isn't
        installed (the message has the line that installs it) or fails, an option is unknown or has a bad value, or
        the environment's actions or state are none that can be adapted.
    """
    backend, task = split(name)
    module = _module(backend)
    _check("environment", task, module.names(), f"{PREFIX}{backend}/")
    known = list(inspect.signature(module.make).parameters)[1:]
    if unknown := sorted(set(options) - set(known)):
        raise ValueError(f"{name}: expected options among {', '.join(known)}, got {', '.join(unknown)}")
    try:
        return module.make(task, **options)
    except ValueError:
        raise
    except Exception as error:
        message = f"{name}: {BACKENDS[backend].package} does not make it: {type(error).__name__}: {error}"
        raise ValueError(message) from error


def names(backend: str) -> tuple[str, ...]:
    """All names of a backend that ``make`` takes, sorted. Errors as of ``make``."""
    _check("backend", backend, tuple(BACKENDS))
    return tuple(sorted(f"{PREFIX}{backend}/{task}" for task in _module(backend).names()))


def split(name: str) -> tuple[str, str]:
    """``"jax:gymnax/Pong-misc"`` -> ``("gymnax", "Pong-misc")``. Raises ValueError for anything else."""
    backend, slash, task = name.removeprefix(PREFIX).partition("/")
    if not (name.startswith(PREFIX) and slash and task):
        raise ValueError(f"expected the name of an environment, {PREFIX}BACKEND/NAME, got {name!r}")
    _check("backend", backend, tuple(BACKENDS))
    return backend, task


def check_installed(name: str) -> str:
    """The backend of a name. Raises ValueError where there is none of that name, or its library is not installed."""
    backend, _ = split(name)
    package, requirement = BACKENDS[backend]
    if importlib.util.find_spec(package) is None:
        raise ValueError(
            f"environments {PREFIX}{backend}/... need the package {package}, which is not installed; install it with: "
            f"pip install {requirement}"
        )
    return backend


def _module(backend: str) -> Any:
    check_installed(f"{PREFIX}{backend}/any")
    package, requirement = BACKENDS[backend]
    needs = f"environments {PREFIX}{backend}/... need the package {package}"
    from ne_dreamer_jax.envs.adapters import common

    try:
        common.imported(package)
    except ImportError as error:
        raise ValueError(
            f"{needs}, which does not load: {error}; install it with: pip install {requirement}"
        ) from error
    return importlib.import_module(f"{__name__}.{backend}")


def _check(kind: str, name: str, known: tuple[str, ...], prefix: str = "") -> None:
    if name not in known:
        close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
        hint = f"did you mean {', '.join(close)}?" if close else f"there are: {', '.join(sorted(known))}"
        raise ValueError(f"no {kind} is called {prefix + name!r}; {hint}")
