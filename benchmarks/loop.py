"""Where the time of the whole training loop goes: ``python -m benchmarks.loop --help``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import click

from ne_dreamer_jax.commands.options import Name, Task, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet

PARTS = ("environment", "rendering", "acting", "replay", "learning")


@click.command(context_settings={"max_content_width": 110})
@click.option("--task", "tasks", type=Task(), multiple=True, default=("dmc/walker_walk",), show_default=True)
@click.option("--size", "sizes", type=Name("size", names.SIZES), multiple=True, default=("12m",), show_default=True)
@click.option("--preset", type=Name("preset", names.PRESETS), default="dmc", show_default=True)
@click.option("--capacity", type=click.IntRange(2), default=20_000, show_default=True, help="Transitions in replay.")
@click.option("--rounds", type=click.IntRange(1), default=3, show_default=True)
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
def main(
    tasks: tuple[str, ...],
    sizes: tuple[str, ...],
    preset: str,
    capacity: int,
    rounds: int,
    assignments: tuple[str, ...],
) -> None:
    """Time the parts of a vector step of a preset, each compiled by itself, and their shares.

    Replay is adding the step, and sampling a batch and writing its latents back for each update. The rates are those of
    the parts one after the other.
    """
    quiet()
    from benchmarks import common
    from experiments.train import configure

    for task in dict.fromkeys(tasks):
        for size in dict.fromkeys(sizes):
            with refusing(ValueError):
                config = configure(preset, size, None, {"env.task": task}, assignments)
            config = replace(config, loop=replace(config.loop, capacity=capacity))
            options, agent = config.loop, config.agent
            measured = common.measure(_parts(config), rounds=rounds)
            updates = options.replay_ratio * options.num_envs / (agent.batch_size * agent.batch_length)
            once = {name: timing.median for name, timing in measured.cases.items()}
            step = {
                "environment": once["physics"],
                "rendering": once["rendering"],
                "acting": once["acting"],
                "replay": once["add"] + updates * once["sample and write"],
                "learning": updates * once["update"],
            }
            total = sum(step.values())
            settings: dict[str, Any] = {
                "task": task,
                "size": size,
                "updates_per_vector_step": updates,
                "agent_steps_per_s": options.num_envs / total,
                "frames_per_s": options.num_envs * config.env.action_repeat / total,
                "updates_per_s": updates / total,
                **{f"share_{name}": step[name] / total for name in PARTS},
            }
            common.report("loop", measured, settings=settings)


def _parts(config: Any) -> dict[str, Callable[[], Any]]:
    """Name -> a part of the loop on N environments or on one batch."""
    import jax
    import jax.numpy as jnp

    import ne_dreamer_jax as nedreamer
    from ne_dreamer_jax.envs import config as env_configs
    from ne_dreamer_jax.replay import ring as replay_lib
    from ne_dreamer_jax.types import TimeStep, Transition

    n = config.loop.num_envs
    env = env_configs.make(config.env)
    agent = nedreamer.make_agent(config.agent, env.spec)
    keys = jax.random.split(jax.random.key(0), n)
    train, policy = agent.init(jax.random.key(1)), agent.init_policy(n)

    @jax.jit
    def step(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        """Without the picture, which nothing asks for and the compiler leaves out."""
        state, timestep = jax.vmap(env.step)(state, action)
        return state, timestep.reward

    state, _ = step(jax.vmap(env.prepare)(keys), policy.prev_action)
    observe = jax.jit(jax.vmap(env.observe))
    obs = observe(state)
    no = jnp.zeros((n,), bool)
    timestep = TimeStep(obs, jnp.zeros((n,)), no, no, no)
    transition = Transition(obs, policy.prev_action, jnp.zeros((n,)), no, no, no, policy.latent)
    b, length = config.agent.batch_size, config.agent.batch_length
    add = jax.jit(replay_lib.add, donate_argnums=0)
    ring = replay_lib.init(transition, config.loop.capacity, n)
    for _ in range(length + 1):
        ring = add(ring, transition)
    key = jax.random.key(2)
    batch = jax.jit(replay_lib.sample, static_argnums=(2, 3))(ring, key, b, length)
    # Once outside, so that the update's latents have their shapes; it donates its state.
    train, latents, _ = agent.train_step(train, batch)

    def sample_and_write(ring: Any, key: Any, latents: Any) -> Any:
        batch = replay_lib.sample(ring, key, b, length)
        return replay_lib.write_latents(ring, batch.index, latents), batch

    resample = jax.jit(sample_and_write, donate_argnums=0)
    held = {"ring": ring, "train": train}

    def adding() -> Any:
        held["ring"] = add(held["ring"], transition)
        return held["ring"].position

    def resampling() -> Any:
        held["ring"], batch = resample(held["ring"], key, latents)
        return batch

    def update() -> Any:
        held["train"], _, metrics = agent.train_step(held["train"], batch)
        return metrics

    return {
        "physics": lambda: step(state, policy.prev_action),
        "rendering": lambda: observe(state),
        "acting": lambda: agent.act(held["train"].params, policy, timestep, key)[1],
        "add": adding,
        "sample and write": resampling,
        "update": update,
    }


if __name__ == "__main__":
    use_large_pages("benchmarks.loop")
    main()
