"""A pytree's arrays to a folder and back, bit for bit, and noticed when they are not.

The bytes of all arrays stand one after another in one file, ``arrays``. They are written here, by one thread and with
plain system calls, so that whatever a disk refuses comes out as one error, and nothing is left running. Folders of
checkpoints' format 2, whose arrays Orbax wrote, still load: Orbax loads an array with flipped bits, and casts one of
another dtype, without a word, so files are checked before it opens them, arrays after, and what is to be read is
compared with what is expected.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

ARRAYS = "arrays"
"""The file's name."""

Described = dict[str, dict[str, Any]]
"""Name of an array, such as ``params.encoder.conv0.kernel`` -> ``shape``, ``dtype`` and ``sha256``; ``offset``, the
byte of `ARRAYS` at which it begins (in format 2 ``file``, a file of numpy's, or neither, for Orbax); ``impl``, the kind
of typed keys."""
Files = dict[str, str]
"""Name of a file in the folder -> SHA-256."""


class DamagedError(Exception):
    """What was read is not what was saved."""


def write(folder: Path, tree: Any) -> tuple[Described, Files]:
    """Writes a pytree's arrays to a new folder, and waits until they are on the disk.

    Raises:
      OSError: the disk refuses.
      TypeError: a leaf is no array.
      ValueError: two have the same name.
    """
    arrays, described = _flatten(tree), {}
    folder.mkdir()
    whole = hashlib.sha256()
    with (folder / ARRAYS).open("xb") as file:
        for name, array in arrays.items():
            data = _bytes(array)
            place = {"offset": file.tell(), "sha256": hashlib.sha256(data).hexdigest()}
            described[name] = _describe(array) | place
            if _is_key(array):
                described[name]["impl"] = str(jax.random.key_impl(array))
            whole.update(data)
            file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return described, {ARRAYS: whole.hexdigest()}


def read(folder: Path, described: Described, files: Files, like: Any) -> Any:
    """The pytree whose arrays are in a folder.

    Args:
      like: a pytree that `differences` finds to fit, of arrays or `jax.ShapeDtypeStruct`. Arrays go where a leaf's
        sharding says, else to this process's first device, as keys always do; numpy's stay numpy's.

    Raises:
      DamagedError: what is there is not what was written.
    """
    expected = _flatten(like)
    _check_files(folder, files)
    found: dict[str, Any] = {
        name: _read_array(folder, leaf) for name, leaf in described.items() if "offset" in leaf or "file" in leaf
    }
    found |= _read_by_orbax(folder, {name: leaf for name, leaf in expected.items() if name not in found})
    leaves = []
    for name, leaf in expected.items():
        saved, array = described[name], found.pop(name)
        if hashlib.sha256(_bytes(array)).hexdigest() != saved["sha256"]:
            raise DamagedError(f"{folder} is damaged: the checksum of {name} does not hold.")
        if not isinstance(leaf, np.ndarray):
            array = _placed(array, _target(leaf).sharding)
        leaves.append(jax.random.wrap_key_data(array, impl=saved["impl"]) if _is_key(leaf) else array)
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def differences(described: Described, like: Any) -> list[str]:
    """A line for each array that a pytree has under another name, shape or dtype."""
    expected = {name: _describe(leaf) for name, leaf in _flatten(like).items()}
    got = {name: {key: leaf[key] for key in ("shape", "dtype")} for name, leaf in described.items()}
    different = [name for name in dict.fromkeys([*expected, *got]) if expected.get(name) != got.get(name)]
    return [f"{name}: expected {_words(expected.get(name))}, got {_words(got.get(name))}" for name in different]


def nbytes(tree: Any) -> int:
    """About what a pytree's arrays take on disk."""
    return sum(_nbytes(leaf) for leaf in jax.tree.leaves(tree) if hasattr(leaf, "dtype"))


def _nbytes(leaf: Any) -> int:
    if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.extended):
        return 16 * math.prod(leaf.shape)  # keys
    return math.prod(leaf.shape) * leaf.dtype.itemsize


def digest_file(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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


def _check_files(folder: Path, files: Files) -> None:
    """Raises DamagedError where a file is gone or not as it was saved; others may lie beside them.

    It comes before Orbax, which reads several arrays at once: when one of them can't be read, it drops the others
    unfinished, and Python warns of those at any time later.
    """
    for name, digest in files.items():
        try:
            intact = digest_file(folder / name) == digest
        except OSError as error:
            raise DamagedError(f"{folder} is damaged: {name} can't be read: {error}.") from error
        if not intact:
            raise DamagedError(f"{folder} is damaged: {name} is not as it was saved.")


def _words(described: dict[str, Any] | None) -> str:
    return f"{described['dtype']}{described['shape']}" if described else "nothing"


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
