"""What several runs at once cost beside one: ``python -m benchmarks.seeds --help``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from ne_dreamer_jax.commands.options import Name, Task, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet


@click.command(context_settings={"max_content_width": 110})
@click.option("--seeds", "counts", type=click.IntRange(1), multiple=True, default=(1, 4), show_default=True)
@click.option("--preset", type=Name("preset", names.PRESETS), default="quickstart", show_default=True)
@click.option("--task", type=Task(), default="dmc/cartpole_swingup", show_default=True)
@click.option("--steps", type=click.IntRange(1), default=8, show_default=True, help="Vector steps of a timed chunk.")
@click.option("--rounds", type=click.IntRange(1), default=5, show_default=True)
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
def main(
    counts: tuple[int, ...], preset: str, task: str, steps: int, rounds: int, assignments: tuple[str, ...]
) -> None:
    """A training chunk of one run, and of several under vmap (`loop.over_seeds`); updates a second over all of them."""
    quiet()
    from benchmarks import common
    from experiments.train import configure

    with refusing(ValueError):
        config = configure(preset, None, None, {"env.task": task}, assignments)
    updates: dict[str, int] = {}
    cases = {f"{count} seeds": _chunk(config, count, steps, updates) for count in dict.fromkeys(counts)}
    measured = common.measure(cases, rounds=rounds)
    columns: dict[str, dict[str, Any]] = {
        name: {"updates_per_s": updates[name] / timing.median} for name, timing in measured.cases.items()
    }
    common.report("seeds", measured, settings={"preset": preset, "task": task, "vector_steps": steps}, columns=columns)


def _chunk(config: Any, count: int, steps: int, updates: dict[str, int]) -> Callable[[], Any]:
    """A function that goes on with training; it notes how many updates that was."""
    import jax
    import jax.numpy as jnp

    from benchmarks import training
    from ne_dreamer_jax import loop as loops
    from ne_dreamer_jax.envs import config as env_configs

    loop = training.make_loop(config, env_configs.make(config.env))
    init, chunk = loops.over_seeds(loop)
    go_on = training.chunks(loop, lambda: init(jax.vmap(jax.random.key)(jnp.arange(count))), chunk, steps)

    def case() -> Any:
        report = go_on()
        updates[f"{count} seeds"] = int(report.updates.sum())
        return report

    return case


if __name__ == "__main__":
    use_large_pages("benchmarks.seeds")
    main()
