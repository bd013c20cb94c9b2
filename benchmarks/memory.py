"""What every size needs in memory, as predicted and as compiled: ``python -m benchmarks.memory --help``."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import click

from ne_dreamer_jax.commands.options import Name, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.quiet import quiet

FRAMES = 5_000_000  # the paper's replay


@click.command(context_settings={"max_content_width": 110})
@click.option("--size", "sizes", type=Name("size", names.SIZES), multiple=True, default=names.SIZES, show_default=True)
@click.option("--task", default="dmc/walker_walk", show_default=True, help="Whose frames and actions are stored.")
@click.option("--compile/--no-compile", "compiles", default=True, show_default=True, help="Measure the update too.")
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
def main(sizes: tuple[str, ...], task: str, compiles: bool, assignments: tuple[str, ...]) -> None:
    """Bytes of the agent's state, of an update and of replay, for the dmc preset at every size.

    What an update works in is measured as XLA's temporary memory, and its peak as that with state and batch. Nothing is
    run.
    """
    quiet()
    from benchmarks import common
    from experiments.train import configure

    rows = []
    for size in dict.fromkeys(sizes):
        with refusing(ValueError):
            rows.append(_row(configure("dmc", size, None, {"env.task": task}, assignments), size, compiles))
            click.echo(f"{size}: done", err=True)
    print(f"memory: {task}, batches of the dmc preset; bytes in GB\n")
    rows = [{name: x / 1e9 if name.endswith("_gb") else x for name, x in row.items()} for row in rows]
    print(common.table(rows))
    print("\n" + json.dumps({"benchmark": "memory", "machine": common.machine(), "task": task, "rows": rows}))


def _row(config: Any, size: str, compiles: bool) -> dict[str, Any]:
    import jax

    import ne_dreamer_jax as nedreamer
    from ne_dreamer_jax import loop as loops
    from ne_dreamer_jax.agents.dreamer.agent import parameter_counts
    from ne_dreamer_jax.loop.budget import PAPER_CAPACITY
    from ne_dreamer_jax.replay import ring as replay

    options, limits = config.env, config.loop
    env = nedreamer.envs.make(options.task, action_repeat=options.action_repeat, image_size=options.image_size)
    agent = nedreamer.make_agent(config.agent, env.spec)
    state = jax.eval_shape(agent.init, jax.random.key(0))
    row: dict[str, Any] = {
        "size": size,
        "parameters": sum(parameter_counts(state.params).values()),
        "state_gb": _bytes(state),
        "working_predicted_gb": agent.working_bytes(state.params),
    }
    if compiles:
        batch = jax.eval_shape(lambda key: replay.random_batch(env.spec, config.agent, key), jax.random.key(0))
        jitted: Any = agent.train_step
        used = jitted.lower(state, batch).compile().memory_analysis()
        inputs = used.argument_size_in_bytes + used.output_size_in_bytes - used.alias_size_in_bytes
        row |= {"working_gb": used.temp_size_in_bytes, "update_gb": inputs + used.temp_size_in_bytes}

    def per_step(**changes: Any) -> float:
        """Bytes of a transition in replay."""
        small = replace(limits, capacity=(config.agent.batch_length + 1) * limits.num_envs, **changes)
        loop = loops.make(small, env, agent, options.action_repeat)
        return loop.replay_bytes / loop.budget.capacity

    steps = limits.capacity or min(PAPER_CAPACITY, limits.env_steps // options.action_repeat)
    return row | {
        "replay_gb": steps * per_step(),
        "pixels_5e6_gb": FRAMES * per_step(storage="pixels"),
        "states_5e6_gb": FRAMES * per_step(storage="states"),
        "states_half_5e6_gb": FRAMES * per_step(storage="states", latent_dtype="bfloat16"),
    }


def _bytes(tree: Any) -> int:
    """Of all arrays; the key counts as its two words."""
    import jax

    sizes = [
        8 if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x.dtype.itemsize for x in jax.tree.leaves(tree)
    ]
    return sum(x.size * size for x, size in zip(jax.tree.leaves(tree), sizes, strict=True))


if __name__ == "__main__":
    main()
