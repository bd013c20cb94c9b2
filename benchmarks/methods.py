"""What an update of every method costs, in one interleaved run: ``python -m benchmarks.methods --help``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import click

from ne_dreamer_jax.commands.options import Name, Task, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet

if TYPE_CHECKING:
    from benchmarks import common

METHODS = tuple(name for name in names.METHODS if "/" not in name)
VECTOR_STEPS = 8
"""In a timed part of training."""
BESIDE = ", beside"
"""Ends a case's name."""


@click.command(context_settings={"max_content_width": 110})
@click.option("--preset", type=Name("preset", names.PRESETS), default="dmc", show_default=True)
@click.option(
    "--size", "sizes", type=Name("size", names.SIZES), multiple=True, help="May be repeated. Default: the preset's."
)
@click.option("--method", "methods", type=Name("method", names.METHODS), multiple=True, help="Default: all of them.")
@click.option("--task", type=Task(), help="Whose observations and actions. Default: the preset's.")
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
@click.option("--beside", metavar="PATH=VALUE", multiple=True, help="Settings to time too, and to compare with.")
@click.option("--chunk", is_flag=True, help="Time 8 vector steps of the whole loop, updates included, not an update.")
@click.option("--rounds", type=click.IntRange(1), default=3, show_default=True)
@click.option("--counts", is_flag=True, help="Count parameters only: no update is compiled.")
def main(
    preset: str,
    sizes: tuple[str, ...],
    methods: tuple[str, ...],
    task: str | None,
    assignments: tuple[str, ...],
    beside: tuple[str, ...],
    chunk: bool,
    rounds: int,
    counts: bool,
) -> None:
    """Time an update of a preset (or, with --chunk, a part of its training), method by method in turns.

    By default it is one of 16 sequences of 64 frames of 64x64x3 pixels; drqv2's is of transitions of 84x84x3 pixels, as
    published (walker tasks: 512 of them). Beside the times stand the parameters by module (and those that no gradient
    trains, such as a teacher's), the bytes that the compiled update needs besides its arguments, and how much
    arithmetic its matrix products are. Of --set and --beside a method gets those that it has.
    """
    quiet()
    from benchmarks import common
    from ne_dreamer_jax.agents import make_agent
    from ne_dreamer_jax.config import PRESETS

    for size in sizes or (None,):
        with refusing(ValueError):
            configs = _configs(preset, size, methods or METHODS, task, assignments)
            others = _configs(preset, size, methods or METHODS, task, (*assignments, *beside)) if beside else {}
            others = {name: config for name, config in others.items() if config != configs[name]}
            configs |= {f"{name}{BESIDE}": config for name, config in others.items()}
            envs = _environments(configs)
        told: dict[str, common.Value] = {
            "preset": preset, "size": size or PRESETS[preset][1], "task": next(iter(configs.values())).env.task,
            "set": " ".join(assignments) or None, "beside": " ".join(beside) or None,
        }  # fmt: skip
        columns = {name: parameters(make_agent(config.agent, envs[name].spec)) for name, config in configs.items()}
        if counts:
            print(", ".join(f"{key} {value}" for key, value in told.items() if value is not None))
            print(common.table([{"method": name, **column} for name, column in columns.items()]))
            continue
        cases = {}
        for name, config in configs.items():
            cases[name], more = (_chunk if chunk else _update)(config, envs[name])
            columns[name] = {**more, **columns[name]}
        measured = common.measure(cases, rounds=rounds)
        for name in others:
            ratio = measured.cases[f"{name}{BESIDE}"].median / measured.cases[name].median
            columns[name] = {"times_as_fast_as_beside": ratio, **columns[name]}
        common.report("methods", measured, settings={**told, "chunk": str(chunk)}, columns=columns)


def parameters(agent: Any) -> dict[str, common.Value]:
    """Number of parameters in all, by module, and of the objective's target."""
    import jax
    import jax.numpy as jnp

    from ne_dreamer_jax.agents.dreamer.agent import parameter_counts

    state = jax.eval_shape(agent.init, jax.random.key(0))
    modules = parameter_counts(state.params)
    target = sum(x.size for x in jax.tree.leaves(state.target) if x.dtype == jnp.float32)
    return {"total": sum(modules.values()), **modules, "target": target}


def _environments(configs: dict[str, Any]) -> dict[str, Any]:
    """Name -> environment; those that are alike are made once."""
    from ne_dreamer_jax.envs import config as env_configs

    made: dict[Any, Any] = {}
    for config in configs.values():
        if config.env not in made:
            made[config.env] = env_configs.make(config.env)
    return {name: made[config.env] for name, config in configs.items()}


def _configs(
    preset: str, size: str | None, methods: Sequence[str], task: str | None, assignments: Sequence[str]
) -> dict[str, Any]:
    """Method -> the preset with it, and with those of the assignments whose settings it has.

    Raises:
      ValueError: a setting that no method has, or a value that does not fit it.
    """
    from ne_dreamer_jax import settings
    from ne_dreamer_jax.commands.train import configure
    from ne_dreamer_jax.config import override

    made = {method: configure(preset, size, method, {"env.task": task}) for method in methods}
    for assignment in assignments:
        path = assignment.partition("=")[0].strip()
        # Where none has it, the first one says what is wrong.
        for method in [method for method in methods if path in settings.paths(made[method])] or methods[:1]:
            made[method] = override(made[method], assignment)
    return made


def _update(config: Any, env: Any) -> tuple[Callable[[], Any], dict[str, common.Value]]:
    """A function that does one update after another on the same batch, and what else is to be said of it."""
    import jax

    from benchmarks.arithmetic import product_flops
    from ne_dreamer_jax.agents import make_agent
    from ne_dreamer_jax.replay import ring as replay

    agent = make_agent(config.agent, env.spec)
    batch = jax.jit(lambda key: replay.random_batch(agent.spec, agent.config, key))(jax.random.key(1))
    state = agent.init(jax.random.key(0))
    train_step: Any = agent.train_step
    compiled = train_step.lower(state, batch).compile()
    gflop = product_flops(train_step, state, batch) / 1e9
    holder = [state]  # an update donates its state

    def update() -> Any:
        holder[0], _, metrics = compiled(holder[0], batch)
        return metrics

    return update, {"gflop": gflop, "temporary_bytes": compiled.memory_analysis().temp_size_in_bytes}


def _chunk(config: Any, env: Any) -> tuple[Callable[[], Any], dict[str, common.Value]]:
    """A function that goes on with training by `VECTOR_STEPS`, and how many updates that is."""
    import jax

    from benchmarks import training

    loop = training.make_loop(config, env)
    case = training.chunks(loop, lambda: loop.init(jax.random.key(0)), loop.chunk, VECTOR_STEPS)
    updates = config.loop.replay_ratio * config.loop.num_envs * VECTOR_STEPS
    return case, {"updates": updates / (config.agent.batch_size * config.agent.batch_length)}


if __name__ == "__main__":
    use_large_pages("benchmarks.methods")
    main()
