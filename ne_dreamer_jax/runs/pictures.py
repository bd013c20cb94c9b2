"""Pictures of a run are for looking at: one that can't be drawn costs nothing but itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def attempt(draw: Callable[[], None], path: Path, echo: Callable[[str], None]) -> bool:
    """Draws a picture or video; where that fails, a line says what is missing and why, and all else goes on.

    Args:
      draw: writes ``path``, and does nothing but that: matplotlib, ffmpeg and the disk fail in many ways, and any of
        them is told, none raised.
      path: of the picture, for the line.
      echo: takes the line.

    Returns:
      Whether it was drawn.
    """
    try:
        draw()
    except Exception as error:
        reason = " ".join(str(error).split())
        echo(f"Could not draw {path}: {reason or type(error).__name__}. Nothing else depends on it.")
        return False
    return True
