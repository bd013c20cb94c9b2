"""The accelerator's benchmark is run where there is one; what can be known before is checked here."""

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from benchmarks import accelerator


@pytest.mark.parametrize("stage", accelerator.STAGES, ids=lambda stage: stage.name)
def test_the_stages_are_commands_that_exist_with_options_that_they_have(stage):
    command = importlib.import_module(stage.path).main
    for arguments in (stage.arguments, stage.smallest):
        command.make_context(stage.path, list(arguments))


@pytest.fixture
def make_stage(tmp_path, monkeypatch):
    """A function that makes a stage of Python code."""
    (tmp_path / "stages").mkdir()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def make(name: str, code: str) -> accelerator.Stage:
        (tmp_path / "stages" / f"{name}.py").write_text(code)
        return accelerator.Stage(name, f"stages.{name}", (), (), 1.0)

    return make


@pytest.mark.parametrize(
    ("code", "seconds", "told"),
    [
        ('print(\'{"benchmark": "a", "x": 1}\')', None, "done in"),
        ("print('| a | 1 |')", None, "done in"),
        ("raise SystemExit('no memory')", None, "failed with exit code 1"),
        ("import time; time.sleep(60)", 2.0, "failed, it took longer than the 2 s that were left"),
    ],
)
def test_a_stage_keeps_its_figures_or_says_how_it_failed(tmp_path, make_stage, code, seconds, told):
    how, words = accelerator._run(make_stage("one", code), tmp_path, "01", False, seconds)
    assert words.startswith(told)
    assert words.startswith(how)
    kept = tmp_path / "results.jsonl"
    assert kept.exists() == (how == "done")
    if kept.exists():
        line = json.loads(kept.read_text())
        assert line["stage"] == "one"
        assert line.get("x") == 1 or line["printed"][-1] == "| a | 1 |"


def test_the_same_command_again_does_what_is_missing(tmp_path, make_stage, monkeypatch):
    flag, output = tmp_path / "mended", tmp_path / "out"
    good = make_stage("good", f"open({str(tmp_path / 'runs')!r}, 'a').write('x')")
    bad = make_stage("bad", f"import os; raise SystemExit(0 if os.path.exists({str(flag)!r}) else 3)")
    monkeypatch.setattr(accelerator, "STAGES", (good, bad))
    run = lambda *more: CliRunner().invoke(accelerator.main, ["--output", str(output), *more])
    first = run("--smallest")
    assert (first.exit_code, "1 done, 1 failed" in first.output) == (1, True), first.output
    flag.touch()
    second = run("--smallest")
    assert (second.exit_code, "2 done, 0 failed" in second.output) == (0, True), second.output
    assert (tmp_path / "runs").read_text() == "x"  # once
    assert "was begun with --smallest" in run().output


def test_what_can_not_be_measured_is_refused(tmp_path):
    (tmp_path / "notes.txt").touch()
    for options, words in [
        (["--output", str(tmp_path), "--smallest"], "choose another name"),
        (["--output", str(tmp_path / "notes.txt"), "--smallest"], "expected a folder of this benchmark"),
        (["--output", str(tmp_path / "new"), "--minutes", "nan"], "finite"),
        (["--output", str(tmp_path / "new")], "--smallest shows that all stages run"),  # tests run on CPUs
    ]:
        found = CliRunner().invoke(accelerator.main, options)
        assert (found.exit_code, words in found.output) == (2, True), found.output
    assert not (tmp_path / "new").exists()


def test_a_stage_ends_with_the_benchmark(tmp_path, make_stage):
    pid = tmp_path / "pid"
    make_stage("slow", f"import os, time; open({str(pid)!r}, 'w').write(str(os.getpid())); time.sleep(300)")
    script = (
        "from benchmarks import accelerator as a; "
        "a.STAGES = (a.Stage('slow', 'stages.slow', (), (), 1.0),); a.main(['--output', 'out', '--smallest'])"
    )
    path = os.pathsep.join([str(tmp_path), str(Path(accelerator.__file__).parents[1])])
    process = subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path})
    while not (pid.exists() and pid.read_text()):
        assert process.poll() is None
        time.sleep(0.05)
    process.terminate()
    assert process.wait(60) == 128 + signal.SIGTERM
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)
