"""Which OpenGL draws dm_control's pictures, in plain Python."""

from __future__ import annotations

import ctypes.util
import os

from ne_dreamer_jax.settings.text import did_you_mean

NONE = ("", "disable", "disabled", "off", "0", "false", "no")
KNOWN = ("egl", "osmesa", "glfw", "glx", "cgl", "wgl", "enable", "enabled", "on", "true", "1")


def allow() -> None:
    """Sets ``MUJOCO_GL`` to draw without a screen, unless it already names a way to draw; call before MuJoCo loads.

    Raises:
      ValueError: it names none that MuJoCo knows.
    """
    given = os.environ.get("MUJOCO_GL", "")
    check(given)
    if given.lower() in NONE:
        os.environ["MUJOCO_GL"] = "osmesa" if ctypes.util.find_library("OSMesa") else "egl"


def check(given: str) -> None:
    """Raises ValueError where this is no value of ``MUJOCO_GL``."""
    if given.lower() not in (*NONE, *KNOWN):
        raise ValueError(f"MUJOCO_GL: no way to draw is called {given!r}. {did_you_mean(given, KNOWN)}")


def missing(error: Exception) -> ValueError:
    """What to say where drawing failed: each way does so in its own."""
    return ValueError(
        f"expected an OpenGL that draws without a screen, got for MUJOCO_GL={os.environ.get('MUJOCO_GL')}: {error}. "
        "Install OSMesa (libosmesa6 on Debian) and set MUJOCO_GL=osmesa, or set MUJOCO_GL=egl where a GPU's driver or "
        "Mesa has it."
    )
