"""Times one update and its parts: ``python -m benchmarks.train_step --help``.

The parts are timed by themselves, each with its gradients, on the same batch; what the compiler shares between them
in the whole update makes their sum more than the whole.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import click
import jax
import jax.numpy as jnp

from benchmarks import common
from benchmarks.arithmetic import product_flops
from ne_dreamer_jax.commands.options import Name, Task, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet


@click.command(context_settings={"max_content_width": 110})
@click.option("--preset", type=Name("preset", names.PRESETS), default="dmc", show_default=True)
@click.option("--size", type=Name("size", names.SIZES), help="Default: the preset's own.")
@click.option("--method", type=Name("method", names.METHODS), default="ne_dreamer", show_default=True)
@click.option("--task", type=Task(), help="Whose observations and actions. Default: the preset's.")
@click.option("--rounds", type=click.IntRange(1), default=3, show_default=True)
@click.option("--parts/--no-parts", default=True, show_default=True, help="Whether to time the parts too.")
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
def main(
    preset: str,
    size: str | None,
    method: str,
    task: str | None,
    rounds: int,
    parts: bool,
    assignments: tuple[str, ...],
) -> None:
    """Time the update of a preset's agent on what its task shows, in seconds and GEMM units."""
    quiet()
    from experiments.train import configure
    from ne_dreamer_jax.agents import make_agent
    from ne_dreamer_jax.agents.dreamer.agent import AgentConfig, parameter_counts
    from ne_dreamer_jax.config import PRESETS
    from ne_dreamer_jax.envs import config as envs
    from ne_dreamer_jax.replay import ring as replay

    with refusing(ValueError):
        run = configure(preset, size, method, {"env.task": task}, assignments)
        config, spec = run.agent, envs.make(run.env).spec
        agent = make_agent(config, spec)
    state = agent.init(jax.random.key(0))
    batch = jax.jit(lambda key: replay.random_batch(spec, config, key))(jax.random.key(1))
    counts = parameter_counts(state.params)
    jitted: Any = agent.train_step
    begin = time.perf_counter()
    lowered = jitted.lower(state, batch)
    traced = time.perf_counter()
    compiled = lowered.compile()
    seconds = {"trace_seconds": traced - begin, "compile_seconds": time.perf_counter() - traced}
    temporary = compiled.memory_analysis().temp_size_in_bytes
    cases: dict[str, Callable[[], Any]] = {}
    if parts and isinstance(config, AgentConfig):
        cases |= _parts(config, spec, state, batch)
    holder = [state]  # the update donates its state

    def update() -> Any:
        holder[0], _, metrics = agent.train_step(holder[0], batch)
        return metrics

    cases = {"update": update, **cases}
    measured = common.measure(cases, rounds=rounds)
    common.report(
        "train_step",
        measured,
        settings={
            "preset": preset,
            "size": size or PRESETS[preset][1],
            "method": method,
            "task": run.env.task,
            "set": " ".join(assignments),
            "batch_size": config.batch_size,
            "batch_length": config.batch_length,
            "compute_dtype": getattr(config, "compute_dtype", "float32"),
            "parameters": sum(counts.values()),
            "temporary_bytes": temporary,
            "product_gflop": product_flops(jitted, state, batch) / 1e9,
            **seconds,
            **{f"parameters_{name}": count for name, count in counts.items()},
        },
    )


def _parts(config: Any, spec: Any, state: Any, batch: Any) -> dict[str, Callable[[], Any]]:
    """Name -> the part with its gradients, compiled, on inputs of its own."""
    from ne_dreamer_jax.agents import optim
    from ne_dreamer_jax.agents.dreamer import behavior, world_model
    from ne_dreamer_jax.agents.dreamer.agent import world_model_of
    from ne_dreamer_jax.nets.networks import Networks
    from ne_dreamer_jax.nets.rssm import feature, observe

    nets = Networks.build(spec, config.encoder, config.rssm, config.heads, jnp.dtype(config.compute_dtype))
    objective = config.objective.build(world_model_of(nets, config.batch_length))
    key = jax.random.key(2)
    params = jax.tree.map(jnp.copy, state.params)  # the update donates the others
    first = jnp.zeros((), jnp.int32)
    slow, target, scale = jax.tree.map(jnp.copy, (state.slow_critic, state.target, state.return_scale))
    rollout, posterior = jax.jit(lambda p, b: world_model.posterior_rollout(nets, p, key, b))(params, batch)
    optimizer = optim.make(config.optimizer)
    moments = jax.jit(optimizer.init)(params)

    def encoder(p: Any) -> Any:
        return jnp.sum(jnp.square(nets.apply("encoder", p, batch.obs)))

    uniform = jax.random.uniform(key, (*batch.is_first.shape, config.rssm.stoch))

    def posterior_scan(p: Any, embedding: Any) -> Any:
        latent, _ = observe(
            nets.rssm, p["rssm"], uniform, batch.context, embedding, rollout.prev_action, batch.is_first
        )
        return jnp.sum(jnp.square(feature(latent)))

    def predictions(p: Any, rollout: Any) -> Any:
        discount = config.behavior.discount
        losses, _ = world_model.prediction_losses(nets, config.world_model, p, rollout, posterior, discount)
        return sum(losses.values(), jnp.zeros(()))

    def representation(p: Any, rollout: Any) -> Any:
        return sum(objective.loss(p, target, key, rollout)[0].values(), jnp.zeros(()))

    def actor_critic(p: Any) -> Any:
        losses, _, _ = behavior.actor_critic_losses(nets, config.behavior, p, slow, scale, key, rollout, first)
        return sum(losses.values(), jnp.zeros(()))

    def imagined(p: Any, start: Any) -> Any:
        # As in the update, little is kept of the states.
        noise = behavior.imagination_noise(nets, key, start.deter.shape[0], config.behavior.horizon)
        return behavior.imagine(nets, p, noise, start, lambda state: state[:, 0])

    replayed = behavior.Replayed.of(rollout, config.behavior.imagine_last)
    start = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), replayed.latent)
    compiled = {
        "encoder": (jax.grad(encoder), (params,)),
        "observe": (jax.grad(posterior_scan, (0, 1)), (params, rollout.embedding)),
        "predictions": (jax.grad(predictions, (0, 1), allow_int=True), (params, rollout)),
        "objective": (jax.grad(representation, (0, 1), allow_int=True), (params, rollout)),
        "imagine": (imagined, (params, start)),
        "actor_critic": (jax.grad(actor_critic), (params,)),
        "optimizer": (optimizer.update, (params, moments, params)),
    }
    return {name: _bind(jax.jit(f), args) for name, (f, args) in compiled.items()}


def _bind(function: Callable[..., Any], args: tuple[Any, ...]) -> Callable[[], Any]:
    return lambda: function(*args)


if __name__ == "__main__":
    use_large_pages("benchmarks.train_step")
    main()
