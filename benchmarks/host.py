"""What environments in worker processes cost beside those in the program: ``python -m benchmarks.host --help``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import click

from ne_dreamer_jax.commands.options import Task, refusing
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet


@click.command(context_settings={"max_content_width": 110})
@click.option("--device", type=Task(), default="dmc/cartpole_balance", show_default=True, help="In the program.")
@click.option("--host", type=Task(), default="dm_control:cartpole_balance", show_default=True, help="In workers.")
@click.option("--envs", "counts", type=click.IntRange(1), multiple=True, default=(1, 4, 16), show_default=True)
@click.option("--obs", default="vector", show_default=True)
@click.option("--replay-ratio", type=click.FloatRange(0, min_open=True), default=32.0, show_default=True)
@click.option("--steps", type=click.IntRange(1), default=32, show_default=True, help="Agent steps of one environment.")
@click.option("--rounds", type=click.IntRange(1), default=5, show_default=True)
def main(
    device: str, host: str, counts: tuple[int, ...], obs: str, replay_ratio: float, steps: int, rounds: int
) -> None:
    """Agent steps a second of a training chunk in the quickstart's setting, and of acting at random alone.

    Of the workers' environments twice: stepped while the agent learns, as in training, and after it has learned.
    """
    quiet()
    from benchmarks import common, rollout
    from experiments.train import configure
    from ne_dreamer_jax.envs import config as env_configs
    from ne_dreamer_jax.envs.vector import as_vector

    cases: dict[str, Callable[[], Any]] = {}
    agent_steps: dict[str, int] = {}
    pools = []
    for n in dict.fromkeys(counts):
        for name, task in {"program": device, "workers": host}.items():
            changes = [f"loop.num_envs={n}", f"loop.replay_ratio={replay_ratio}", "loop.prefill=320", f"env.obs={obs}"]
            with refusing(ValueError):
                config = configure("quickstart", "1m", None, {"env.task": task}, changes)
                env = as_vector(env_configs.make(config.env))
            if env.host is not None:
                pools.append(env.host)
                cases[f"workers, one after the other x {n}"] = _chunk(config, env._replace(start=None), steps)
            cases[f"{name} x {n}"] = _chunk(config, env, steps)
            cases[f"{name}, acting alone x {n}"] = rollout.rolled(env, n, steps)
            agent_steps |= dict.fromkeys(cases.keys() - agent_steps.keys(), n * steps)
    measured = common.measure(cases, rounds=rounds)
    columns: dict[str, dict[str, Any]] = {
        name: {"agent_steps_per_s": agent_steps[name] / timing.median} for name, timing in measured.cases.items()
    }
    common.report(
        "host",
        measured,
        settings={"device": device, "host": host, "obs": obs, "replay_ratio": replay_ratio},
        columns=columns,
    )
    for pool in pools:
        pool.close()


def _chunk(config: Any, env: Any, steps: int) -> Callable[[], Any]:
    """A function that goes on training for so many vector steps; it is past the steps before the first update."""
    import jax
    import jax.numpy as jnp

    import ne_dreamer_jax as nedreamer
    from ne_dreamer_jax import loop as loops

    options = replace(config.loop, capacity=20_000)
    loop = loops.make(options, env, nedreamer.make_agent(config.agent, env.spec), config.env.action_repeat)
    held: dict[str, Any] = {}

    def go_on(count: int = steps) -> Any:
        held["state"], report = loop.chunk(held["state"], jnp.asarray(count, jnp.int32))
        return report.updates

    def begin() -> Any:
        if not held:
            held["state"] = loop.init(jax.random.key(0))
            go_on(loop.budget.prefill)
        return go_on()

    return begin


if __name__ == "__main__":
    use_large_pages("benchmarks.host")
    main()
