"""What an update tells other devices, and what it should cost on GPUs: ``python -m benchmarks.devices --help``.

Nothing is run: figures come from the compiled programs, and times are computed from a GPU's data sheet.
"""

from __future__ import annotations

import json
import os
import re
from typing import Any

import click

from ne_dreamer_jax.commands.options import Name, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.quiet import quiet

_BYTES = {"pred": 1, "u8": 1, "s8": 1, "bf16": 2, "f16": 2, "u16": 2, "f32": 4, "s32": 4, "u32": 4, "f64": 8}
_COLLECTIVE = re.compile(
    r"= (?P<result>.*?) (?P<kind>all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter)(-start)?\("
)


@click.command(context_settings={"max_content_width": 110})
@click.option("--size", type=Name("size", names.SIZES), default="12m", show_default=True)
@click.option("--devices", type=click.IntRange(2), default=8, show_default=True)
@click.option("--tflops", type=float, default=400.0, show_default=True, help="Of a GPU's matrix products, attainable.")
@click.option("--memory-gb-s", type=float, default=3_350.0, show_default=True, help="Of a GPU's memory.")
@click.option("--link-gb-s", type=float, default=450.0, show_default=True, help="From a GPU to the others.")
@click.option("--gflop", type=float, default=952.0, show_default=True, help="Arithmetic of an update of this size.")
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
def main(
    size: str,
    devices: int,
    tflops: float,
    memory_gb_s: float,
    link_gb_s: float,
    gflop: float,
    assignments: tuple[str, ...],
) -> None:
    """The collectives of an update that is divided over virtual devices, and its roofline on GPUs, computed."""
    quiet()
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={devices}".strip()
    import jax

    from benchmarks import common
    from experiments.train import configure
    from ne_dreamer_jax.system import parallel

    with refusing(ValueError):
        config = configure("dmc", size, None, {}, assignments).agent
        mesh = parallel.make_mesh(devices)
    compiled = _compiled(config, mesh)
    found: dict[str, list[int]] = {}
    for line in compiled.as_text().splitlines():
        match = _COLLECTIVE.search(line)
        if match:
            found.setdefault(match["kind"], []).append(result_bytes(match["result"]))
    rows: list[dict[str, Any]] = [
        {"collective": kind, "count": len(sizes), "megabytes": sum(sizes) / 1e6, "largest": max(sizes) / 1e6}
        for kind, sizes in sorted(found.items(), key=lambda item: -sum(item[1]))
    ]
    sent = sum(row["megabytes"] for row in rows) * 1e6
    accessed = compiled.cost_analysis().get("bytes accessed", 0.0)
    ring = 2 * (devices - 1) / devices  # an all-reduce sends every byte about twice
    computed = {
        "update_on_1_gpu_ms": 1e3 * max(gflop / tflops / 1e3, devices * accessed / memory_gb_s / 1e9),
        f"update_on_{devices}_gpus_ms": 1e3
        * (max(gflop / devices / tflops / 1e3, accessed / memory_gb_s / 1e9) + ring * sent / link_gb_s / 1e9),
    }
    print(
        f"devices: one update of {size} on {devices} virtual devices, jax {jax.__version__}; in the compiled program\n"
    )
    print(common.table(rows))
    print("\ncomputed, not measured, from the figures given and the bytes that XLA counts for each device:")
    for name, value in computed.items():
        print(f"  {name} {value:.3g}")
    print("\n" + json.dumps({"benchmark": "devices", "size": size, "devices": devices, "rows": rows, **computed}))


def _compiled(config: Any, mesh: Any) -> Any:
    """The update, compiled for a mesh."""
    import jax
    import jax.numpy as jnp

    from ne_dreamer_jax.agents import make_agent
    from ne_dreamer_jax.replay import ring as replay
    from ne_dreamer_jax.system import parallel
    from ne_dreamer_jax.types import ArraySpec, ContinuousAction, EnvSpec

    spec = EnvSpec({"image": ArraySpec((64, 64, 3), jnp.uint8)}, ContinuousAction(6))
    agent = make_agent(config, spec)
    state = jax.eval_shape(agent.init, jax.random.key(0))
    batch = jax.eval_shape(lambda key: replay.random_batch(spec, config, key), jax.random.key(0))

    def on(tree: Any, where: Any) -> Any:
        places = parallel.shardings(mesh, where, tree)
        return jax.tree.map(lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), tree, places)

    update = jax.jit(
        parallel.traced_on(mesh, agent.train_step),
        donate_argnums=0,
        out_shardings=parallel.shardings(
            mesh, (parallel.WHOLE, parallel.SPLIT, parallel.WHOLE), _results(agent, state, batch)
        ),
    )
    return update.lower(on(state, parallel.WHOLE), on(batch, parallel.SPLIT)).compile()


def _results(agent: Any, state: Any, batch: Any) -> Any:
    import jax

    return jax.eval_shape(agent.train_step, state, batch)


def result_bytes(text: str) -> int:
    """Bytes of the arrays in an HLO result type, such as ``(f32[8,4]{1,0}, u8[3]{0})``."""
    total = 0
    for kind, dims in re.findall(r"(\w+)\[([\d,]*)\]", text):
        count = 1
        for side in filter(None, dims.split(",")):
            count *= int(side)
        total += count * _BYTES.get(kind, 4)
    return total


if __name__ == "__main__":
    main()
