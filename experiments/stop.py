"""Ctrl-C and SIGTERM as a wish to stop where the run can go on from."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType


class Stop:
    """Within the block, the first SIGINT or SIGTERM is kept in `signal`; a second one acts as it always does."""

    def __init__(self, echo: Callable[[str], None]) -> None:
        self.signal: int | None = None
        self._echo = echo

    def __enter__(self) -> Stop:
        self._before = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, _: FrameType | None) -> None:
        self.signal = number
        self._echo("\nStopping when this chunk is done, to save a checkpoint. A second time stops at once, without.")
        self.__exit__()
