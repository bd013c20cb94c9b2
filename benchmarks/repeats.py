"""Whether updates repeat to the bit: ``python -m benchmarks.repeats --help``."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import click

from ne_dreamer_jax.commands.options import Name, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet

FLAG = "--xla_gpu_deterministic_ops=true"


@click.command(context_settings={"max_content_width": 110})
@click.option("--size", type=Name("size", names.SIZES), default="1m", show_default=True)
@click.option("--method", type=Name("method", names.METHODS), default="ne_dreamer", show_default=True)
@click.option("--updates", type=click.IntRange(1), default=5, show_default=True)
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
@click.option("--worker", is_flag=True, hidden=True, help="Print what one process finds.")
def main(size: str, method: str, updates: int, assignments: tuple[str, ...], worker: bool) -> None:
    """The same updates twice in one process and again in another, with XLA's deterministic kernels and without.

    Compared is the whole state after the updates, and what they measured. Processes may differ where a process does
    not: kernels are chosen by trying them. Beside it stands what a fresh reward head predicts, which is to be exactly 0
    on every device.
    """
    quiet()
    if worker:
        print(json.dumps(_digests(size, method, updates, assignments)))
        return
    from experiments.train import configure

    with refusing(ValueError):
        configure("dmc", size, method, {}, assignments)
    arguments = ["--size", size, "--method", method, "--updates", str(updates)]
    for assignment in assignments:
        arguments += ["--set", assignment]
    rows = []
    for name, flags in {"as XLA chooses": "", "deterministic kernels": FLAG}.items():
        runs = [_in_a_process(arguments, flags) for _ in range(2)]
        digests = [digest for run in runs for digest in run["digests"]]
        rows.append(
            {
                "kernels": name,
                "repeats_in_a_process": str(all(len(set(run["digests"])) == 1 for run in runs)),
                "repeats_in_another": str(len(set(digests)) == 1),
                "fresh_reward": runs[0]["fresh_reward"],
            }
        )
    from benchmarks import common

    settings = {"size": size, "method": method, "updates": updates, "set": " ".join(assignments)}
    print(f"repeats: {method}, {size}, {updates} updates\non {common.machine()}\n")
    print(common.table(rows))
    print("\n" + json.dumps({"benchmark": "repeats", "machine": common.machine(), "settings": settings, "rows": rows}))


def _in_a_process(arguments: Sequence[str], flags: str) -> dict[str, Any]:
    """What a worker found, with such flags of XLA."""
    environment = {**os.environ, "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()}
    command = [sys.executable, "-m", "benchmarks.repeats", *arguments, "--worker"]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"a process of its own ended with exit code {done.returncode}, see above")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _digests(size: str, method: str, updates: int, assignments: tuple[str, ...]) -> dict[str, Any]:
    """Digests of two trainings from one key, and the largest reward that a fresh head predicts."""
    import jax
    import numpy as np

    from benchmarks import training
    from experiments.train import configure
    from ne_dreamer_jax.agents import make_agent
    from ne_dreamer_jax.replay import ring

    run = configure("dmc", size, method, {}, assignments)
    spec = training.pixels(run)
    agent = make_agent(run.agent, spec)
    batch = jax.jit(lambda key: ring.random_batch(spec, run.agent, key))(jax.random.key(1))
    found, fresh = [], None
    for _ in range(2):
        state = agent.init(jax.random.key(0))
        fresh = _fresh_reward(agent, state.params)
        measured = []
        for _ in range(updates):
            state, _, metrics = agent.train_step(state, batch)
            measured.append(metrics)
        numbers = jax.tree.leaves((state._replace(key=jax.random.key_data(state.key)), measured))
        found.append(hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in numbers)).hexdigest())
    return {"digests": found, "fresh_reward": fresh}


def _fresh_reward(agent: Any, params: Any) -> float | None:
    """The largest absolute reward that a fresh world model predicts of random features; None without one."""
    import jax
    import jax.numpy as jnp

    if agent.inspection is None:
        return None
    feature = jax.random.normal(jax.random.key(2), (64, agent.config.rssm.feature))
    return float(jnp.abs(jax.jit(agent.inspection.heads)(params, feature).reward).max())


if __name__ == "__main__":
    use_large_pages("benchmarks.repeats")
    main()
