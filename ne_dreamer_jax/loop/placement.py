"""Where the arrays of a run lie on a mesh of devices."""

from __future__ import annotations

from typing import Any

from jax.sharding import Mesh

from ne_dreamer_jax.loop.state import LoopState
from ne_dreamer_jax.replay import ring
from ne_dreamer_jax.system import parallel


def shardings(mesh: Mesh, shapes: LoopState) -> LoopState:
    """A sharding for every array: environments and replay are divided over the devices, the rest is whole on each."""
    specs: Any = LoopState(
        train=parallel.WHOLE,
        env=parallel.SPLIT,
        policy=parallel.SPLIT,  # type: ignore[arg-type]
        replay=ring.partition(shapes.replay),
        episodes=parallel.SPLIT,  # type: ignore[arg-type]
        counters=parallel.WHOLE,  # type: ignore[arg-type]
        key=parallel.WHOLE,  # type: ignore[arg-type]
    )
    return parallel.shardings(mesh, specs, shapes)


def check_divisible(mesh: Mesh | None, num_envs: int, batch_size: int) -> int:
    """The number of devices. Raises ValueError where they can't get equal shares."""
    devices = 1 if mesh is None else mesh.size
    for name, count in (("loop.num_envs", num_envs), ("agent.batch_size", batch_size)):
        if count % devices:
            raise ValueError(f"{name}: expected a multiple of the {devices} devices, got {count}.")
    return devices
