"""Losses of an accelerator's program beside the CPU's: ``python -m benchmarks.agreement --help``."""

from __future__ import annotations

import json
from typing import Any

import click

from ne_dreamer_jax.commands.options import Name, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.quiet import quiet


@click.command(context_settings={"max_content_width": 110})
@click.option("--size", type=Name("size", names.SIZES), default="1m", show_default=True)
@click.option("--method", type=Name("method", names.METHODS), default="ne_dreamer", show_default=True)
@click.option("--updates", type=click.IntRange(1), default=5, show_default=True)
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
def main(size: str, method: str, updates: int, assignments: tuple[str, ...]) -> None:
    """The same updates on the default device and on the CPU, and by how much their losses differ.

    Where there is no accelerator, its program (XLA's own convolutions and batched products) runs on the CPU.
    """
    quiet()
    import jax
    import numpy as np

    from benchmarks import common
    from experiments.train import configure
    from ne_dreamer_jax.nets.platform import traced_for

    with refusing(ValueError):
        run = configure("dmc", size, method, {}, assignments)
    accelerator = jax.default_backend()
    try:
        cpu = jax.local_devices(backend="cpu")[0]
    except RuntimeError as error:
        raise click.UsageError(
            "expected JAX's cpu platform beside the accelerator's, as JAX_PLATFORMS=cuda,cpu"
        ) from error
    with traced_for("cuda" if accelerator == "cpu" else accelerator):
        here = _losses(run, updates, jax.devices()[0])
    with traced_for("cpu"):
        there = _losses(run, updates, cpu)
    rows: list[dict[str, Any]] = []
    for name in sorted(here[0]):
        a, b = (np.array([losses[name] for losses in each]) for each in (here, there))
        worst = float(np.max(np.abs(a - b) / np.maximum(np.abs(b), 1e-6)))
        rows.append({"loss": name, "first": float(b[0]), "last": float(b[-1]), "largest_relative_difference": worst})
    print(f"agreement: {method}, {size}, {updates} updates")
    print(f"on {common.machine()}\n")
    print(common.table(rows))
    settings = {"size": size, "method": method, "updates": updates}
    print(
        "\n" + json.dumps({"benchmark": "agreement", "machine": common.machine(), "settings": settings, "rows": rows})
    )


def _losses(run: Any, updates: int, device: Any) -> list[dict[str, float]]:
    """The losses of so many updates from the first state, on one batch."""
    import jax

    from benchmarks import training
    from ne_dreamer_jax.agents import make_agent
    from ne_dreamer_jax.replay import ring

    spec = training.pixels(run)
    with jax.default_device(device):
        agent = make_agent(run.agent, spec)
        state = agent.init(jax.random.key(0))
        batch = jax.jit(lambda key: ring.random_batch(spec, run.agent, key))(jax.random.key(1))
        found = []
        for _ in range(updates):
            state, _, metrics = agent.train_step(state, batch)
            found.append({name: float(value) for name, value in metrics.items() if name.startswith("loss")})
    return found


if __name__ == "__main__":
    main()
