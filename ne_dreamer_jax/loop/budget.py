"""How many steps and updates a run has: all of that arithmetic, in plain integers.

Each vector step (one agent step of each of N environments) earns credit, and an update costs some. Both are whole
numbers, in units of 1 / the replay ratio's denominator, so that no rounding adds up over a run.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from ne_dreamer_jax.loop.config import LoopConfig

PAPER_CAPACITY = 5_000_000
CHUNK_UPDATES = 64
"""Between two chunks of about so many updates the host can report, save and stop."""


@dataclass(frozen=True)
class Budget:
    """The counts of a run. A vector step is one agent step of each environment."""

    num_envs: int
    """N."""
    action_repeat: int
    """Environment steps of an agent step."""
    vector_steps: int
    """Vector steps of the whole run."""
    prefill: int
    """Vector steps before the first update."""
    step_credit: int
    """What a vector step after the prefill earns."""
    update_cost: int
    """What an update costs."""
    capacity: int
    """Transitions that replay will hold, a multiple of N."""
    chunk_steps: int
    """Vector steps of a chunk: as configured, but no more than about `CHUNK_UPDATES` updates."""

    @classmethod
    def of(cls, config: LoopConfig, batch_size: int, batch_length: int, action_repeat: int) -> Budget:
        """The budget of a run whose updates replay B sequences of T steps.

        Raises ValueError for a replay that can't hold a sequence, and for counts that 32 bits can't hold.
        """
        n, length = config.num_envs, batch_length
        vector_steps = -(-config.env_steps // (n * action_repeat))
        ratio = Fraction(config.replay_ratio).limit_denominator(1_000)
        if 0 < config.replay_ratio < 0.001:
            raise ValueError(
                f"loop.replay_ratio: expected 0 (never learn) or at least 0.001, got {config.replay_ratio}"
            )
        update_cost, step_credit = batch_size * length * ratio.denominator, n * ratio.numerator
        if update_cost + step_credit >= 2**31:
            raise ValueError(
                "expected updates that can be counted in 32 bits, got a loop.replay_ratio of "
                f"{config.replay_ratio:g} for {n:,} environments and batches of {batch_size} x {length}; take a "
                "rounder ratio"
            )
        if n * batch_size >= 2**31:
            raise ValueError(
                f"expected loop.num_envs times agent.batch_size below 2**31, got {n:,} times {batch_size:,}"
            )
        least = (length + 1) * n
        if config.capacity is not None and config.capacity < least:
            raise ValueError(
                f"loop.capacity: expected at least {least:,} transitions, a sequence of agent.batch_length {length} "
                f"and the step before it for each of {n} environments, got {config.capacity:,}."
            )
        capacity = min(PAPER_CAPACITY, vector_steps * n) if config.capacity is None else config.capacity
        return cls(
            num_envs=n,
            action_repeat=action_repeat,
            vector_steps=vector_steps,
            prefill=max(-(-config.prefill // n), length + 1),
            step_credit=step_credit,
            update_cost=update_cost,
            capacity=max(capacity, least) // n * n,
            chunk_steps=max(1, min(config.chunk_steps, CHUNK_UPDATES * update_cost // max(step_credit, 1))),
        )

    @property
    def agent_steps(self) -> int:
        """Agent steps of the whole run, over all environments."""
        return self.vector_steps * self.num_envs

    @property
    def updates(self) -> int:
        """Updates of the whole run."""
        return max(0, self.vector_steps - self.prefill) * self.step_credit // self.update_cost

    def check(self) -> None:
        """Raises ValueError where the run has more vector steps than 32 bits count."""
        if self.vector_steps >= 2**31:
            raise ValueError(
                f"loop.env_steps: expected fewer than 2**31 steps of each environment, got {self.vector_steps:,}; take "
                "more environments"
            )


def replay_ratio(batch_size: int, batch_length: int, steps_per_update: float) -> float:
    """Replayed steps for each agent step, where an update of B x T steps comes every so many agent steps."""
    return batch_size * batch_length / steps_per_update


def steps_per_update(batch_size: int, batch_length: int, ratio: float) -> float:
    """Agent steps for each update at a replay ratio: the inverse of `replay_ratio`."""
    return batch_size * batch_length / ratio
