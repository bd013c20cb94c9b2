"""Ctrl-C, SIGTERM and a terminal that is closed as a wish to stop where the run can go on from."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stop:
    """Within the block, the first SIGINT, SIGTERM or SIGHUP is kept in `signal`.

    A second SIGINT or SIGTERM acts as it always does. A second SIGHUP is none's wish, as a terminal that is closed
    sends several. A signal that was ignored before (``nohup``, a job in a script's background) stays ignored.
    """

    def __init__(self, echo: Callable[[str], None]) -> None:
        self.signal: int | None = None
        self._echo = echo

    def __enter__(self) -> Stop:
        heeded = [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
        self._before = {number: signal.signal(number, self._ask) for number in heeded}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, _: FrameType | None) -> None:
        self.signal = number
        for other, handler in self._before.items():
            signal.signal(other, signal.SIG_IGN if other == signal.SIGHUP else handler)
        with contextlib.suppress(RuntimeError):  # it came in the middle of another line
            self._echo(
                "\nStopping when this chunk is done, to save a checkpoint. A second time stops at once, without."
            )
