"""What replay pays for an image's place, on the device or on the host: ``python -m benchmarks.storage --help``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import click

from ne_dreamer_jax.system.quiet import quiet


@click.command(context_settings={"max_content_width": 110})
@click.option("--envs", type=click.IntRange(1), default=16, show_default=True)
@click.option(
    "--rows", type=click.IntRange(2), default=2_000, show_default=True, help="Steps kept of each environment."
)
@click.option("--side", type=click.IntRange(1), default=64, show_default=True, help="Of an image, in pixels.")
@click.option("--batch-size", type=click.IntRange(1), default=16, show_default=True)
@click.option("--batch-length", type=click.IntRange(1), default=64, show_default=True)
@click.option("--rounds", type=click.IntRange(1), default=9, show_default=True)
def main(envs: int, rows: int, side: int, batch_size: int, batch_length: int, rounds: int) -> None:
    """Time storing one image of every environment, and fetching a batch, in the device's memory and in the host's."""
    if rows <= batch_length:
        raise click.UsageError(f"--rows: expected more than --batch-length, {batch_length}, got {rows}")
    quiet()
    import jax
    import jax.numpy as jnp

    from benchmarks.common import measure, report
    from ne_dreamer_jax.replay.host_frames import HostFrames
    from ne_dreamer_jax.types import ArraySpec

    shape = (side, side, 3)
    frames = HostFrames(rows, envs, {"image": ArraySpec(shape, jnp.uint8)})
    frames.arrays["image"][...] = 1  # so that every page is there
    images = jax.random.bits(jax.random.key(0), (envs, *shape), jnp.uint8)
    first = jax.random.randint(jax.random.key(1), (2, batch_size, 1), 0, jnp.array([[[rows - batch_length]], [[envs]]]))
    row, env = (
        first[0] + jnp.arange(batch_length, dtype=jnp.int32)[None],
        jnp.broadcast_to(first[1], (batch_size, batch_length)),
    )
    held = {"device": jnp.ones((rows, envs, *shape), jnp.uint8)}

    put = jax.jit(lambda ring, row: jax.lax.dynamic_update_index_in_dim(ring, images, row, 0), donate_argnums=0)
    get = jax.jit(lambda ring: ring.at[row, env].get(mode="promise_in_bounds"))
    host_put = jax.jit(lambda row: frames.put("image", frames.tickets(row), images))
    host_get = jax.jit(partial(frames.get, "image"))

    def put_on_device() -> Any:
        held["device"] = put(held["device"], jnp.zeros((), jnp.int32))
        return held["device"]

    cases: dict[str, Callable[[], Any]] = {
        "store, device": put_on_device,
        "store, host": lambda: host_put(jnp.zeros((), jnp.int32)),
        "fetch, device": lambda: get(held["device"]),
        "fetch, host": lambda: host_get(row * envs + env),
    }
    settings: dict[str, str | int | float | None] = {
        "images": envs,
        "batch": f"{batch_size} x {batch_length}",
        "side": side,
        "rows": rows,
    }
    report("storage", measure(cases, rounds=rounds, warmup=2), settings=settings)


if __name__ == "__main__":
    main()
