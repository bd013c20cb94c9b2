"""Checkpoints: any pytree of arrays to disk and back, bit for bit, and noticed when it is not.

A checkpoint holds one or more named items (training saves "agent", the train state, apart from "loop", everything
else, so that an evaluation never reads the replay; and "frames", images on the host, if there are any)::

    checkpoints/000000123456/        one checkpoint; the number is the step it was saved at
      manifest.json                  step, score; of each item: the name, shape, dtype and SHA-256
                                     of every array, and where it stands; the SHA-256 of every file; and a
                                     SHA-256 of all that
      agent/  loop/  frames/         the items: the bytes of all arrays one after another in one file (`runs.arrays`)

A checkpoint is written beside its place and moved there when it is whole and on disk: what a crash cuts short is never
seen. One that was damaged later is passed over for the one before it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from ne_dreamer_jax.files import sync_file, write_text
from ne_dreamer_jax.runs import arrays
from ne_dreamer_jax.system import memory

MANIFEST = "manifest.json"
FORMAT = 3
READABLE = (2, FORMAT)
_PARTIAL = ".partial-"
_REPLACED = f"{_PARTIAL}old-"  # where a checkpoint stands while another one of the same step takes its place

DamagedError = arrays.DamagedError


class Checkpoint(NamedTuple):
    """One checkpoint on disk, as its manifest describes it."""

    path: Path
    step: int
    score: float | None  # the evaluation return at this step, where there was an evaluation
    items: dict[str, arrays.Described]  # item -> its arrays
    files: dict[str, arrays.Files]  # item -> the files in its folder

    def __repr__(self) -> str:
        items = {item: len(leaves) for item, leaves in self.items.items()}
        return f"Checkpoint({str(self.path)!r}, step={self.step}, score={self.score}, arrays={items})"


class SaveError(Exception):
    """A checkpoint could not be written; the message names the path and the cause."""


class Restored(NamedTuple):
    """What `restore` returns."""

    checkpoint: Checkpoint
    items: dict[str, Any]
    skipped: list[str]  # why checkpoints that came first were passed over, a sentence each
    damaged: list[tuple[Checkpoint, str]]  # of these, those of which an item is damaged, and which


def save(
    directory: Path,
    step: int,
    items: Mapping[str, Any],
    *,
    score: float | None = None,
) -> Checkpoint:
    """Saves pytrees of arrays; returns when they are on disk.

    Args:
      directory: where the checkpoints of a run lie; made if need be. A checkpoint of the same step is replaced.
      step: the step that the items belong to.
      items: name -> pytree whose leaves are arrays; typed PRNG keys are arrays too. Arrays that are divided over
        processes must be gathered first.
      score: the evaluation return at this step, by which `prune` and `restore` find the best.

    Raises:
      TypeError: a leaf that is no array.
      SaveError: the disk is full, read-only, gone or the like; what was saved before stands as it was.
    """
    _check_space(directory, items)
    try:
        return _save(directory, step, items, score)
    except OSError as error:
        cause, name = error.strerror or str(error), error.filename
        place = name if isinstance(name, str) and os.path.isabs(name) else directory  # else a name within a folder
        raise SaveError(f"could not save a checkpoint in {place}: {cause}") from error
    finally:
        with contextlib.suppress(OSError):
            _remove_partial(directory)


def free_space(directory: Path) -> int:
    """Bytes that are free where a directory is, or will be."""
    existing = next(path for path in [directory, *directory.absolute().parents] if path.exists())
    return shutil.disk_usage(existing).free


def _check_space(directory: Path, items: Mapping[str, Any]) -> None:
    try:
        needed, free = arrays.nbytes(dict(items)), free_space(directory)
    except OSError as error:
        raise SaveError(f"could not save a checkpoint in {directory}: {error.strerror or error}") from error
    if needed > free:
        raise SaveError(
            f"could not save a checkpoint in {directory}: it takes up to {memory.readable(needed)}, and "
            f"{memory.readable(free)} are free; make room there"
        )


def _save(directory: Path, step: int, items: Mapping[str, Any], score: float | None) -> Checkpoint:
    directory.mkdir(parents=True, exist_ok=True)
    _remove_partial(directory)
    partial = directory / f"{_PARTIAL}{step:012d}"
    partial.mkdir()
    described, files = {}, {}
    for item, tree in items.items():
        described[item], files[item] = arrays.write(partial / item, tree)
    final = directory / f"{step:012d}"
    score = None if score is None or not math.isfinite(score) else float(score)
    saved = Checkpoint(final, step, score, described, files)
    _write_manifest(partial, saved)
    for path in [*(partial / item for item in items), partial]:
        sync_file(path)
    if final.exists():
        # Aside first, so that at no time a checkpoint stands half removed under its own name. `_find` knows it there.
        final.rename(directory / f"{_REPLACED}{step:012d}")
    partial.rename(final)
    sync_file(directory)
    _remove_partial(directory)
    return saved


def restore(
    directory: Path,
    like: Mapping[str, Any],
    *,
    prefer: Literal["newest", "best"] = "newest",
) -> Restored:
    """Loads items of the newest intact checkpoint that holds them all, or of the one with the best score.

    Args:
      like: item -> pytree of arrays or `jax.ShapeDtypeStruct` (from `jax.eval_shape`): the structure, shapes and
        dtypes to expect. Arrays go where a leaf's sharding says, else to this process's first device, as keys always
        do; numpy's stay numpy's, and can be written to. Only these items are read.
      prefer: what to try first; after the best come the others, newest first.

    Raises:
      FileNotFoundError: no checkpoint holds these items.
      DamagedError: there are some, and none is intact.
      ValueError: an intact one, but of another structure, shape or dtype, with what was expected and what was got.
    """
    found, skipped = _find(directory)
    candidates = [checkpoint for checkpoint in found if set(like) <= set(checkpoint.items)]
    if not candidates and not skipped:
        raise FileNotFoundError(f"{directory} has no checkpoint with {' and '.join(like)}")
    chosen = best(candidates)
    if prefer == "best" and chosen is not None:
        candidates = [chosen, *(checkpoint for checkpoint in candidates if checkpoint is not chosen)]
    damaged: list[tuple[Checkpoint, str]] = []
    for checkpoint in candidates:
        for item, tree in like.items():
            check_fit(checkpoint, item, tree)
        items: dict[str, Any] = {}
        for item, tree in like.items():
            try:
                items[item] = arrays.read(checkpoint.path / item, checkpoint.items[item], checkpoint.files[item], tree)
            except DamagedError as error:
                skipped.append(str(error))
                damaged.append((checkpoint, item))
                break
        else:
            return Restored(checkpoint, items, skipped, damaged)
    raise DamagedError(
        f"no checkpoint in {directory} is intact; to begin anew, choose another directory. {' '.join(skipped)}"
    )


def take_out(found: Checkpoint, item: str, scored: str = "agent") -> None:
    """Takes a damaged item out of a checkpoint, so that nobody counts on it.

    Its files stay as ``damaged-ITEM`` until `prune` comes by.

    Args:
      scored: the item that the score is of; without it the checkpoint has none.

    Raises:
      OSError: the folder can't be written to.
    """
    items = {name: leaves for name, leaves in found.items.items() if name != item}
    files = {name: found.files[name] for name in items}
    _write_manifest(found.path, found._replace(items=items, files=files, score=None if item == scored else found.score))
    aside = found.path / f"damaged-{item}"
    shutil.rmtree(aside, ignore_errors=True)
    if (found.path / item).exists():
        (found.path / item).rename(aside)


def checkpoints(directory: Path) -> list[Checkpoint]:
    """The checkpoints whose manifests are intact, newest first."""
    return _find(directory)[0]


def digest(found: Checkpoint, item: str) -> str:
    """SHA-256 over the names, shapes, dtypes and checksums of all arrays of an item: equal for the same content."""
    leaves = found.items[item]
    return _digest_json(
        {name: {key: leaf[key] for key in ("shape", "dtype", "sha256")} for name, leaf in leaves.items()}
    )


def best(found: Collection[Checkpoint]) -> Checkpoint | None:
    """The checkpoint with the highest score, the earliest of equals; None where none has a score."""
    scored = [(checkpoint.score, -checkpoint.step, checkpoint) for checkpoint in found if checkpoint.score is not None]
    return max(scored, key=lambda entry: entry[:2])[2] if scored else None


def prune(directory: Path, *, whole: Collection[str], keep: int = 2, of_best: Collection[str] = ("agent",)) -> None:
    """Removes all checkpoints but the newest, and of the best, if it is none of them, all items but those named.

    Args:
      whole: the items of a checkpoint from which a run can go on; only such count among the newest.
      keep: how many of the newest stay. Two, so that damage to one costs no more than the steps in between.
      of_best: what stays of the best, for evaluations.
    """
    found = checkpoints(directory)
    chosen = best(found)
    newest = [checkpoint for checkpoint in found if set(whole) <= set(checkpoint.items)][:keep]
    for checkpoint in found:
        if checkpoint in newest:
            continue
        if checkpoint is not chosen:
            _discard(checkpoint.path)
            continue
        for damaged in checkpoint.path.glob("damaged-*"):
            shutil.rmtree(damaged, ignore_errors=True)
        dropped = [item for item in checkpoint.items if item not in of_best]
        if dropped:
            items = {item: leaves for item, leaves in checkpoint.items.items() if item in of_best}
            files = {item: checkpoint.files[item] for item in items}
            _write_manifest(checkpoint.path, checkpoint._replace(items=items, files=files))
        for item in dropped:
            shutil.rmtree(checkpoint.path / item, ignore_errors=True)


def _find(directory: Path) -> tuple[list[Checkpoint], list[str]]:
    found, damaged = [], []
    try:
        paths = list(directory.iterdir())
    except OSError as error:
        if not os.path.lexists(directory):
            return [], []
        # Not to be taken for a folder without checkpoints; a link whose target is not there (yet) isn't one either.
        return [], [f"{directory} can't be read: {error.strerror or error}."]
    places = {path.name.removeprefix(_REPLACED): path for path in paths if path.name.startswith(_REPLACED)}
    places |= {path.name: path for path in paths if path.name.isdigit()}
    for name in sorted(places, reverse=True):
        try:
            found.append(_read_manifest(places[name]))
        except DamagedError as error:
            damaged.append(str(error))
    return found, damaged


def _discard(path: Path) -> None:
    """Removes a checkpoint; renamed first, so that a crash leaves no half of one under its name."""
    aside = path.with_name(f"{_PARTIAL}gone-{path.name}")
    path.rename(aside)
    shutil.rmtree(aside)


def _remove_partial(directory: Path) -> None:
    """Removes what saves and removals that were cut short left; what was to be replaced, and was not, goes back."""
    for path in directory.glob(f"{_PARTIAL}*"):
        place = path.with_name(path.name.removeprefix(_REPLACED))
        if place != path and not place.exists():
            path.rename(place)
        else:
            shutil.rmtree(path)


def _write_manifest(folder: Path, checkpoint: Checkpoint) -> None:
    content = {"format": FORMAT, **checkpoint._asdict()}
    del content["path"]
    text = json.dumps({**content, "sha256": _digest_json(content)}, indent=1)
    write_text(folder / MANIFEST, text, sync=True)


def _read_manifest(folder: Path) -> Checkpoint:
    try:
        content = json.loads((folder / MANIFEST).read_bytes())
        digest = content.pop("sha256")
        if digest != _digest_json(content):
            raise ValueError("its checksum does not hold")
        content.pop("notes", None)  # which version 0.1 wrote
        if (version := content.pop("format")) not in READABLE:
            raise ValueError(f"expected format {FORMAT}, got {version}: another version of this program wrote it")
        found = Checkpoint(folder, **content)
        _check_manifest(found)
        return found
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DamagedError(f"{folder}: {MANIFEST} can't be read: {error!r}.") from error


def _check_manifest(found: Checkpoint) -> None:
    """Raises ValueError for names that lead out of the checkpoint's folder, and for a step or score of another kind."""
    if type(found.step) is not int or not isinstance(found.score, int | float | None):
        raise ValueError(f"expected numbers for step and score, got {found.step!r} and {found.score!r}")
    names = [leaf["file"] for leaves in found.items.values() for leaf in leaves.values() if "file" in leaf]
    for name in [*names, *(name for item in found.files.values() for name in item), *found.items, *found.files]:
        if not name or name.startswith("/") or not {"", ".", ".."}.isdisjoint(name.split("/")):
            raise ValueError(f"expected the name of a file in this folder, got {name!r}")


def _digest_json(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def check_fit(checkpoint: Checkpoint, item: str, like: Any) -> None:
    """Raises ValueError where an item's arrays have other names, shapes or dtypes than those of a pytree."""
    lines = arrays.differences(checkpoint.items[item], like)
    if lines:
        more = [f"and {len(lines) - 5} more"] if len(lines) > 5 else []
        raise ValueError(
            f"{checkpoint.path} holds another {item} than this configuration makes in this environment; "
            f"load it with the configuration, and in an environment with the observations and actions, that it was "
            f"saved under.\n  " + "\n  ".join([*lines[:5], *more])
        )
