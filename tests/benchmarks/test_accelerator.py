"""The accelerator's benchmark is run where there is one; what can be known before is checked here."""

import importlib

import pytest
from click.testing import CliRunner

from benchmarks import accelerator, stages


@pytest.mark.parametrize("plan", accelerator.PLANS, ids=lambda plan: plan.name)
def test_the_stages_are_commands_that_exist_with_options_that_they_have(plan):
    for smallest in (False, True):
        stage = plan.stage(smallest)
        importlib.import_module(stage.module).main.make_context(stage.module, list(stage.arguments))


def test_stages_have_names_and_files_of_their_own():
    assert len({plan.stage(False).file for plan in accelerator.PLANS}) == len(accelerator.PLANS)


def test_stages_are_run_to_the_end_and_their_failure_is_the_exit_code(tmp_path, monkeypatch):
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "good.py").write_text("print(1)")
    (tmp_path / "made" / "bad.py").write_text("raise SystemExit(3)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    plan = lambda name: accelerator.Plan(name, f"made.{name}", (), (), 1.0)
    run = lambda: CliRunner().invoke(accelerator.main, ["--output", str(tmp_path / "out"), "--smallest"])
    monkeypatch.setattr(accelerator, "PLANS", (plan("bad"), plan("good")))
    found = run()
    assert (found.exit_code, "1 done, 1 failed, 0 left out" in found.output) == (1, True), found.output
    assert "The same command again does what is missing." in found.output
    monkeypatch.setattr(accelerator, "PLANS", (plan("good"),))
    found = run()
    assert (found.exit_code, "1 done, 0 failed" in found.output) == (0, True), found.output
    assert len((tmp_path / "out" / stages.RESULTS).read_text().splitlines()) == 2


def test_what_can_not_be_measured_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    (tmp_path / "notes.txt").touch()
    for options, words in [
        (["--output", str(tmp_path), "--smallest"], "choose another name"),
        (["--output", str(tmp_path / "notes.txt"), "--smallest"], "which is a file"),
        (["--output", str(tmp_path / "new"), "--minutes", "nan"], "finite"),
        (["--output", str(tmp_path / "new")], "--smallest shows that all stages run"),
    ]:
        found = CliRunner().invoke(accelerator.main, options)
        assert (found.exit_code, words in found.output) == (2, True), found.output
    assert not (tmp_path / "new").exists()
