"""What an update of every method costs, in one interleaved run: ``python -m benchmarks.methods --help``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from benchmarks import common
from ne_dreamer_jax.commands.options import Name, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet

METHODS = tuple(name for name in names.METHODS if "/" not in name)


@click.command(context_settings={"max_content_width": 110})
@click.option("--size", "sizes", type=Name("size", names.SIZES), multiple=True, help="May be repeated. Default: 12m.")
@click.option("--method", "methods", type=Name("method", names.METHODS), multiple=True, help="Default: all of them.")
@click.option("--actions", type=click.IntRange(1), default=6, show_default=True, help="Size of the continuous action.")
@click.option("--rounds", type=click.IntRange(1), default=3, show_default=True)
@click.option("--counts", is_flag=True, help="Count parameters only: no compilation, no timing.")
def main(sizes: tuple[str, ...], methods: tuple[str, ...], actions: int, rounds: int, counts: bool) -> None:
    """Time an update of 16 sequences of 64 frames of 64x64x3 pixels, method by method in turns.

    drqv2's is of transitions of 84x84x3 pixels, as published (walker tasks: 512 of them).

    Beside the times stand the parameters by module (and those that no gradient trains, such as a teacher's) and the
    bytes that the compiled update needs besides its arguments.
    """
    quiet()
    for size in sizes or ("12m",):
        with refusing(ValueError):
            made = {method: _make(size, method, actions) for method in methods or METHODS}
        if counts:
            print(f"parameters at {size}, {actions} continuous actions")
            print(common.table([{"method": name, **parameters(agent)} for name, agent in made.items()]))
            continue
        cases, columns = {}, {}
        for name, agent in made.items():
            cases[name], temporary = _update(agent)
            columns[name] = {"temporary_bytes": temporary, **parameters(agent)}
        measured = common.measure(cases, rounds=rounds)
        common.report("methods", measured, settings={"size": size, "actions": actions}, columns=columns)


def parameters(agent: Any) -> dict[str, common.Value]:
    """Number of parameters in all, by module, and of the objective's target."""
    import jax
    import jax.numpy as jnp

    from ne_dreamer_jax.agents.dreamer.agent import parameter_counts

    state = jax.eval_shape(agent.init, jax.random.key(0))
    modules = parameter_counts(state.params)
    target = sum(x.size for x in jax.tree.leaves(state.target) if x.dtype == jnp.float32)
    return {"total": sum(modules.values()), **modules, "target": target}


def _make(size: str, method: str, actions: int) -> Any:
    import jax.numpy as jnp

    from experiments.train import configure
    from ne_dreamer_jax.agents import make_agent
    from ne_dreamer_jax.types import ArraySpec, ContinuousAction, EnvSpec

    config = configure("dmc", size, method, {})
    side = getattr(config.env, "image_size", 64)
    spec = EnvSpec({"image": ArraySpec((side, side, 3), jnp.uint8)}, ContinuousAction(actions))
    return make_agent(config.agent, spec)


def _update(agent: Any) -> tuple[Callable[[], Any], int]:
    """A function that does one update after another on the same batch, and the bytes it needs meanwhile."""
    import jax

    from ne_dreamer_jax.replay import ring as replay

    batch = jax.jit(lambda key: replay.random_batch(agent.spec, agent.config, key))(jax.random.key(1))
    state = agent.init(jax.random.key(0))
    compiled = agent.train_step.lower(state, batch).compile()
    holder = [state]  # an update donates its state

    def update() -> Any:
        holder[0], _, metrics = compiled(holder[0], batch)
        return metrics

    return update, compiled.memory_analysis().temp_size_in_bytes


if __name__ == "__main__":
    use_large_pages("benchmarks.methods")
    main()
