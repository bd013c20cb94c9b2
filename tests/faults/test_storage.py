"""The n-th open, write, sync, rename and mkdir of a save fails: the old checkpoint stands or the new, never neither.

In a child process, by a library that makes the system's calls fail, so that nothing below Python is spared.
"""

import errno
import json
import os
import subprocess
import sys

import pytest

from tests.faults import shim

WORDS = [os.strerror(error) for error in shim.ERRORS]


class Child:
    """`tests.faults.saving faults`, asked for one fault after another."""

    def __init__(self, library, path):
        self.errors = path.parent / "errors"
        self.path, self.value = path, 0
        with self.errors.open("wb") as errors:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tests.faults.saving", "faults", str(path)],
                env=shim.environment(library), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True,
            )  # fmt: skip

    def ask(self, kind, number, error, lasting, forward):
        self.value += 1
        fault = {"kind": kind, "number": number, "error": error, "lasting": lasting, "forward": forward}
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(fault | {"value": self.value}) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        assert line, self.errors.read_text()[-2000:]
        return json.loads(line)

    def end(self):
        """The child's exit code, and what it and its libraries wrote to standard error."""
        self.process.communicate("", timeout=60)
        return self.process.returncode, self.errors.read_text()


@pytest.fixture
def child(tmp_path):
    child = Child(shim.build(tmp_path), tmp_path / "run")
    yield child
    child.process.kill()
    child.process.communicate()


def check(child, kind, number, error, lasting, forward):
    """One fault: a sentence with path and cause if nothing was saved, and an old or a new checkpoint in any case."""
    answer = child.ask(kind, number, error, lasting, forward)
    said, where = answer["said"], (kind, number, os.strerror(error), lasting, forward, answer)
    assert not any("Traceback" in line or "\n" in line for line in said), where
    not_saved = [line for line in said if line.startswith("Not saved: could not save a checkpoint in ")]
    assert len(not_saved) == answer["failed"], where
    assert all(str(child.path) in line and os.strerror(error) in line for line in not_saved), where
    assert len(said) == len(set(said)), where
    assert answer["hits"] or number > answer["counts"][kind], where
    assert answer["stands"] in ("old", "new"), where
    if not answer["failed"]:
        assert answer["stands"] == "new", where
        assert any(line.startswith("Saved the agent and the loop") for line in said), where
    intact = child.ask("write", 10**6, errno.ENOSPC, False, 1)
    assert (intact["failed"], intact["stands"]) == (False, "new"), where
    return answer


def counts(child):
    """How many calls of each kind a save has, of a new step and of one that stands there."""
    return {forward: child.ask("write", 10**6, errno.ENOSPC, False, forward)["counts"] for forward in (1, 0)}


def test_a_call_of_each_kind_fails_in_a_save(child):
    failed = 0
    for index, kind in enumerate(shim.KINDS):
        for number, lasting, forward in ((1, False, 1), (2, True, 0), (3, False, 0)):
            error = shim.ERRORS[(index + number) % len(shim.ERRORS)]
            failed += check(child, kind, number, error, lasting, forward)["failed"]
    assert failed > 8, "most of these are in the way of the save"
    assert child.end() == (0, "")


@pytest.mark.slow
def test_every_call_fails_in_turn_for_every_reason(child):
    tried = failed = 0
    for forward, numbers in counts(child).items():
        for kind, count in numbers.items():
            for number in range(1, count + 1):
                for error in shim.ERRORS:
                    for lasting in (False, True):
                        tried += 1
                        failed += check(child, kind, number, error, lasting, forward)["failed"]
    print(f"{tried} faults, {failed} of which cost the save")
    assert child.end() == (0, "")
    assert failed > tried // 2


def test_metrics_that_could_not_be_written_are_told_once_and_kept(child):
    answer = child.ask("write", 1, errno.EDQUOT, False, 1)
    assert not answer["failed"]
    (line,) = [line for line in answer["said"] if "metrics" in line]
    assert line == "Could not write metrics: Disk quota exceeded. Training goes on; the lines are kept."
    assert child.end() == (0, "")
    lines = (child.path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["x"] for line in lines] == [1.0]
