"""Checkpoints: any pytree of arrays to disk and back, bit for bit, and noticed when it is not.

A checkpoint holds one or more named items (training saves "agent", the train state, apart from "loop", everything
else, so that an evaluation never reads the replay; and "frames", images on the host, if there are any)::

    checkpoints/000000123456/        one checkpoint; the number is the step it was saved at
      manifest.json                  step, score; of each item: the name, shape, dtype and SHA-256
                                     of every array, and where it stands; the SHA-256 of every file; and a
                                     SHA-256 of all that
      agent/  loop/  frames/         the items: the bytes of all arrays one after another in one file, ``arrays``

They are written here, by one thread and with plain system calls, so that whatever a disk refuses comes out as one
error, and nothing is left running. Checkpoints of format 2, whose arrays Orbax wrote, still load: Orbax loads an array
with flipped bits, and casts one of another dtype, without a word, so an item's files are checked against the manifest
before it opens them, its arrays after, and what is to be read is compared with what is expected.

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

import jax
import numpy as np

from ne_dreamer_jax.files import sync_file, write_text
from ne_dreamer_jax.system import memory

MANIFEST = "manifest.json"
FORMAT = 3
READABLE = (2, FORMAT)
ARRAYS = "arrays"
_PARTIAL = ".partial-"
_REPLACED = f"{_PARTIAL}old-"  # where a checkpoint stands while another one of the same step takes its place


class DamagedError(Exception):
    """What was read of a checkpoint is not what was saved."""


class Checkpoint(NamedTuple):
    """One checkpoint on disk, as its manifest describes it."""

    path: Path
    step: int
    score: float | None  # the evaluation return at this step, where there was an evaluation
    items: dict[str, dict[str, dict[str, Any]]]  # item -> name of an array -> shape, dtype, sha256
    files: dict[str, dict[str, str]]  # item -> path of a file in the item's folder -> sha256


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


def nbytes(items: Mapping[str, Any]) -> int:
    """About what the arrays of these items take on disk."""
    return sum(_nbytes(leaf) for leaf in jax.tree.leaves(dict(items)) if hasattr(leaf, "dtype"))


def _nbytes(leaf: Any) -> int:
    if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.extended):
        return 16 * math.prod(leaf.shape)  # keys
    return math.prod(leaf.shape) * leaf.dtype.itemsize


def free_space(directory: Path) -> int:
    """Bytes that are free where a directory is, or will be."""
    existing = next(path for path in [directory, *directory.absolute().parents] if path.exists())
    return shutil.disk_usage(existing).free


def _check_space(directory: Path, items: Mapping[str, Any]) -> None:
    try:
        needed, free = nbytes(items), free_space(directory)
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
        arrays = _flatten(tree)
        places, files[item] = _write_arrays(partial / item, arrays)
        described[item] = {name: _describe(array) | places[name] for name, array in arrays.items()}
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


def _write_arrays(folder: Path, arrays: Mapping[str, Any]) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Writes arrays to one file, and waits until it is on the disk.

    Returns:
      Where each array stands, with its checksum; and name -> checksum of the file.
    """
    folder.mkdir()
    places, whole = {}, hashlib.sha256()
    with (folder / ARRAYS).open("xb") as file:
        for name, array in arrays.items():
            data = _bytes(array)
            places[name] = {"offset": file.tell(), "sha256": hashlib.sha256(data).hexdigest()}
            if _is_key(array):
                places[name]["impl"] = str(jax.random.key_impl(array))
            whole.update(data)
            file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return places, {ARRAYS: whole.hexdigest()}


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
                items[item] = _load(checkpoint, item, tree)
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
    places = {path.name.removeprefix(_REPLACED): path for path in directory.glob(f"{_REPLACED}*")}
    places |= {path.name: path for path in directory.glob("*") if path.name.isdigit()}
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


def _flatten(tree: Any) -> dict[str, Any]:
    """Name -> leaf, such as ``train.params.encoder.conv0.kernel``; names are unique."""
    leaves: dict[str, Any] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator=".") or "value"
        if not (hasattr(leaf, "shape") and hasattr(leaf, "dtype")):
            raise TypeError(f"{name}: expected an array, got {leaf!r} of type {type(leaf).__name__}")
        if name in leaves:
            raise ValueError(f"two leaves are called {name!r}; a key of a mapping holds a dot")
        leaves[name] = leaf
    return leaves


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _data(leaf: Any) -> Any:
    """A typed key's plain uint32 words, and any other array as it is."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _describe(array: Any) -> dict[str, Any]:
    return {"shape": list(array.shape), "dtype": str(array.dtype)}  # a key's dtype names its kind: key<fry>


def _bytes(array: Any) -> memoryview:
    """The array's bytes in C order, of which on a CPU no copy is made."""
    host: Any = np.ascontiguousarray(_data(array))
    return host.reshape(-1).view(np.uint8).data


def _digest_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check_files(checkpoint: Checkpoint, item: str) -> None:
    """Raises DamagedError where a file of the item is gone or not as it was saved; others may lie beside them.

    It comes before Orbax, which reads several arrays at once: when one of them can't be read, it drops the others
    unfinished, and Python warns of those at any time later.
    """
    folder = checkpoint.path / item
    for name, digest in checkpoint.files[item].items():
        try:
            intact = _digest_file(folder / name) == digest
        except OSError as error:
            raise DamagedError(f"{folder} is damaged: {name} can't be read: {error}.") from error
        if not intact:
            raise DamagedError(f"{folder} is damaged: {name} is not as it was saved.")


def check_fit(checkpoint: Checkpoint, item: str, like: Any) -> None:
    """Raises ValueError where an item's arrays have other names, shapes or dtypes than those of a pytree."""
    expected = {name: _describe(leaf) for name, leaf in _flatten(like).items()}
    got = {name: {key: leaf[key] for key in ("shape", "dtype")} for name, leaf in checkpoint.items[item].items()}
    different = [name for name in dict.fromkeys([*expected, *got]) if expected.get(name) != got.get(name)]
    if different:
        lines = [f"{name}: expected {_words(expected.get(name))}, got {_words(got.get(name))}" for name in different]
        more = [f"and {len(lines) - 5} more"] if len(lines) > 5 else []
        raise ValueError(
            f"{checkpoint.path} holds another {item} than this configuration makes in this environment; "
            f"load it with the configuration, and in an environment with the observations and actions, that it was "
            f"saved under.\n  " + "\n  ".join([*lines[:5], *more])
        )


def _words(described: dict[str, Any] | None) -> str:
    return f"{described['dtype']}{described['shape']}" if described else "nothing"


def _load(checkpoint: Checkpoint, item: str, like: Any) -> Any:
    expected = _flatten(like)
    _check_files(checkpoint, item)
    described, folder = checkpoint.items[item], checkpoint.path / item
    read: dict[str, Any] = {
        name: _read_array(folder, leaf) for name, leaf in described.items() if "offset" in leaf or "file" in leaf
    }
    read |= _read_by_orbax(folder, {name: leaf for name, leaf in expected.items() if name not in read})
    leaves = []
    for name, leaf in expected.items():
        saved, array = described[name], read.pop(name)
        if hashlib.sha256(_bytes(array)).hexdigest() != saved["sha256"]:
            raise DamagedError(f"{checkpoint.path}: {item} is damaged: the checksum of {name} does not hold.")
        if not isinstance(leaf, np.ndarray):
            array = _placed(array, _target(leaf).sharding)
        leaves.append(jax.random.wrap_key_data(array, impl=saved["impl"]) if _is_key(leaf) else array)
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _read_array(folder: Path, leaf: Mapping[str, Any]) -> np.ndarray:
    """One array, as numpy's; a key's words. Files of numpy's are of format 2, for what lay on the host."""
    dtype = np.dtype(np.uint32) if "impl" in leaf else jax.numpy.dtype(leaf["dtype"])
    if "file" in leaf:  # the view is for bfloat16, which numpy's files know as two bytes
        return np.load(folder / leaf["file"], allow_pickle=False).view(dtype)
    shape = _key_shape(leaf) if "impl" in leaf else tuple(leaf["shape"])
    return np.fromfile(folder / ARRAYS, dtype, math.prod(shape), offset=leaf["offset"]).reshape(shape)


def _key_shape(leaf: Mapping[str, Any]) -> tuple[int, ...]:
    """Of the words of keys."""
    words = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0, impl=leaf["impl"]))).shape
    return (*leaf["shape"], *words)


def _target(leaf: Any) -> jax.ShapeDtypeStruct:
    """Shape, dtype and place of an array to be read; of a key's words, for a key."""
    data = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
    sharding = None if _is_key(leaf) else getattr(leaf, "sharding", None)
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.ShapeDtypeStruct(data.shape, data.dtype, sharding=sharding or device)


def _placed(array: Any, sharding: Any) -> jax.Array:
    """An array where it belongs; each device gets its share alone."""
    if isinstance(array, jax.Array):
        return array
    return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])


def _read_by_orbax(folder: Path, expected: Mapping[str, Any]) -> dict[str, Any]:
    """The arrays of a checkpoint of format 2; Orbax refused those without elements."""
    targets = {name: _target(leaf) for name, leaf in expected.items()}
    stored = {name: target for name, target in targets.items() if math.prod(target.shape)}
    empty = {
        name: jax.numpy.zeros(target.shape, target.dtype) for name, target in targets.items() if name not in stored
    }
    if not stored:
        return empty
    with _checkpointer() as checkpointer:
        return checkpointer.restore(folder.absolute(), stored) | empty


def _checkpointer() -> Any:
    """Orbax's, of this process alone: it would otherwise wait for all processes of a run."""
    import orbax.checkpoint as ocp

    if jax.process_count() == 1:
        return ocp.StandardCheckpointer()
    own = jax.process_index()
    options = ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
    )
    return ocp.StandardCheckpointer(multiprocessing_options=options)
