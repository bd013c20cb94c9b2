"""What a run tells people: what it is going to do, how far it is, and how long the rest takes."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import jax

from ne_dreamer_jax.agents.dreamer.agent import parameter_counts
from ne_dreamer_jax.config import Config
from ne_dreamer_jax.loop import Loop, LoopState
from ne_dreamer_jax.runs.metrics import StepCounts
from ne_dreamer_jax.runs.schedule import Schedule
from ne_dreamer_jax.system import memory

NOTHING_LEARNED = (
    "Nothing is learned in this run: it has no update. Raise loop.env_steps (--env-steps) or "
    "loop.replay_ratio, or lower loop.prefill, the number of agent steps before the first update."
)


def describe(config: Config, loop: Loop, shapes: LoopState, changed: Sequence[str] = ()) -> list[str]:
    """The budget of a run in plain words, a line each, and which settings have ``changed`` since its last start."""
    agent, options = config.agent, config.loop
    counts = parameter_counts(shapes.train.params)
    modules = ", ".join(f"{name} {count:,}" for name, count in sorted(counts.items(), key=lambda item: -item[1]))
    budget = loop.budget
    env_steps = f"{budget.agent_steps * budget.action_repeat:,} environment steps"
    first = f"{budget.prefill * budget.num_envs:,} agent steps"
    lines = [
        f"{config.env.task} from {_seen(config)}, {config.method}, seed {config.seed}, on {_devices(shapes)}",
        f"  budget    {env_steps}: {budget.agent_steps:,} agent steps "
        f"(action repeat {budget.action_repeat}) in {budget.num_envs} environments",
        f"  learning  {budget.updates:,} updates of {agent.batch_size} x {agent.batch_length} steps, the first after "
        f"{first}; replay ratio {options.replay_ratio:g} (how often a step is learned from)",
        f"  memory    replay holds {budget.capacity:,} agent steps in {memory.readable(loop.replay_bytes)}",
        f"  agent     {sum(counts.values()):,} parameters: {modules}",
    ]
    lines += [f"  changed   {line}" for line in changed]
    return lines if loop.budget.updates or options.replay_ratio == 0 else [*lines, f"  WARNING   {NOTHING_LEARNED}"]


def _seen(config: Config) -> str:
    return getattr(config.env, "obs", "what it observes")


def _devices(shapes: LoopState) -> str:
    device, sharding = jax.devices()[0], getattr(shapes.key, "sharding", None)
    kind = "the CPU" if device.platform == "cpu" else device.device_kind
    return kind if sharding is None else f"{len(sharding.device_set)} devices ({kind})"


class Pace:
    """Rates and the time left, from the chunks and evaluations so far."""

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule
        self._evaluation = 0.0
        self._chunks: deque[float] = deque(maxlen=8)  # seconds a vector step, of chunks that learned

    def evaluated(self, seconds: float) -> None:
        """Takes note of how long an evaluation took."""
        self._evaluation = seconds

    def line(self, before: StepCounts, after: StepCounts, values: Mapping[str, Any], seconds: float) -> str:
        """One line on a chunk."""
        schedule = self._schedule
        step = after.agent_step // schedule.num_envs
        if after.update > before.update:
            self._chunks.append(seconds / (step - before.agent_step // schedule.num_envs))
        parts = [
            f"{100 * step / schedule.total:5.1f} %",
            f"env step {after.env_step:,}",
            f"update {after.update:,}",
            f"{(after.env_step - before.env_step) / seconds:,.0f} env steps/s",
        ]
        if after.update > before.update:
            parts.append(f"{(after.update - before.update) / seconds:,.3g} updates/s")
        if "train/return" in values:
            parts.append(f"return {values['train/return']:.1f}")
        if "train/loss/total" in values:
            parts.append(f"loss {values['train/loss/total']:.4g}")
        if values.get("train/skipped_updates"):
            guilty = sorted(name.removeprefix("train/non_finite/") for name in values if "/non_finite/" in name)
            shown = ", ".join(guilty[:3]) + (", ..." if len(guilty) > 3 else "")
            parts.append(f"skipped updates: {values['train/skipped_updates']:.0f} (not finite: {shown})")
        if values.get("train/bad_actions"):
            parts.append(f"episodes cut by actions that are not finite: {values['train/bad_actions']:.0f}")
        if values.get("train/faults"):
            parts.append(f"episodes cut by faults of the environment: {values['train/faults']:.0f}")
        parts.append(self._left(step, after))
        return "  ".join(parts)

    def _left(self, step: int, after: StepCounts) -> str:
        if not self._chunks:
            return "time left not known yet" if after.update else "collecting before the first update"
        steps = (self._schedule.total - step) * statistics.median(self._chunks)
        return f"{duration(steps + self._evaluation * self._schedule.evaluations_after(step))} left"


def duration(seconds: float) -> str:
    """Seconds as people say them: 42 s, 3 min 20 s, 5 h 12 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
