"""Times environments stepped on the device by random actions: ``python -m benchmarks.rollout --help``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from ne_dreamer_jax import envs
from ne_dreamer_jax.commands.options import Task
from ne_dreamer_jax.envs.dmc import names as dmc_names
from ne_dreamer_jax.system.quiet import quiet


@click.command(context_settings={"max_content_width": 110})
@click.option("--task", "tasks", type=Task(), multiple=True, default=("dmc/walker_walk",), show_default=True)
@click.option(
    "--envs",
    "counts",
    type=click.IntRange(1),
    multiple=True,
    default=(16,),
    show_default=True,
    help="Environments stepped together. May be repeated.",
)
@click.option(
    "--obs", type=click.Choice(["pixels", "vector", "both"]), default="vector", show_default=True, help="Of dmc tasks."
)
@click.option("--action-repeat", type=click.IntRange(1), default=2, show_default=True)
@click.option("--steps", type=click.IntRange(1), default=20, show_default=True, help="Agent steps in a timed call.")
@click.option("--rounds", type=click.IntRange(1), default=5, show_default=True)
@click.option("--fast", is_flag=True, help="Beside each dmc task, itself with a shorter line search.")
@click.option("--mjx", "with_mjx", is_flag=True, help="Beside each dmc task, MJX's own step on the same model.")
def main(
    tasks: tuple[str, ...],
    counts: tuple[int, ...],
    obs: str,
    action_repeat: int,
    steps: int,
    rounds: int,
    fast: bool,
    with_mjx: bool,
) -> None:
    """Agent steps a second of each task, and what its first call, compilation included, takes."""
    quiet()
    from benchmarks import common

    runs: dict[str, tuple[str, int]] = {}
    cases: dict[str, Callable[[], Any]] = {}
    options: Callable[[str], dict[str, Any]] = lambda task: (
        {"obs": obs, "action_repeat": action_repeat} if task.startswith("dmc/") else {}
    )
    for task in dict.fromkeys(tasks):
        for n in dict.fromkeys(counts):
            runs[name := f"{task} x {n}"] = (task, n)
            cases[name] = rollout(task, n, steps, **options(task))
            if fast and task.startswith("dmc/"):
                runs[name := f"{task} x {n}, fast"] = (task, n)
                cases[name] = rollout(task, n, steps, **options(task), fast=True)
            if with_mjx and task.startswith("dmc/"):
                runs[name := f"{task} x {n}, mjx.step"] = (task, n)
                cases[name] = _mjx_steps(task, n, action_repeat, steps)
    measured = common.measure(cases, rounds=rounds)
    columns: dict[str, dict[str, Any]] = {
        name: {
            "ms_per_step": timing.median / steps * 1e3,
            "agent_steps_per_s": runs[name][1] * steps / timing.median,
            "gemm_units_per_step": measured.units(name) / steps,
        }
        for name, timing in measured.cases.items()
    }
    settings: dict[str, Any] = {"obs": obs, "action_repeat": action_repeat, "steps": steps}
    common.report("rollout", measured, settings=settings, columns=columns)


def rollout(task: str, num_envs: int, steps: int, **options: Any) -> Callable[[], Any]:
    """`rolled` of an environment by name.

    Args:
      options: of the environment.
    """
    return rolled(envs.make(task, **options), num_envs, steps)


def rolled(env: Any, num_envs: int, steps: int) -> Callable[[], Any]:
    """A function that goes on for some steps from where its last call left off. Its first call compiles it."""
    import jax

    from ne_dreamer_jax.envs import conformance
    from ne_dreamer_jax.envs.vector import as_vector

    env = as_vector(env)

    def run(state: Any, key: jax.Array) -> tuple[Any, Any]:
        def step(state: Any, key: jax.Array) -> tuple[Any, Any]:
            state, timestep = env.step(state, conformance.random_action(env, key, num_envs))
            seen = {name: value.astype("float32").sum() for name, value in timestep.obs.items()}
            return state, (timestep.reward, seen)

        return jax.lax.scan(step, state, jax.random.split(key, steps))

    compiled = jax.jit(run, donate_argnums=0)
    held: list[Any] = []  # the state is donated

    def case() -> Any:
        if not held:
            held.append(jax.jit(env.prepare)(jax.random.split(jax.random.key(0), num_envs)))
        held[0], outputs = compiled(held[0], jax.random.key(1))
        return outputs

    return case


def _mjx_steps(task: str, num_envs: int, action_repeat: int, steps: int) -> Callable[[], Any]:
    """The same number of physics steps with nothing around them: no rewards, observations, limits or resets."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    from ne_dreamer_jax.envs import dmc

    simulation = dmc.load(*dmc_names.split(task)).simulation

    def run(data: Any, key: jax.Array) -> Any:
        def step(data: Any, key: jax.Array) -> tuple[Any, Any]:
            action = jax.random.uniform(key, data.ctrl.shape, jnp.float32, -1.0, 1.0)
            turn = lambda _, data: jax.vmap(lambda data: mjx.step(simulation.model, data))(data)
            data = jax.lax.fori_loop(0, action_repeat * simulation.n_sub_steps, turn, data.replace(ctrl=action))
            return data, data.qpos

        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return jax.lax.scan(step, data, jax.random.split(key, steps))

    compiled = jax.jit(run)
    start = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_envs, *x.shape)), simulation.initial())
    held = [start]

    def case() -> Any:
        held[0], outputs = compiled(held[0], jax.random.key(1))
        return outputs

    return case


if __name__ == "__main__":
    main()
