"""Commands that run one after another, each in a process of its own, and a folder that keeps what they print.

A command that fails, takes too long or runs out of memory costs the others nothing but its time. The folder knows which
ones are done, so that running them again does what is missing.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, NoReturn

from ne_dreamer_jax.commands.options import say

RESULTS = "results.jsonl"
"""A line for each try of a stage: its name, command, seconds, and ``results`` or why it ``failed``."""
LONGEST = 3
"""A stage is ended after so many times the seconds that it is expected to take."""
How = Literal["done", "failed", "left out"]


class Stage(NamedTuple):
    """A command to run."""

    name: str
    module: str  # what ``python -m`` runs
    arguments: tuple[str, ...]
    seconds: float  # expected; it is not begun with less time left

    @property
    def command(self) -> str:
        """As it is typed."""
        return f"python -m {self.module} {' '.join(self.arguments)}".strip()

    @property
    def file(self) -> str:
        """Name of the file of what it prints."""
        return re.sub(r"\W+", "_", self.name).strip("_") + ".txt"


def tried(folder: Path) -> dict[str, bool]:
    """Command -> whether it is done, of all that were tried in the folder; none where it doesn't exist.

    Raises:
      ValueError: the folder holds something else.
    """
    if not folder.exists():
        return {}
    if not folder.is_dir():
        raise ValueError(f"expected a folder, got {folder}, which is a file; choose another name")
    results = folder / RESULTS
    if not results.exists():
        if any(folder.iterdir()):
            raise ValueError(
                f"expected a new folder or one with {RESULTS}, got {folder}, which holds something else; "
                "choose another name"
            )
        return {}
    found: dict[str, bool] = {}
    # What follows the last line's end was cut off when it was written: that stage is not done.
    *lines, _ = results.read_text(encoding="utf-8", errors="replace").split("\n")
    for number, text in enumerate(filter(None, lines), 1):
        try:
            line = json.loads(text)
            found[line["command"]] = "results" in line or found.get(line["command"], False)
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"expected lines of this benchmark in {results}, got {text[:80]!r} in line {number}; "
                "remove that line, or choose another name"
            ) from error
    return found


def run(stages: Sequence[Stage], folder: Path, minutes: float) -> Mapping[How, int]:
    """Runs what is not done yet, those that failed before last, and says how each went.

    Args:
      minutes: for all together; ``inf`` sets no limit, to a stage neither.

    Returns:
      How many stages are done, failed and were left out.

    Raises:
      OSError: the folder can't be made or written to.
      ValueError: it holds something else, or another process runs stages in it.
    """
    before = tried(folder)
    waiting = sorted((stage for stage in stages if not before.get(stage.command)), key=lambda s: s.command in before)
    count: dict[How, int] = {"done": len(stages) - len(waiting), "failed": 0, "left out": 0}
    folder.mkdir(parents=True, exist_ok=True)
    deadline = time.monotonic() + 60 * minutes
    with _results(folder) as results, _unwinding_on_signals():
        for stage in waiting:
            left = deadline - time.monotonic()
            how: How = "left out"
            if left < stage.seconds:
                told = f"left out, {max(left, 0):.0f} s are left and {stage.seconds:.0f} are needed"
            else:
                say(f"$ {stage.command}")
                longest = None if left == math.inf else min(left, LONGEST * stage.seconds)
                how, told = _run(stage, folder, results, longest)
            count[how] += 1
            say(f"{stage.name}: {told}\n")
    return count


@contextlib.contextmanager
def _results(folder: Path) -> Iterator[IO[str]]:
    """The file of results, for this process alone, which ends with a whole line."""
    with (folder / RESULTS).open("a+", encoding="utf-8") as results:
        try:
            fcntl.flock(results, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(f"another process runs stages in {folder}; wait for it, or choose another name") from error
        whole = (folder / RESULTS).read_bytes().rfind(b"\n") + 1
        results.truncate(whole)  # what was cut off is no line
        yield results


@contextlib.contextmanager
def _unwinding_on_signals() -> Iterator[None]:
    """Within the block SIGTERM and SIGHUP unwind the stack, as Ctrl-C does, so that no stage outlives this process."""

    def leave(number: int, _: Any) -> NoReturn:
        raise SystemExit(128 + number)

    # What was ignored stays so: nohup.
    heard = [number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, leave) for number in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(stage: Stage, folder: Path, results: IO[str], seconds: float | None) -> tuple[How, str]:
    """Runs a stage, prints and stores what it prints; how it went, also in words."""
    begin, file, code = time.monotonic(), folder / stage.file, None
    with file.open("ab") as printed:
        earlier = printed.tell()  # what an earlier try printed stays
        printed.write(f"$ {stage.command}\n".encode())
        printed.flush()
        command = [sys.executable, "-m", stage.module, *stage.arguments]
        process = subprocess.Popen(command, stdout=printed, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            pass
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # and the processes that it began
            process.wait()
    taken = time.monotonic() - begin
    lines = file.read_bytes()[earlier:].decode("utf-8", errors="replace").strip().splitlines()[1:]
    say("\n".join(line for line in lines if not _is_result(line)))
    told: dict[str, Any] = {"stage": stage.name, "command": stage.command, "seconds": taken}
    if code is None:
        told["failed"] = f"it took longer than {taken:.0f} s"
    elif code:
        told["failed"] = f"exit code {code} after {taken:.0f} s"
    else:
        try:
            told["results"] = [json.loads(line) for line in lines if _is_result(line)] or [{"printed": lines}]
        except ValueError as error:
            told["failed"] = f"its results can't be read, see {file}: {error}"
    results.write(json.dumps(told) + "\n")
    results.flush()
    return ("failed", f"failed, {told['failed']}") if "failed" in told else ("done", f"done in {taken:.0f} s")


def _is_result(line: str) -> bool:
    """Whether a line is one that benchmarks print for programs."""
    return line.startswith('{"benchmark"')
