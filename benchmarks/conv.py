"""The image encoder forward and forward with gradient, stage by stage and whole, beside XLA's own convolutions.

``python -m benchmarks.conv --size 12m --images 1024``. On a CPU ``ours`` is `nets.cpu.conv`; on an accelerator both are
the same code. GEMM units are those of the images asked for.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import click
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common import measure, report
from ne_dreamer_jax.nets import conv

DEPTHS = {"1m": 4, "12m": 16, "25m": 24}
MULTIPLIERS = (2, 3, 4, 4)
Case = Callable[[], Any]


def stages_and_inputs(depth: int, images: int, side: int) -> tuple[list[conv.Stage], list[jax.Array]]:
    """Random stages, and for each an input: images for the first, activations for the others."""
    rng = np.random.default_rng(0)
    channels = [3, *(depth * multiplier for multiplier in MULTIPLIERS)]
    stages, inputs = [], [jnp.asarray(rng.integers(0, 256, (images, side, side, 3)), jnp.uint8)]
    for i, (c_in, c_out) in enumerate(itertools.pairwise(channels)):
        kernel = rng.normal(size=(5, 5, c_in, c_out)) / np.sqrt(25 * c_in)
        stages.append(conv.Stage(jnp.asarray(kernel, jnp.float32), jnp.zeros(c_out), jnp.ones(c_out)))
        shape = (images, side >> (i + 1), side >> (i + 1), c_out)
        inputs.append(jnp.asarray(rng.standard_normal(shape, np.float32)))
    return stages, inputs[:-1]


def gradient(encode: Callable[..., jax.Array], x: jax.Array, stages: Sequence[conv.Stage]) -> Any:
    """Value of a loss and its gradients for the stages, and for the input unless that is uint8."""

    def loss(x: jax.Array, stages: Sequence[conv.Stage]) -> jax.Array:
        return jnp.mean(encode(x, stages) ** 2)

    return jax.value_and_grad(loss, argnums=1 if x.dtype == jnp.uint8 else (0, 1))(x, stages)


def cases(depth: int, images: int, side: int, lax: bool) -> dict[str, Case]:
    """Forward and gradient of each stage and of all, ours and, where asked for, XLA's."""
    stages, inputs = stages_and_inputs(depth, images, side)
    parts = {f"stage {i + 1}": (x, [stage]) for i, (x, stage) in enumerate(zip(inputs, stages, strict=True))}
    parts["encoder"] = (inputs[0], stages)
    encoders = {"ours": conv.encode_images} | ({"lax": conv.lax_encode_images} if lax else {})
    result: dict[str, Case] = {}
    for (part, arguments), (name, encode) in itertools.product(parts.items(), encoders.items()):
        for what, function in (("forward", encode), ("gradient", functools.partial(gradient, encode))):
            result[f"{part} {what}, {name}"] = functools.partial(jax.jit(function), *arguments)
    return result


@click.command(help=__doc__)
@click.option("--size", type=click.Choice(list(DEPTHS)), default="12m", show_default=True)
@click.option("--images", default=1024, show_default=True, help="Images a call: 1024 in a batch of 16 x 64.")
@click.option("--side", default=64, show_default=True, help="Side of the images, pixels.")
@click.option("--rounds", default=5, show_default=True)
@click.option("--lax/--no-lax", default=True, show_default=True, help="Also XLA's own; its gradient takes long.")
def main(size: str, images: int, side: int, rounds: int, lax: bool) -> None:
    measured = measure(cases(DEPTHS[size], images, side, lax), rounds=rounds)
    report("conv", measured, settings={"size": size, "images": images, "side": side})


if __name__ == "__main__":
    main()
