"""How an update's cost grows with the batch and the sequences: ``python -m benchmarks.scaling --help``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import click

from ne_dreamer_jax.commands.options import Name, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet


@click.command(context_settings={"max_content_width": 110})
@click.option("--size", type=Name("size", names.SIZES), default="1m", show_default=True)
@click.option(
    "--length", "lengths", type=click.IntRange(2), multiple=True, default=(16, 32, 64, 128), show_default=True
)
@click.option("--batch", "batches", type=click.IntRange(1), multiple=True, default=(8, 16, 32), show_default=True)
@click.option("--actions", type=click.IntRange(1), default=6, show_default=True, help="Size of the continuous action.")
@click.option("--rounds", type=click.IntRange(1), default=3, show_default=True)
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
def main(
    size: str,
    lengths: tuple[int, ...],
    batches: tuple[int, ...],
    actions: int,
    rounds: int,
    assignments: tuple[str, ...],
) -> None:
    """Time the update for every length T with batches of 16, and for every batch B with sequences of 64.

    A cost that is linear in B * T gives the same time for each replayed step everywhere.
    """
    quiet()
    import jax
    import jax.numpy as jnp

    from benchmarks import common
    from experiments.train import configure
    from ne_dreamer_jax.agents import make_agent
    from ne_dreamer_jax.replay import ring as replay
    from ne_dreamer_jax.types import ArraySpec, ContinuousAction, EnvSpec

    spec = EnvSpec({"image": ArraySpec((64, 64, 3), jnp.uint8)}, ContinuousAction(actions))
    with refusing(ValueError):
        config: Any = configure("dmc", size, None, {}, assignments).agent
    sizes = dict.fromkeys([*((16, length) for length in lengths), *((batch, 64) for batch in batches)])
    cases: dict[str, Callable[[], Any]] = {}
    columns: dict[str, dict[str, Any]] = {}

    def case(batch_size: int, length: int) -> Callable[[], Any]:
        agent = make_agent(replace(config, batch_size=batch_size, batch_length=length), spec)
        held: list[Any] = []  # made at the first call; the update donates its state

        def update() -> Any:
            if not held:
                batch = jax.jit(lambda key: replay.random_batch(spec, agent.config, key))(jax.random.key(1))
                held.extend([agent.init(jax.random.key(0)), batch])
            held[0], _, metrics = agent.train_step(held[0], held[1])
            return metrics

        return update

    for batch_size, length in sizes:
        cases[f"{batch_size} x {length}"] = case(batch_size, length)
    measured = common.measure(cases, rounds=rounds)
    for (batch_size, length), (name, timing) in zip(sizes, measured.cases.items(), strict=True):
        columns[name] = {"ms_per_replayed_step": 1e3 * timing.median / (batch_size * length)}
    common.report("scaling", measured, settings={"size": size, "dtype": config.compute_dtype}, columns=columns)


if __name__ == "__main__":
    use_large_pages("benchmarks.scaling")
    main()
