"""Large pages of memory for what an update allocates, of which the C library must know before a program starts."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

TUNABLE = "glibc.malloc.hugetlb"
_SYSTEM = Path("/sys/kernel/mm/transparent_hugepage/enabled")


def use_large_pages() -> None:
    """Starts this command anew with ``GLIBC_TUNABLES=glibc.malloc.hugetlb=1``, where that is of use.

    On a CPU every update takes a gigabyte or more from the system and gives it back; in pages of 4 KiB that is a tenth
    of its time. To be called first by a module that was started as a command. It does nothing where the tunable has
    been given (0 turns it off), on other systems than Linux with glibc 2.35 or newer, and where the system hands out
    large pages anyhow, or never.
    """
    given = os.environ.get("GLIBC_TUNABLES", "")
    if TUNABLE in given or not sys.executable or not _of_use():
        return
    os.environ["GLIBC_TUNABLES"] = ":".join(filter(None, (given, f"{TUNABLE}=1")))
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _of_use() -> bool:
    if sys.platform != "linux":
        return False
    try:
        library, enabled = os.confstr("CS_GNU_LIBC_VERSION") or "", _SYSTEM.read_text()
    except (OSError, ValueError):  # another C library; no such file
        return False
    version = re.fullmatch(r"glibc (\d+)\.(\d+).*", library)
    return version is not None and tuple(map(int, version.groups())) >= (2, 35) and "[madvise]" in enabled
