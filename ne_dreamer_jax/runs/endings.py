"""How a run ended: its exit code, and its last lines for people."""

from __future__ import annotations

from ne_dreamer_jax.agents import guard
from ne_dreamer_jax.envs.config import GIVEN
from ne_dreamer_jax.loop import LoopState, Report
from ne_dreamer_jax.runs import progress
from ne_dreamer_jax.runs.building import Run
from ne_dreamer_jax.runs.record import Record, last
from ne_dreamer_jax.runs.run_directory import RunDirectory, typed

DIVERGED = 3
"""Exit code of a run that stopped because its updates were not finite."""
NOT_SAVED = 4
"""Exit code of a run whose last checkpoint could not be written."""
ENVIRONMENT = 5
"""Exit code of a run whose environments, in processes of their own, failed."""


def diverged(run: Run, files: RunDirectory, report: Report, state: LoopState) -> str:
    """What happened where updates were not finite, and what can be done."""
    counted = {name.removeprefix(guard.PREFIX): value for name, value in report.learning.items()}
    guilty = sorted(name for name, value in counted.items() if f"{guard.PREFIX}{name}" in report.learning and value)
    return (
        f"Stopped: {int(state.counters.skipped):,} updates in a row were not finite (loop.max_skipped is "
        f"{run.config.loop.max_skipped:,}) and changed nothing. Not finite were: {', '.join(guilty)}. "
        f"{last(files, run.loop.frames)} This command would come to the same point again: begin a new run, with --fork "
        f"{typed(files.path)} from that checkpoint or from the start, with a lower agent.optimizer.learning_rate or "
        "agent.optimizer.agc; look at the size of the rewards; or set JAX_DEBUG_NANS=True to find the first operation."
    )


def conclusion(run: Run, files: RunDirectory, record: Record, in_a_row: int) -> list[str]:
    """The last lines of a run that reached its end, ``in_a_row`` of whose last updates were skipped."""
    mean, deviation = record.find("eval/return"), record.find("eval/return_std")
    lines = [f"Finished {run.config.loop.env_steps:,} environment steps of {run.config.env.task}."]
    if run.loop.budget.updates == 0:
        lines.append(progress.NOTHING_LEARNED)
    if skipped := sum(line.get("train/skipped_updates", 0) for line in record.lines):
        lines.append(
            f"{skipped:,.0f} of {run.loop.budget.updates:,} updates were skipped, as their numbers were not finite; "
            f"{in_a_row:,} of them in a row at the end."
        )
    if mean is not None and deviation is not None and record.random_return is not None:
        lines.append(
            f"Evaluation return {mean:.1f} ± {deviation:.1f}; a random policy's is "
            f"{record.random_return[0]:.1f} ± {record.random_return[1]:.1f}."
        )
    if files.curve.exists():
        lines.append(f"  {files.curve}: the learning curve")
    if files.video.exists():
        lines.append(f"  {files.video}: an episode of the policy")
    if run.config.env.task == GIVEN:  # no command can make it
        lines.append(f"  ne_dreamer_jax.evaluate({str(files.path)!r}, env=...) in Python: more episodes")
    else:
        lines.append(f"  python -m ne_dreamer_jax evaluate {typed(files.path)}: more episodes")
    return lines
