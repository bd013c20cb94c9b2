"""A run that goes on with other settings: which may change, which may not, and what comes out."""

import dataclasses
import json
import shutil
import signal
from dataclasses import replace

import pytest

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax import config as configs
from ne_dreamer_jax import settings
from ne_dreamer_jax.commands import train as command
from ne_dreamer_jax.envs.config import HostConfig
from ne_dreamer_jax.runs import building, checkpoint, metrics, resume, run_directory, training
from ne_dreamer_jax.runs.run_directory import RefusedError
from tests.experiments import stub, toy
from tests.experiments.test_commands import invoke
from tests.experiments.test_training import measured, terminate
from tests.experiments.test_training import train as run_stub


def train(path, config, at=None):
    """A run of the stub, as the command starts it: its code and lines."""
    run = stub.build(resume.settle(path, config), image=False)
    with run_directory.claim(path, run.config, resume.differences):
        pass
    return run_stub(path, terminate, at, run=run)


def bits(path):
    newest = checkpoint.checkpoints(path / "checkpoints")[0]
    return newest.step, {
        (item, name): leaf["sha256"] for item, leaves in newest.items.items() for name, leaf in leaves.items()
    }


@pytest.fixture(autouse=True)
def without_pictures(monkeypatch):
    monkeypatch.setattr(training, "draw", lambda *_: None)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    path = tmp_path_factory.mktemp("stopped") / "run"
    assert train(path, toy.config(), "env step 64")[0] == 128 + signal.SIGTERM
    return path


@pytest.fixture
def stopped(original, tmp_path):
    return shutil.copytree(original, tmp_path / "run")


def test_the_lists_name_settings_and_no_others():
    assert {resume.MAY_GROW, *resume.MAY_CHANGE} <= settings.paths(configs.preset("smoke")).keys()


@pytest.mark.strict
def test_more_steps_end_with_the_bits_of_a_run_that_was_to_have_them(tmp_path):
    """With the replay of the first run, which is full at its end."""
    config = lambda **loop: toy.config(eval_every=None, **loop)
    assert train(tmp_path / "run", config())[0] == 0
    code, lines = train(tmp_path / "run", config(env_steps=200))
    assert code == 0
    assert any("Going on from" in line and "120 environment steps" in line for line in lines)
    assert train(tmp_path / "whole", config(env_steps=200, capacity=120))[0] == 0
    assert bits(tmp_path / "run") == bits(tmp_path / "whole")
    after = lambda name: [line for line in measured(tmp_path / name) if line["env_step"] > 128]
    assert after("run") == after("whole"), "before, only the first has the end of a chunk at 120"
    assert resume.changes(tmp_path / "run", resume.settle(tmp_path / "run", config(env_steps=200))) == []
    stored = run_directory.read_config(tmp_path / "run", configs.Config)
    assert (stored.loop.env_steps, stored.loop.capacity) == (200, 120)


@pytest.mark.strict
def test_what_is_measured_may_change_and_what_is_learned_does_not(stopped, tmp_path):
    changed = toy.config(eval_every=None, eval_episodes=1, eval_max_steps=50, chunk_steps=3, max_skipped=7)
    lines = resume.changes(stopped, resume.settle(stopped, changed))
    assert "loop.chunk_steps: 8, now 3" in lines
    assert len(lines) == 5
    assert train(stopped, changed)[0] == 0
    assert train(tmp_path / "whole", toy.config())[0] == 0
    assert bits(stopped) == bits(tmp_path / "whole")
    steps = [line["env_step"] for line in metrics.read(stopped / "metrics.jsonl") if line["env_step"] > 64]
    assert steps[:2] == [66, 72], "chunks of three steps of two environments"
    assert run_directory.read_config(stopped, configs.Config) == changed


def test_an_update_may_go_on_in_other_parts():
    """The same update, for a device with less memory."""
    stored = toy.config()
    asked = replace(stored, agent=replace(stored.agent, microbatches=2))
    assert resume.differences(stored, asked) == []
    other = replace(stored, agent=replace(asked.agent, batch_length=5))
    assert resume.differences(stored, other) == ["agent.batch_length: 4, now 5"]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"num_envs": 3}, "loop.num_envs: 2, now 3"),
        ({"env_steps": 60}, "loop.env_steps: 120, now 60 (loop.env_steps may only grow)"),
        ({"capacity": 50}, "loop.capacity: None, now 50"),
        ({"replay_ratio": 2.0}, "loop.replay_ratio: 1.0, now 2.0"),
    ],
)
def test_what_may_not_change_is_refused_with_a_line_for_each(stopped, change, line):
    before = (stopped / "config.json").read_bytes()
    with pytest.raises(RefusedError) as error:
        resume.settle(stopped, toy.config(eval_every=60, **change))
    assert str(error.value).splitlines()[1:] == [f"  {line}"]
    assert "--fork" in str(error.value)
    assert (stopped / "config.json").read_bytes() == before


def test_a_run_that_was_moved_or_copied_goes_on_where_it_is(stopped, tmp_path):
    shutil.copytree(stopped, tmp_path / "copy")
    stopped.rename(tmp_path / "moved")
    for path in (tmp_path / "copy", tmp_path / "moved"):
        code, lines = train(path, toy.config())
        assert code == 0
        assert any(f"Going on from {path}" in line for line in lines)
    assert bits(tmp_path / "copy") == bits(tmp_path / "moved")


def test_a_run_of_an_older_version_goes_on_without_the_settings_it_did_not_know(tmp_path):
    config = configs.preset("smoke")
    with run_directory.claim(tmp_path, config) as files:
        content = json.loads(files.config.read_text())
    del content["sha256"], content["agent"]["behavior"]["discount_in_head"], content["loop"]["max_skipped"]
    files.config.write_text(json.dumps(content))
    with pytest.raises(RefusedError, match=r"agent.behavior.discount_in_head: True, now False"):
        resume.settle(tmp_path, config)  # such a run had the discount in the head
    config = settings.override(config, "agent.behavior.discount_in_head=true")
    assert resume.settle(tmp_path, config) == config
    content["agent"]["behavior"]["discount_on_feet"] = 1
    files.config.write_text(json.dumps(content))
    with pytest.raises(RefusedError, match=r"unknown \['discount_on_feet'\]"):
        resume.settle(tmp_path, config)


def test_the_command_refuses_with_a_line_for_each_setting_before_anything_is_compiled(tmp_path):
    config = command.configure("smoke", None, None, {})
    with run_directory.claim(tmp_path / "run", config):
        pass
    code, output = invoke(
        command, "--preset", "smoke", "--method", "dreamerv3", "--seed", 3, "--env-steps", 9_000,
        "--logdir", tmp_path / "run",
    )  # fmt: skip
    assert code == 2
    assert "agent.objective: 'NextEmbedding', now 'Reconstruction'" in output
    assert "seed: 0, now 3" in output
    assert "env_steps" not in output.partition("differ in")[2], "which may grow"
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.slow
@pytest.mark.strict
@pytest.mark.usefixtures("quick_compilation")
def test_the_real_loop_goes_on_beyond_its_end_to_the_same_bits(tmp_path):
    say = lambda line: None
    for path, config in (
        ("run", toy.config()),
        ("run", toy.config(env_steps=200, eval_every=60)),
        ("whole", toy.config(env_steps=200, capacity=120)),
    ):
        assert nedreamer.train(config, tmp_path / path, env=toy.env(), echo=say).code == 0
    assert bits(tmp_path / "run") == bits(tmp_path / "whole")


def test_a_capacity_that_is_named_is_the_same_as_the_one_that_is_not():
    config = toy.config()
    named = replace(config, loop=dataclasses.replace(config.loop, capacity=120))
    assert resume.differences(config, named) == []
    assert building.build(config, toy.env()).loop.budget.capacity == 120


def test_workers_of_environments_may_change_and_what_they_run_may_not():
    host = replace(toy.config(), env=HostConfig())
    spread = replace(host, env=HostConfig(workers=1, step_seconds=5.0, on_failure="stop"))
    assert resume.differences(host, spread) == []
    (line,) = resume.differences(host, replace(host, env=HostConfig(action_repeat=2)))
    assert line.startswith("env.action_repeat: ")
