"""Where the arrays of a run lie on a mesh of devices."""

from __future__ import annotations

from typing import Any

import jax
from jax.sharding import Mesh

from ne_dreamer_jax.loop.state import LoopState
from ne_dreamer_jax.replay import ring
from ne_dreamer_jax.system import parallel


def shardings(mesh: Mesh, shapes: LoopState) -> LoopState:
    """A sharding for every array: environments and replay are divided over the devices, the rest is whole on each."""
    specs: dict[str, Any] = dict.fromkeys(LoopState._fields, parallel.WHOLE)
    specs |= dict.fromkeys(("env", "episodes"), parallel.SPLIT)
    specs["policy"] = jax.tree.map(lambda x: parallel.SPLIT if x.ndim else parallel.WHOLE, shapes.policy)
    specs["replay"] = ring.partition(shapes.replay)
    return parallel.shardings(mesh, LoopState(**specs), shapes)


def check_divisible(mesh: Mesh | None, num_envs: int, batch_size: int, microbatches: int = 1) -> int:
    """The number of devices. Raises ValueError where they can't get equal shares of environments and microbatches."""
    devices = 1 if mesh is None else mesh.size
    for name, count in (("loop.num_envs", num_envs), ("agent.batch_size", batch_size)):
        if count % devices:
            raise ValueError(f"{name}: expected a multiple of the {devices} devices, got {count}.")
    if batch_size % (devices * microbatches):
        raise ValueError(
            f"agent.microbatches: expected {microbatches} parts of agent.batch_size {batch_size} that the {devices} "
            f"devices divide; with as many devices at most {batch_size // devices} are of use."
        )
    return devices
