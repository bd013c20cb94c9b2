"""Large pages of memory for what an update allocates, of which the C library must know before a program starts."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from pathlib import Path

TUNABLE = "glibc.malloc.hugetlb"
_SYSTEM = Path("/sys/kernel/mm/transparent_hugepage/enabled")
_MARK = "large_pages"  # an option -X of the interpreter: it stays where a wrapper clears the environment


def use_large_pages(module: str) -> None:
    """Starts the command ``python -m MODULE ...`` anew with ``GLIBC_TUNABLES=glibc.malloc.hugetlb=1``, if of use.

    On a CPU every update takes a gigabyte or more from the system and gives it back; in pages of 4 KiB that is a tenth
    of its time. For a module's ``if __name__ == "__main__"``, before anything is done; processes that it starts inherit
    the variable. Nothing happens where the tunable has been given (0 turns it off), where the process was started in
    another way or is watched by a debugger or profiler, on other systems than Linux with glibc 2.35 or newer, and where
    the system hands out large pages anyhow, or never.
    """
    given = os.environ.get("GLIBC_TUNABLES", "")
    if TUNABLE in given or _MARK in sys._xoptions or not _is_command(module) or not _of_use():
        return
    os.environ["GLIBC_TUNABLES"] = ":".join(filter(None, (given, f"{TUNABLE}=1")))
    with contextlib.suppress(OSError):  # then it goes on as it is
        os.execv(sys.executable, [sys.executable, "-X", _MARK, *sys.orig_argv[1:]])
    os.environ["GLIBC_TUNABLES"] = given


def _is_command(module: str) -> bool:
    """Whether this process is ``python -m module``, and nothing but that."""
    watched = sys.gettrace() is not None or sys.getprofile() is not None
    return bool(sys.executable) and sys.orig_argv[1:3] == ["-m", module] and not watched


def _of_use() -> bool:
    if sys.platform != "linux":
        return False
    try:
        library, enabled = os.confstr("CS_GNU_LIBC_VERSION") or "", _SYSTEM.read_text()
    except (OSError, ValueError, AttributeError):  # another C library; no such file
        return False
    version = re.fullmatch(r"glibc (\d+)\.(\d+).*", library)
    return version is not None and tuple(map(int, version.groups())) >= (2, 35) and "[madvise]" in enabled
