"""What a run leaves on disk as it goes: metrics and checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax

from ne_dreamer_jax.files import sync_file
from ne_dreamer_jax.loop import LoopState
from ne_dreamer_jax.replay.host_frames import HostFrames
from ne_dreamer_jax.runs import checkpoint, metrics
from ne_dreamer_jax.runs.metrics import StepCounts
from ne_dreamer_jax.runs.run_directory import RunDirectory
from ne_dreamer_jax.system import parallel


def whole(frames: HostFrames | None) -> tuple[str, ...]:
    """The items of a checkpoint from which training goes on; ``frames`` are those of the loop."""
    return ("agent", "loop") if frames is None else ("agent", "loop", "frames")


def last(files: RunDirectory, frames: HostFrames | None) -> str:
    """A sentence on the newest checkpoint from which training goes on."""
    items = set(whole(frames))
    found = [entry for entry in checkpoint.checkpoints(files.checkpoints) if items <= set(entry.items)]
    return f"The last checkpoint is {found[0].path}." if found else "There is no checkpoint yet."


class Record:
    """The metrics of a run so far, on disk and at hand."""

    def __init__(
        self, writer: metrics.Writer, lines: list[dict[str, Any]], echo: Callable[[str], None] = lambda line: None
    ) -> None:
        self._writer, self._echo = writer, echo
        self._failing = False
        self.lines = lines

    def write(self, counters: StepCounts, values: Mapping[str, Any]) -> None:
        """Adds a line."""
        try:
            self._writer.write(counters, values)
            self._failing = False
        except OSError as error:  # the line stays in the file's buffer, and goes with the next
            if not self._failing:
                self._echo(f"Could not write metrics: {error.strerror or error}. Training goes on; the lines are kept.")
            self._failing = True
        self.lines.append(counters._asdict() | {name: float(value) for name, value in values.items()})

    def find(self, name: str, counters: StepCounts | None = None) -> float | None:
        """The last value of a name, at these counters where they are given."""
        for line in reversed(self.lines):
            if name in line and (counters is None or line["env_step"] == counters.env_step):
                return line[name]
        return None

    def score(self, counters: StepCounts) -> float | None:
        """What ranks the checkpoint at these counters: the return of its evaluation.

        None where there was none, where an episode was cut short, or where parameters are not finite.
        """
        sound = self.find("eval/cut_episodes", counters) == 0 and self.find("eval/finite", counters) == 1
        score = self.find("eval/return", counters) if sound else None
        return score if score is not None and math.isfinite(score) else None

    @property
    def random_return(self) -> tuple[float, float] | None:
        """Mean and standard deviation of a random policy's returns."""
        mean, deviation = self.find("eval/random_return"), self.find("eval/random_return_std")
        return None if mean is None or deviation is None else (mean, deviation)


class Saves:
    """Checkpoints: whole ones in intervals of time, and the agent alone where an evaluation is the best so far."""

    def __init__(
        self, files: RunDirectory, seconds: float, echo: Callable[[str], None], frames: HostFrames | None = None
    ) -> None:
        self._files, self._directory, self._seconds, self._echo = files, files.checkpoints, seconds, echo
        self._frames, self._items = frames, whole(frames)
        self._last = time.monotonic()
        self.failed = False
        """Whether the last attempt to save failed."""

    def due(self) -> bool:
        """Whether the interval is over."""
        return bool(parallel.agreed(time.monotonic() - self._last >= self._seconds)[0])

    def whole(self, state: LoopState, counters: StepCounts, score: float | None, goes_on: bool = True) -> None:
        """Saves everything, unless it stands there already; ``goes_on`` is whether training does, if that fails."""
        if parallel.agreed(not any(found.score == score for found in self._whole_at(counters)))[0]:
            rest: Any = ()
            items: dict[str, Any] = {"agent": state.train, "loop": state._replace(train=rest)}
            if self._frames is not None:
                items["frames"] = self._frames.arrays
            self._save(items, counters, score, goes_on)
        self._last = time.monotonic()

    def if_best(self, state: LoopState, counters: StepCounts, score: float | None) -> None:
        """Saves the agent if no checkpoint has as high a score; one without a score is not the best."""
        best = checkpoint.best(checkpoint.checkpoints(self._directory))
        beaten = score is not None and (best is None or best.score is None or score > best.score)
        stopped_here, saves = parallel.agreed(bool(self._whole_at(counters)), beaten)
        if stopped_here:  # before this evaluation
            self.whole(state, counters, score)
        elif saves:
            self._save({"agent": state.train}, counters, score)

    def _whole_at(self, counters: StepCounts) -> list[checkpoint.Checkpoint]:
        found = checkpoint.checkpoints(self._directory)
        return [entry for entry in found if entry.step == counters.env_step and set(self._items) <= set(entry.items)]

    def _save(self, items: dict[str, Any], counters: StepCounts, score: float | None, goes_on: bool = True) -> None:
        began = time.monotonic()
        if jax.process_count() > 1:
            items = parallel.gather(items)
            if jax.process_index() > 0:
                return
        try:
            self._sync_metrics()
            checkpoint.save(self._directory, counters.env_step, items, score=score)
        except checkpoint.SaveError as error:
            self.failed = True
            then = "Training goes on, and the next attempt is at the next interval. " if goes_on else ""
            self._echo(f"Not saved: {error}. {then}{last(self._files, self._frames)}")
            return
        self.failed = False
        self._echo(f"Saved the {' and the '.join(items)} in {time.monotonic() - began:.1f} s.")
        self.prune()

    def _sync_metrics(self) -> None:
        """No checkpoint outlives the lines before it. Raises SaveError where they can't be brought to the disk."""
        path = self._files.metrics
        try:
            if path.exists():
                sync_file(path)
        except OSError as error:
            cause = error.strerror or error
            raise checkpoint.SaveError(f"could not save a checkpoint in {self._directory}: {path}: {cause}") from error

    def prune(self, keep: int = 2) -> None:
        """Removes what `checkpoint.prune` removes; where that can't be, a line says so."""
        try:
            checkpoint.prune(self._directory, whole=self._items, keep=keep)
        except OSError as error:
            self._echo(f"Could not remove older checkpoints in {self._directory}: {error.strerror or error}.")
