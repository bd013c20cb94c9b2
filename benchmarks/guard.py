"""What it costs to check that an update's numbers are finite: ``python -m benchmarks.guard --help``."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import click

from ne_dreamer_jax.commands.options import Name
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet


@click.command(context_settings={"max_content_width": 110})
@click.option("--preset", type=Name("preset", names.PRESETS), default="quickstart", show_default=True)
@click.option("--size", type=Name("size", names.SIZES), help="Default: the preset's.")
@click.option("--updates", type=click.IntRange(1), default=4, show_default=True, help="Of one timing.")
@click.option("--rounds", type=click.IntRange(2), default=30, show_default=True, help="Pairs of timings.")
def main(preset: str, size: str | None, updates: int, rounds: int) -> None:
    """Updates with the check and without, in pairs that alternate which is first, and the median ratio of the pairs."""
    quiet()
    from benchmarks import common
    from ne_dreamer_jax import config as presets

    config = presets.preset(preset, size)
    case, plain = _updates(config, updates, checked=True), _updates(config, updates, checked=False)
    for one in (case, plain):
        common.seconds(one)
    pairs = []
    for index in range(rounds):
        both = (case, plain) if index % 2 else (plain, case)
        seconds = {one: common.seconds(one) for one in both}
        pairs.append((seconds[case], seconds[plain]))
    ratios = sorted(a / b for a, b in pairs)
    each = statistics.median(b for _, b in pairs) / updates
    print(f"{preset}{f' {size}' if size else ''}: {1e3 * each:.1f} ms an update, on {common.machine()}")
    low, high = ratios[rounds // 4], ratios[-1 - rounds // 4]
    print(
        f"with the check {statistics.median(ratios):.4f} times that ({low:.4f} to {high:.4f}: half of {rounds} pairs)"
    )


def _updates(config: Any, updates: int, checked: bool) -> Callable[[], Any]:
    """A function that goes on training on one random batch."""
    from unittest import mock

    import jax
    import jax.numpy as jnp

    import ne_dreamer_jax as nedreamer
    from ne_dreamer_jax.agents import guard
    from ne_dreamer_jax.envs import config as env_configs

    agent = nedreamer.make_agent(config.agent, env_configs.make(config.env).spec)
    batch = nedreamer.replay.random_batch(agent.spec, config.agent, jax.random.key(1))
    held = [agent.init(jax.random.key(0))]
    if checked:
        compiled = agent.train_step.lower(held[0], batch).compile()
    else:
        nothing = lambda losses, gradients: (True, {guard.SKIPPED: jnp.zeros(())})
        always = lambda finite, update, state, *operands: update(state, *operands)
        with mock.patch.multiple(guard, check=nothing, update_if=always):
            compiled = agent.train_step.lower(held[0], batch).compile()

    def run() -> Any:
        for _ in range(updates):
            held[0], _, _ = compiled(held[0], batch)
        return held[0]

    return run


if __name__ == "__main__":
    use_large_pages("benchmarks.guard")
    main()
