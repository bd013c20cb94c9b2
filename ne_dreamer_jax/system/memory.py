"""How much memory there is, so that what would not fit is refused before it is allocated."""

from __future__ import annotations

import os
from pathlib import Path

import jax


def available(device: jax.Device | None = None) -> int:
    """Bytes that can still be allocated on a device (default: the first local one).

    An accelerator answers for itself. For the CPU it is what the system has left, or the limit of the container.
    """
    device = jax.local_devices()[0] if device is None else device
    stats = None if device.platform == "cpu" else device.memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] - stats["bytes_in_use"]
    return host_available()


def readable(size: int) -> str:
    """A number of bytes with a unit: ``12.3 GiB``."""
    value = float(size)
    for unit in ("B", "KiB", "MiB", "GiB"):
        if value < 1024:
            return f"{value:.{0 if unit == 'B' else 1}f} {unit}"
        value /= 1024
    return f"{value:.1f} TiB"


def host_available(root: Path = Path("/")) -> int:
    """Bytes a process on this host can still allocate; ``root`` is where its ``proc`` and ``sys`` are mounted."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    meminfo = root / "proc/meminfo"
    if meminfo.exists():
        fields = dict(line.split(":") for line in meminfo.read_text().splitlines())
        limits.append(int(fields["MemAvailable"].split()[0]) * 1024)
    # The limit alone, not what is left of it: the usage counts the page cache, which gives way.
    for limit in ("memory.max", "memory/memory.limit_in_bytes"):  # control groups of version 2 and 1
        path = root / "sys/fs/cgroup" / limit
        if path.exists() and (text := path.read_text().strip()) != "max":
            limits.append(int(text))
    return min(limits)
