"""Stages: kept results, failures that cost nothing else, going on, and no process left behind."""

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks import stages


@pytest.fixture
def make(tmp_path, monkeypatch):
    """A function that makes a stage of Python code."""
    (tmp_path / "made").mkdir()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def make(name: str, code: str, seconds: float = 20.0) -> stages.Stage:
        (tmp_path / "made" / f"{name}.py").write_text(code)
        return stages.Stage(name, f"made.{name}", (), seconds)

    return make


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / stages.RESULTS).read_text().splitlines()]


def test_results_and_failures_are_kept_and_printed(tmp_path, make, capsys):
    out = tmp_path / "out"
    count = stages.run(
        [
            make("figures", 'print("| a table |"); print(\'{"benchmark": "a", "x": 1}\')'),
            make("plain", "print('| 1 |')"),
            make("broken", "raise SystemExit('no memory')"),
            make("cut", 'print(\'{"benchmark": "a\')'),
            make("slow", "import time; print('begun', flush=True); time.sleep(100)", 2.0),
        ],
        out,
        minutes=2,
    )
    assert count == {"done": 2, "failed": 3, "left out": 0}
    figures, plain, *failed = lines(out)
    assert figures["results"] == [{"benchmark": "a", "x": 1}]
    assert plain["results"] == [{"printed": ["| 1 |"]}]
    for line, words in zip(failed, ["exit code 1", "can't be read", "longer than"], strict=True):
        assert words in line["failed"]
    printed = capsys.readouterr().out
    for words in ("| a table |", "no memory", "begun", "broken: failed"):
        assert words in printed
    assert '"benchmark": "a", "x"' not in printed


def test_going_on_does_what_is_missing_and_what_failed_last(tmp_path, make):
    out, log, flag = tmp_path / "out", tmp_path / "log", tmp_path / "mended"
    note = lambda name, more="": make(name, f"open({str(log)!r}, 'a').write('{name} '); {more}")
    good = note("good")
    bad = note("bad", f"import os; raise SystemExit(0 if os.path.exists({str(flag)!r}) else 3)")
    long = stages.Stage("long", "made.long", (), 1000.0)
    note("long")
    assert stages.run([good, bad, long], out, minutes=1) == {"done": 1, "failed": 1, "left out": 1}
    flag.touch()
    assert stages.run([good, bad, long], out, minutes=math.inf) == {"done": 3, "failed": 0, "left out": 0}
    assert log.read_text().split() == ["good", "bad", "long", "bad"]
    assert stages.run([good, bad, long], out, minutes=1)["done"] == 3
    assert len(log.read_text().split()) == 4
    # Other arguments are another command.
    assert not stages.tried(out).get(good._replace(arguments=("--more",)).command)


def test_a_line_that_was_cut_off_is_not_done(tmp_path, make):
    out = tmp_path / "out"
    stage = make("one", "print(1)")
    stages.run([stage], out, minutes=1)
    results = out / stages.RESULTS
    whole = results.read_text()
    results.write_text(whole + whole[:20])
    assert stages.tried(out) == {stage.command: True}
    stages.run([other := make("other", "print(2)")], out, minutes=1)
    assert stages.tried(out) == {stage.command: True, other.command: True}


@pytest.mark.parametrize("text", ["[1]\n", "{}\n", "words\n"])
def test_other_folders_are_refused(tmp_path, text):
    (tmp_path / stages.RESULTS).write_text(text)
    with pytest.raises(ValueError, match="in line 1; remove that line, or choose another name"):
        stages.tried(tmp_path)
    (tmp_path / stages.RESULTS).rename(tmp_path / "notes.txt")
    for folder in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(ValueError, match="choose another name"):
            stages.tried(folder)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_stage_ends_with_the_process_that_began_it(tmp_path, make, number):
    pid, out = tmp_path / "pid", tmp_path / "out"
    make("slow", f"import os, time; open({str(pid)!r}, 'w').write(str(os.getpid())); time.sleep(300)")
    script = f"""
from pathlib import Path
from benchmarks.stages import Stage, run
run([Stage("slow", "made.slow", (), 20.0)], Path({str(out)!r}), float("inf"))
"""
    path = os.pathsep.join([str(tmp_path), str(Path(stages.__file__).parents[1])])
    process = subprocess.Popen([sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": path})
    try:
        deadline = time.monotonic() + 60
        while not (pid.exists() and pid.read_text()):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        with pytest.raises(ValueError, match="another process runs stages"):
            stages.run([make("quick", "pass")], out, minutes=1)
        process.send_signal(number)
        assert process.wait(60) == 128 + number
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid.read_text()), 0)
    finally:
        process.kill()
        if pid.exists() and pid.read_text():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid.read_text()), signal.SIGKILL)
