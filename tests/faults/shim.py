"""The n-th open, write, sync, rename or mkdir below a directory fails: `build` for the parent, `Shim` for the child.

The library is loaded with ``LD_PRELOAD``, so that what Orbax does in C++ is hit as well as what Python does.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

KINDS = ("open", "write", "sync", "rename", "mkdir")
ERRORS = (errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EDQUOT, errno.EMFILE, errno.ENOENT)
SOURCE = Path(__file__).with_name("shim.c")


def build(directory: Path) -> Path:
    """Compiles the library; skips the test where there is no C compiler, or no Linux."""
    compiler = shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("expected Linux with a C compiler for the library that lets system calls fail")
    library = directory / "shim.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-w", "-o", library, SOURCE, "-ldl"], check=True)
    return library


def environment(library: Path) -> dict[str, str]:
    """For a child process that is to have the library."""
    return {**os.environ, "LD_PRELOAD": str(library), "JAX_PLATFORMS": "cpu", "TF_CPP_MIN_LOG_LEVEL": "3"}


class Shim:
    """The library in this process, which was started with `environment`."""

    def __init__(self, below: Path) -> None:
        self._library = ctypes.CDLL(None)
        self._below = os.fsencode(below)

    @contextlib.contextmanager
    def failing(self, kind: str | None, number: int, error: int, lasting: bool = False) -> Iterator[None]:
        """Within the block, the number-th call of a kind fails; where ``lasting``, all later ones too."""
        which = -1 if kind is None else KINDS.index(kind)
        self._library.fault_arm(self._below, which, number, int(lasting), error)
        try:
            yield
        finally:
            self._library.fault_disarm()

    def counts(self) -> dict[str, int]:
        """How many calls of each kind there were since the block began."""
        return {kind: self._library.fault_count(index) for index, kind in enumerate(KINDS)}

    @property
    def hits(self) -> int:
        """How many calls failed."""
        return self._library.fault_hits()
