"""When chunks end and evaluations are due."""

from __future__ import annotations

from dataclasses import dataclass

from ne_dreamer_jax.config import Config
from ne_dreamer_jax.loop import Loop, LoopState
from ne_dreamer_jax.runs.metrics import StepCounts


@dataclass(frozen=True)
class Schedule:
    """Everything here depends on the step alone, so that a run that goes on does what one that never stopped does.

    A step here is a vector step: one agent step of each environment.
    """

    total: int
    chunk: int
    evaluation: int | None  # steps between evaluations; None: there are none
    num_envs: int
    action_repeat: int

    @classmethod
    def of(cls, config: Config, loop: Loop) -> Schedule:
        """The schedule of a run."""
        num_envs, repeat = config.loop.num_envs, config.env.action_repeat
        every = config.loop.eval_every
        evaluation = None if every is None else max(1, round(every / (num_envs * repeat)))
        return cls(loop.budget.vector_steps, loop.budget.chunk_steps, evaluation, num_envs, repeat)

    def end_of_chunk(self, step: int) -> int:
        """Where the chunk that starts at a step ends."""
        after = (step // interval * interval + interval for interval in (self.chunk, self.evaluation) if interval)
        return min(self.total, *after)

    def evaluates(self, step: int) -> bool:
        """Whether an evaluation is due at a step."""
        if self.evaluation is None:
            return False
        return step == self.total or (step > 0 and step % self.evaluation == 0)

    def evaluations_after(self, step: int) -> int:
        """How many evaluations are still due after a step."""
        if self.evaluation is None:
            return 0
        regular = self.total // self.evaluation - step // self.evaluation
        return regular + (step < self.total and self.total % self.evaluation > 0)

    def counters(self, state: LoopState) -> StepCounts:
        """How far a state is."""
        step = int(state.counters.vector_step)
        agent_step = step * self.num_envs
        return StepCounts(agent_step * self.action_repeat, agent_step, int(state.train.update))
