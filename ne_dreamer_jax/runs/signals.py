"""Ctrl-C, SIGTERM and a terminal that is closed as a wish to stop where the run can go on from."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
GRACE = 0.5
"""Seconds that the main thread has to leave by itself after a second signal."""
TOGETHER = 0.1
"""Signals within so many seconds are one: GNU timeout sends its own twice, to the process and to its group."""


class Stop:
    """Within the block, the first SIGINT, SIGTERM or SIGHUP is kept in `signal`.

    A second SIGINT or SIGTERM acts as it always does; where the main thread does not come to that within `GRACE`, since
    it compiles or computes, the process ends there and then, with 128 + the signal's number, but for one in which
    somebody types. A second SIGHUP is none's wish, as a terminal that is closed sends several. A signal that was
    ignored before (``nohup``, a job in a script's background) stays ignored. Python hears of signals in its main thread
    alone: in another one, nothing changes.
    """

    def __init__(self, echo: Callable[[str], None]) -> None:
        self.signal: int | None = None
        self._twice = False  # whether a second one has come, as the watcher has it
        self._echo = echo
        self._entered = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Stop:
        if threading.current_thread() is not threading.main_thread():
            return self
        self._entered = True
        heeded = [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
        self._before = {number: signal.signal(number, self._ask) for number in heeded}
        self._over = threading.Event()
        self._woken, waking = socket.socketpair()
        self._waking = waking
        waking.setblocking(False)
        self._wakeup_before = signal.set_wakeup_fd(waking.fileno(), warn_on_full_buffer=False)
        self._watcher = threading.Thread(target=self._watch, name="signals", daemon=True)
        self._watcher.start()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._entered:
            return
        self._over.set()
        signal.set_wakeup_fd(self._wakeup_before)
        self._waking.close()  # which ends the watcher
        self._watcher.join()
        self._woken.close()
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, _: FrameType | None) -> None:
        """In the main thread, as soon as it runs Python again."""
        if self.signal is not None:
            if self._is_second():
                signal.signal(number, self._before[signal.Signals(number)])
                signal.raise_signal(number)
            return
        self.signal = number
        if signal.SIGHUP in self._before:
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with contextlib.suppress(RuntimeError):  # it came in the middle of another line
            self._echo(
                "\nStopping when this chunk, or its compilation, is done, to save a checkpoint. A second time stops at "
                "once, without."
            )

    def _is_second(self) -> bool:
        """Whether a signal is a second wish: by when it came, which the watcher knows, not by when it is heard here."""
        for _ in range(20):
            if self._twice:
                return True
            time.sleep(0.005)  # the watcher may not have been told yet
        return False

    def _watch(self) -> None:
        """In a thread of its own, which hears of signals while the main thread is in a library."""
        first: float | None = None
        while received := self._woken.recv(16):
            for number in received:
                if number not in self._before:
                    continue
                now = time.monotonic()
                if first is None:
                    first = now
                if number == signal.SIGHUP or now - first <= TOGETHER:
                    continue
                self._twice = True
                typed = number == signal.SIGINT and hasattr(sys, "ps1")
                if not typed and not self._over.wait(GRACE):
                    os._exit(128 + number)
