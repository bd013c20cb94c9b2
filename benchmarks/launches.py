"""Counts the kernels of a program, for a GPU that need not be there: ``python -m benchmarks.launches --help``.

Where kernels are short, what decides on a GPU is how many are launched. The program is compiled ahead of time, and what
the compiler made of it is read: every instruction that computes or copies is counted as one kernel, and those in a
loop's body once for each of its steps. A library's call may be several kernels, and the conditions of loops, which some
of them evaluate on the host, are not counted.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import click

from ne_dreamer_jax.commands.options import Name, Task, refusing
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.system.quiet import quiet

TARGETS = ("cuda", "cpu")
FREE = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all", "opt-barrier"}
"""Instructions that launch nothing."""
ENDS = ("-done", "-update")
"""Of instructions that wait for what another one has launched."""
COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\) -> .* \{$")
INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%?[\w.\-]+ = (.*)$")

H100 = """
gpu_device_info {
  threads_per_block_limit: 1024  threads_per_warp: 32
  shared_memory_per_block: 49152  shared_memory_per_core: 233472  shared_memory_per_block_optin: 232448
  threads_per_core_limit: 2048  core_count: 132  fpus_per_core: 128
  block_dim_limit_x: 2147483647  block_dim_limit_y: 65535  block_dim_limit_z: 65535
  memory_bandwidth: 3352320000000  l2_cache_size: 52428800
  clock_rate_ghz: 1.98  device_memory_size: 84929347584
  cuda_compute_capability { major: 9 }
  registers_per_core_limit: 65536  registers_per_block_limit: 65536
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 8 }
runtime_version { major: 12 minor: 9 patch: 0 }
device_description_str: "NVIDIA H100 80GB HBM3"
"""
"""An H100 as XLA's target configurations describe one."""


class Part(NamedTuple):
    """The program outside of loops, a loop's body, or a branch of a conditional."""

    name: str
    steps: int  # how often it runs
    certain: bool  # whether the program says so; a loop that ends by its values counts as one step
    kernels: Counter[str]  # kind -> launches in one of its steps

    @property
    def launches(self) -> int:
        """In all steps together."""
        return self.steps * sum(self.kernels.values())


@click.command(context_settings={"max_content_width": 110})
@click.option("--size", type=Name("size", names.SIZES), default="12m", show_default=True)
@click.option("--method", type=Name("method", names.METHODS), default="ne_dreamer", show_default=True)
@click.option("--target", type=Name("target", TARGETS), default="cuda", show_default=True)
@click.option("--actions", type=click.IntRange(1), default=6, show_default=True, help="Size of the continuous action.")
@click.option("--task", type=Task(), help="Count a step of its environments, whatever the agent.")
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="Any setting, as experiments.train.")
def main(size: str, method: str, target: str, actions: int, task: str | None, assignments: tuple[str, ...]) -> None:
    """Count the kernels of an update on 64x64x3 frames (drqv2: 84x84x3), by loop; or of an environment's step.

    --target cuda compiles for an H100, without one; it needs the packages of the extra `cuda` and a minute or two. XLA
    can't try kernels out there and takes its defaults, so that the count on a GPU may differ somewhat.
    """
    quiet()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_gpu_autotune_level=0"
    from benchmarks import common
    from experiments.train import configure

    with refusing(ValueError):
        config = configure("dmc", size, method, {"env.task": task}, assignments)
        compiled = compile_step(config, target) if task else compile_update(config, actions, target)
    found = parts(compiled.as_text())
    rows: list[Mapping[str, Any]] = [
        {
            "part": part.name,
            "steps": f"{part.steps}" if part.certain else f"{part.steps} or more",
            "kernels": sum(part.kernels.values()),
            "launches": part.launches,
        }
        for part in found
    ]
    total, memory = sum(part.launches for part in found), compiled.memory_analysis().temp_size_in_bytes
    what = f"a step of {config.loop.num_envs} {task}" if task else f"an update of {method} at {size}"
    print(f"launches: {what}, compiled for {target}\n")
    print(common.table([*rows, {"part": "in all", "steps": None, "kernels": None, "launches": total}]))
    print("\nall branches of a conditional are counted, of which one is taken;", end=" ")
    print("where the program does not say how many steps a loop takes, one step is counted")
    print(f"temporary memory {memory / 1e9:.2f} GB")
    settings = {"size": size, "method": method, "task": task, "target": target, "set": list(assignments)}
    line = {"benchmark": "launches", "machine": common.machine(), "settings": settings, "rows": rows}
    print("\n" + json.dumps({**line, "launches": total, "temporary_bytes": memory}))


def compile_update(config: Any, actions: int, target: str) -> Any:
    """An update of the agent, compiled. Raises ValueError where the target's compiler is not installed."""
    import jax

    from benchmarks import training
    from ne_dreamer_jax.agents import make_agent
    from ne_dreamer_jax.nets.platform import traced_for
    from ne_dreamer_jax.replay import ring as replay

    spec = training.pixels(config, actions)
    with traced_for(target):
        agent = make_agent(config.agent, spec)
        state = jax.eval_shape(agent.init, jax.random.key(0))
        batch = jax.eval_shape(lambda key: replay.random_batch(spec, config.agent, key), jax.random.key(1))
        return _compile(agent.train_step, (state, batch), target)


def compile_step(config: Any, target: str) -> Any:
    """A step of the environments, with their pictures, compiled. Raises ValueError as `compile_update`."""
    import jax
    import jax.numpy as jnp

    from ne_dreamer_jax.envs import config as env_configs
    from ne_dreamer_jax.nets.platform import traced_for

    env, n = env_configs.make(config.env), config.loop.num_envs
    with traced_for(target):
        state = jax.eval_shape(jax.vmap(env.prepare), jax.random.split(jax.random.key(0), n))
        action = jax.ShapeDtypeStruct((n, *env.spec.action.shape), jnp.dtype(env.spec.action.dtype))
        return _compile(jax.jit(jax.vmap(env.step)), (state, action), target)


def _compile(function: Any, inputs: Any, target: str) -> Any:
    import jax

    place = jax.sharding.SingleDeviceSharding(_device(target))
    placed = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place), inputs)
    return function.trace(*placed).lower(lowering_platforms=(target,)).compile()


def _device(target: str) -> Any:
    import jax
    from jax.experimental import topologies

    if target == "cpu":
        return jax.devices("cpu")[0]
    try:
        topology = topologies.get_topology_desc(platform=target, topology_name="", target_config=H100, topology="1x1x1")
    except RuntimeError as error:
        raise ValueError(
            f"expected XLA's compiler for {target} (pip install 'ne-dreamer-jax[cuda]'), got {error}"
        ) from error
    return topology.devices[0]


def parts(text: str) -> list[Part]:
    """The parts of an optimised HLO program that launch anything, those that launch most first."""
    computations, entry = _computations(text)
    found = list(_walk(computations, entry, Part("outside of loops", 1, True, Counter())))
    return sorted((part for part in found if part.kernels), key=lambda part: -part.launches)


def _computations(text: str) -> tuple[dict[str, list[str]], str]:
    """Computation -> its instructions, each from its type on; and which is the program's entry."""
    computations: dict[str, list[str]] = {}
    entry, current = "", None
    for line in text.splitlines():
        if head := COMPUTATION.match(line):
            current = head[2]
            computations[current] = []
            entry = current if head[1] else entry
        elif line.startswith("}"):
            current = None
        elif current is not None and (instruction := INSTRUCTION.match(line)):
            computations[current].append(instruction[1])
    return computations, entry


def _walk(computations: Mapping[str, list[str]], name: str, part: Part) -> Iterator[Part]:
    """A part of the program with a computation's kernels added, and those that its loops and conditionals run."""
    for instruction in computations[name]:
        operation, operands = _operation(instruction)
        if operation == "while":
            count = re.search(r'known_trip_count":\{"n":"(\d+)"', operands)
            steps, certain = part.steps * (int(count[1]) if count else 1), part.certain and count is not None
            body = Part(f"loop: {_source(operands)}", steps, certain, Counter())
            yield from _walk(computations, _reference("body", operands), body)
        elif operation == "conditional":
            for i, branch in enumerate(_branches(operands)):
                taken = part._replace(name=f"branch {i}: {_source(operands)}", kernels=Counter())
                yield from _walk(computations, branch, taken)
        elif operation == "call":
            *inner, called = _walk(computations, _reference("to_apply", operands), part._replace(kernels=Counter()))
            yield from inner
            part.kernels.update(called.kernels)
        elif operation not in FREE and not operation.endswith(ENDS):
            part.kernels[operation] += 1
    yield part


def _operation(instruction: str) -> tuple[str, str]:
    """An instruction's operation and what follows its name; its type, which may be a tuple of types, stands before."""
    depth = 0
    for i, character in enumerate(instruction):
        depth += (character == "(") - (character == ")")
        if depth == 0 and character == " ":
            rest = instruction[i + 1 :]
            operation = rest[: rest.index("(")]
            return operation, rest[len(operation) :]
    raise ValueError(f"expected an HLO instruction, got {instruction[:80]!r}")


def _reference(attribute: str, operands: str) -> str:
    found = re.search(rf"{attribute}=%?([\w.\-]+)", operands)
    assert found is not None
    return found[1]


def _branches(operands: str) -> list[str]:
    listed = re.search(r"branch_computations=\{([^}]*)\}", operands)
    if listed:
        return [name.strip().lstrip("%") for name in listed[1].split(",")]
    return [_reference(f"{which}_computation", operands) for which in ("true", "false")]


def _source(operands: str) -> str:
    """Where in the program an instruction comes from."""
    found = re.search(r'op_name="(?:jit\(\w+\)/)?([^"]*)"', operands)
    return found[1] if found else "?"


if __name__ == "__main__":
    main()
