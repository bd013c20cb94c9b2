"""The accelerator's benchmark is run where there is one; what can be known before is checked here."""

import importlib
import json

import pytest

from benchmarks import accelerator


@pytest.mark.parametrize("stage", accelerator.STAGES, ids=lambda stage: stage.name)
def test_the_stages_are_commands_that_exist_with_options_that_they_have(stage):
    command = importlib.import_module(stage.path).main
    for arguments in (stage.arguments, stage.smallest):
        command.make_context(stage.path, list(arguments))


@pytest.mark.parametrize(
    ("code", "seconds", "told"),
    [
        ('print(\'{"benchmark": "a", "x": 1}\')', None, "done in"),
        ("print('| a | 1 |')", None, "done in"),
        ("raise SystemExit('no memory')", None, "failed with exit code 1"),
        ("import time; time.sleep(60)", 2.0, "failed, it took longer than the 2 s that were left"),
    ],
)
def test_a_stage_keeps_its_figures_or_says_how_it_failed(tmp_path, monkeypatch, code, seconds, told):
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "one.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    stage = accelerator.Stage("one", "stages.one", (), (), 1.0)
    assert told in accelerator._run(stage, tmp_path, "01", False, seconds)
    kept = tmp_path / "results.jsonl"
    assert kept.exists() == told.startswith("done")
    if kept.exists():
        line = json.loads(kept.read_text())
        assert line["stage"] == "one"
        assert line.get("x") == 1 or line["printed"][-1] == "| a | 1 |"
