"""JAX's persistent compilation cache, on by default, in a folder that only its user can write to.

What is in the cache is run as machine code, so a folder that others may write to is not used. Programs compiled for
one processor may not run on another, which matters where a home directory is shared: each kind has a folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import stat
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.monitoring

SWITCH = "NE_DREAMER_JAX_CACHE"
_HIT = "/jax/compilation_cache/cache_hits"


def enable() -> str:
    """Turns the cache on for this process; call before anything compiles.

    The folder is ``$JAX_COMPILATION_CACHE_DIR`` where that is set, else ``ne_dreamer_jax`` in ``$XDG_CACHE_HOME`` or
    ``~/.cache``. ``NE_DREAMER_JAX_CACHE=off`` leaves the cache off.

    Returns:
      A few words on where the cache is, or why it is off.
    """
    if os.environ.get(SWITCH, "").lower() in ("off", "0", "false", "no"):
        return f"off ({SWITCH}={os.environ[SWITCH]})"
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if chosen:
        return f"{chosen} (JAX_COMPILATION_CACHE_DIR)"
    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ne_dreamer_jax"
        folder = base / _machine()
        for path in (base, folder):
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            status = path.stat()
            if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o022:
                return f"off: {path} belongs to someone else, or others may write to it; chmod 700 it, or remove it"
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home directory
        return f"off: {error}"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    return str(folder)


@contextlib.contextmanager
def hits() -> Iterator[list[str]]:
    """Within the block, the list gets an entry for each program that comes out of the cache."""
    found: list[str] = []

    def listen(event: str, **_: str | int) -> None:
        if event == _HIT:
            found.append(event)

    jax.monitoring.register_event_listener(listen)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_listener(listen)


def _machine() -> str:
    features = ""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        features = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    kind = f"{platform.machine()} {platform.processor()} {features}"
    return f"{platform.machine()}-{hashlib.sha256(kind.encode()).hexdigest()[:8]}"
