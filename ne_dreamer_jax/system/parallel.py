"""Many devices: one mesh axis, ``data``, over environments, replay and batches.

Programs are written for the whole data and compiled for all devices (``jax.jit`` on a mesh). Parameters stand on every
device; what has an axis of environments or of sequences is divided along it. `per_shard` marks what each device does by
itself with its own part. So a run's numbers do not depend on how many devices compute it, but for the order in which
floats are added.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

AXIS = "data"
WHOLE, SPLIT = P(), P(AXIS)
"""Whole on every device; divided along the first axis."""

F = TypeVar("F", bound=Callable[..., Any])
_PIECE = 2**28  # bytes that `gather` takes over at a time


def connect(coordinator: str, processes: int, process: int) -> None:
    """Joins this process with the others of a run; to be called before anything else is asked of JAX.

    Args:
      coordinator: ``host:port``, where process 0 listens.
      processes: how many there are.
      process: which of them this is, counted from 0.
    """
    jax.config.update("jax_cpu_collectives_implementation", "gloo")  # other platforms do not read it
    jax.distributed.initialize(coordinator, processes, process)


def is_main_process() -> bool:
    """Whether this is the process that writes files and speaks to people."""
    return jax.process_index() == 0


def make_mesh(devices: int) -> Mesh:
    """A mesh of so many devices of each process. Raises ValueError where there are fewer."""
    here = jax.local_device_count()
    if not 1 <= devices <= here:
        raise ValueError(
            f"expected 1 to {here} devices, as many as each process has, got {devices}. On a CPU, "
            f"XLA_FLAGS=--xla_force_host_platform_device_count={devices} makes virtual ones"
        )
    of = lambda process: [device for device in jax.devices() if device.process_index == process]
    chosen = [device for process in range(jax.process_count()) for device in of(process)[:devices]]
    return Mesh(np.array(chosen), (AXIS,), axis_types=(AxisType.Auto,))


def traced_on(mesh: Mesh | None, function: F) -> F:
    """The function, with `per_shard` dividing over this mesh wherever the function is traced."""
    if mesh is None:
        return function

    def call(*args: Any) -> Any:
        with jax.sharding.use_abstract_mesh(mesh.abstract_mesh):
            return function(*args)

    return call  # type: ignore[return-value]


def per_shard(function: F, in_specs: Any, out_specs: Any) -> F:
    """The function, applied by each device to its own part where tracing takes place on a mesh, else as it is.

    Args:
      in_specs: for each argument `WHOLE`, `SPLIT` or another partition over `AXIS`; a prefix of its tree.
      out_specs: of the result, likewise.
    """

    def call(*args: Any) -> Any:
        if jax.sharding.get_abstract_mesh().empty:
            return function(*args)
        return jax.shard_map(function, in_specs=in_specs, out_specs=out_specs, check_vma=False)(*args)

    return call  # type: ignore[return-value]


def shardings(mesh: Mesh, specs: Any, tree: Any) -> Any:
    """A sharding for every array of the tree, by specs that are a prefix of it."""
    fill = lambda spec, below: jax.tree.map(lambda _: NamedSharding(mesh, spec), below)
    return jax.tree.map(fill, specs, tree, is_leaf=lambda x: isinstance(x, P))


def place(tree: Any, where: Any) -> Any:
    """Arrays that each process holds whole, moved to these shardings; typed keys included."""

    def put(x: Any, sharding: NamedSharding) -> jax.Array:
        if x.sharding == sharding:
            return x
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(put(jax.random.key_data(x), sharding), impl=jax.random.key_impl(x))
        host = np.asarray(x)
        return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])

    return jax.tree.map(put, tree, where)


def move(tree: Any, like: Any) -> Any:
    """`place`, to where the leaves of ``like`` (``jax.ShapeDtypeStruct``) say; where they don't, nothing moves."""
    where = jax.tree.map(lambda x, to: to.sharding or x.sharding, tree, like)
    return place(tree, where)


def local(tree: Any) -> Any:
    """Arrays that every device holds whole, as this process's first device has them."""
    return jax.tree.map(lambda x: x.addressable_data(0), tree)


def gather(tree: Any) -> Any:
    """Arrays that are divided over processes, whole in the memory of each host; all processes must call it.

    Typed keys stay what they are. Large arrays go in pieces, since each is for a moment whole on every device.
    """

    def whole(x: jax.Array) -> Any:
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(jnp.asarray(whole(jax.random.key_data(x))), impl=jax.random.key_impl(x))
        if x.is_fully_replicated:
            return np.asarray(x.addressable_data(0))
        everywhere = NamedSharding(x.sharding.mesh, WHOLE)  # type: ignore[attr-defined]
        rows = max(1, min(len(x), _PIECE * len(x) // max(x.nbytes, 1)))
        take = jax.jit(lambda x, at: jax.lax.dynamic_slice_in_dim(x, at, rows), out_shardings=everywhere)
        out = np.empty(x.shape, x.dtype)
        for start in range(0, len(x), rows):
            at = min(start, len(x) - rows)
            out[at : at + rows] = take(x, np.int32(at)).addressable_data(0)
        return out

    return jax.tree.map(whole, tree)


def same(text: str) -> bool:
    """Whether all processes hold the same text, by its checksum; all must call it, and all get the same answer."""
    if jax.process_count() == 1:
        return True
    checksum = np.asarray(zlib.crc32(text.encode()), np.uint32)
    everyone = np.asarray(multihost_utils.process_allgather(checksum))
    return bool((everyone == everyone.flat[0]).all())


def agreed(*numbers: int) -> tuple[int, ...]:
    """Small whole numbers as process 0 has them, in every process; all must call it.

    For decisions that hang on a clock, a signal or a file.
    """
    if jax.process_count() == 1:
        return numbers
    return tuple(map(int, multihost_utils.broadcast_one_to_all(np.asarray(numbers, np.int32))))
