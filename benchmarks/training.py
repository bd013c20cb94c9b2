"""What several benchmarks train: an agent on pixels alone, and the whole loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

CAPACITY = 20_000
"""Transitions in replay: enough to begin with, and little to hold."""


def pixels(config: Any, actions: int = 6) -> Any:
    """The specification of an environment with images of the configuration's size and so many continuous actions."""
    import jax.numpy as jnp

    from ne_dreamer_jax.types import ArraySpec, ContinuousAction, EnvSpec

    side = config.env.image_size
    return EnvSpec({"image": ArraySpec((side, side, 3), jnp.uint8)}, ContinuousAction(actions))


def make_loop(config: Any, env: Any) -> Any:
    """A configuration's training loop in an environment, with a small replay."""
    import ne_dreamer_jax as nedreamer
    from ne_dreamer_jax import loop as loops

    agent = nedreamer.make_agent(config.agent, env.spec)
    options = replace(config.loop, capacity=min(CAPACITY, config.loop.capacity or CAPACITY))
    return loops.make(options, env, agent, config.env.action_repeat)


def chunks(loop: Any, init: Callable[[], Any], chunk: Callable[..., Any], steps: int) -> Callable[[], Any]:
    """A function that goes on with training by so many vector steps, and returns their `Report`.

    Its first call makes the state and takes it past the steps before the first update.

    Args:
      init: a state of the loop, or of several runs of it.
      chunk: (state, steps) -> (state, report), compiled; it donates its state.
    """
    import jax.numpy as jnp

    held: list[Any] = []

    def go_on() -> Any:
        if not held:
            held.append(chunk(init(), jnp.asarray(loop.budget.prefill, jnp.int32))[0])
        held[0], report = chunk(held[0], jnp.asarray(steps, jnp.int32))
        return report

    return go_on
