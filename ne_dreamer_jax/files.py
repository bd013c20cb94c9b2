"""Files that are replaced whole: whatever happens meanwhile, a reader finds the old one or the new one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: Path, sync: bool = False) -> Iterator[Path]:
    """A path beside ``path`` to write to; at the end of the block it takes the place of ``path``.

    Its name ends as that of ``path``, by which some programs tell formats apart. After an error nothing is left of it.

    Args:
      sync: whether it is on the disk before it takes the place.
    """
    beside = path.with_name("partial-" + path.name)
    beside.unlink(missing_ok=True)
    try:
        yield beside
        if sync:
            sync_file(beside)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def write_text(path: Path, text: str, sync: bool = False) -> None:
    """Replaces a file of text in UTF-8."""
    with replacing(path, sync) as beside:
        beside.write_text(text, encoding="utf-8")


def sync_file(path: Path) -> None:
    """Waits until a file, or a directory's list of names, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
