"""A run that begins with another's agent has its bits, says whose it is, and needs it no more."""

import json
import shutil
import signal
from dataclasses import replace

import jax
import pytest

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax import config as configs
from ne_dreamer_jax.commands import train as command
from ne_dreamer_jax.envs.config import DmcConfig
from ne_dreamer_jax.runs import checkpoint, endings, fork, metrics, run_directory, training
from ne_dreamer_jax.runs.run_directory import RefusedError, RunDirectory
from ne_dreamer_jax.types import ContinuousAction, DiscreteAction
from tests.experiments import stub, toy
from tests.experiments.test_commands import invoke
from tests.experiments.test_training import terminate


@pytest.fixture(autouse=True)
def without_pictures(monkeypatch):
    monkeypatch.setattr(training, "draw", lambda *_: None)


def train(path, config, parent=None, at=None):
    """A run of the stub, stopped at the first line with a text; its code and lines."""
    run, lines = stub.build(config, image=False), []

    def echo(line):
        lines.append(line)
        if at is not None and at in line:
            terminate(line)

    if parent is not None:
        fork.check(parent, path)
        fork.check_agent(parent, path, config, run.agent.spec, run.shapes.train)
    with run_directory.claim(path, config) as files:
        return training.train(run, files, checkpoint_minutes=1e9, echo=echo, parent=parent), lines


def agents(path):
    """Step -> digest of the agent."""
    found = checkpoint.checkpoints(path / "checkpoints")
    return {entry.step: checkpoint.digest(entry, "agent") for entry in found}


@pytest.fixture(scope="module")
def parent(tmp_path_factory):
    path = tmp_path_factory.mktemp("parent") / "run"
    assert train(path, toy.config(eval_every=None))[0] == 0
    return path


@pytest.mark.strict
def test_a_fork_begins_with_the_agent_to_the_bit_and_ends_without_its_parent(parent, tmp_path):
    other = toy.config(eval_every=None, num_envs=4, replay_ratio=2.0)
    mine = shutil.copytree(parent, tmp_path / "parent")
    code, lines = train(tmp_path / "fork", other, mine, at="Saved the agent and the loop")
    assert code == 128 + signal.SIGTERM
    assert any(f"Took over the agent of {mine}" in line and "120 environment steps" in line for line in lines)
    assert agents(tmp_path / "fork")[0] == agents(mine)[120]
    origin = json.loads((tmp_path / "fork" / "parent.json").read_text())
    assert origin == {"path": str(mine), "env_step": 120, "agent_sha256": agents(mine)[120]}
    shutil.rmtree(mine)
    assert train(tmp_path / "fork", other, mine)[0] == 0, "the same command goes on, although the parent is gone"
    lines = metrics.read(tmp_path / "fork" / "metrics.jsonl")
    assert lines[-1]["env_step"] == 120
    assert lines[-1]["update"] > 50, "updates are counted on"


@pytest.mark.strict
def test_a_fork_that_was_cut_short_before_its_first_checkpoint_begins_again(parent, tmp_path, monkeypatch):
    config = toy.config(eval_every=None, env_steps=40)
    monkeypatch.setattr(checkpoint, "free_space", lambda _: 10)
    assert train(tmp_path / "fork", config, parent, at="Compiling")[0] == endings.NOT_SAVED
    monkeypatch.undo()
    code, lines = train(tmp_path / "fork", config)  # without saying again whose agent it is
    assert code == 0
    assert any("Took over the agent of" in line for line in lines)


def test_what_is_no_parent_is_refused_and_leaves_no_directory(parent, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(RefusedError, match="expected a run directory"):
        fork.check(tmp_path / "empty", tmp_path / "new")
    with pytest.raises(RefusedError, match=r"--fork .*: expected another run than the one in --logdir"):
        fork.check(parent, parent)
    with run_directory.claim(tmp_path / "unstarted", configs.preset("smoke")):
        pass
    with pytest.raises(RefusedError, match="expected a run with a checkpoint, and it has none"):
        fork.check(tmp_path / "unstarted", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_run_that_began_otherwise_is_refused(parent, tmp_path):
    mine = shutil.copytree(parent, tmp_path / "begun")
    with pytest.raises(RefusedError, match=r"holds a run that began anew\. Leave out --fork"):
        fork.check(parent, mine)
    run_directory.write_parent(RunDirectory(mine), {"path": "/somewhere/else"})
    with pytest.raises(RefusedError, match="began with the agent of /somewhere/else"):
        fork.check(parent, mine)
    (mine / "parent.json").write_text("[1]")
    with pytest.raises(RefusedError, match=r"parent.json is damaged"):
        fork.check(parent, mine)


def test_an_agent_of_other_shapes_or_another_action_is_refused_with_what_differs(parent, tmp_path):
    run = stub.build(toy.config(), image=False)
    check = lambda config, spec, like: fork.check_agent(parent, tmp_path / "new", config, spec, like)
    larger = run.shapes.train._replace(params={"actor": {"kernel": jax.ShapeDtypeStruct((4,), "float32")}})
    with pytest.raises(ValueError, match=r"expected an agent of the same shapes(.|\n)*float32\[4\], got float32\[3\]"):
        check(run.config, run.agent.spec, larger)
    mine = shutil.copytree(parent, tmp_path / "pendulum")
    config = replace(toy.config(eval_every=None), env=DmcConfig("dmc/pendulum_swingup", obs="vector"))
    run_directory.store_config(RunDirectory(mine), config)
    spec = run.agent.spec._replace(action=DiscreteAction(2))
    assert spec.action != ContinuousAction(1)
    with pytest.raises(ValueError, match=r"expected an environment with the same observations and actions, got\n  dmc"):
        fork.check_agent(mine, tmp_path / "new", run.config, spec, run.shapes.train)


def test_a_head_that_learned_something_else_is_refused_with_what_to_set(parent, tmp_path):
    """A parent whose head holds the discount, as in a config.json older than the setting, would be discounted twice."""
    mine = shutil.copytree(parent, tmp_path / "older")
    config = toy.config(eval_every=None)
    inside = configs.override(config, "agent.behavior.discount_in_head=true")
    run_directory.store_config(RunDirectory(mine), inside)
    run = stub.build(config, image=False)
    check = lambda config: fork.check_agent(mine, tmp_path / "new", config, run.agent.spec, run.shapes.train)
    with pytest.raises(ValueError, match=r"got false; add --set agent\.behavior\.discount_in_head=true"):
        check(config)
    check(inside)


def test_the_command_refuses_a_parent_that_is_none(tmp_path):
    code, output = invoke(command, "--preset", "smoke", "--fork", tmp_path, "--logdir", tmp_path / "run")
    assert (code, "expected a run directory" in output) == (2, True)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.strict
@pytest.mark.usefixtures("quick_compilation")
def test_the_real_agent_is_taken_over_and_goes_on_to_learn(tmp_path):
    say = lambda line: None
    assert nedreamer.train(toy.config(), tmp_path / "parent", env=toy.env(), echo=say).code == 0
    config = toy.config(env_steps=60)
    agent = replace(config.agent, optimizer=replace(config.agent.optimizer, learning_rate=1e-5))
    config = replace(config, agent=agent, seed=3)
    outcome = nedreamer.train(config, tmp_path / "fork", env=toy.env(), fork=tmp_path / "parent", echo=say)
    assert outcome.code == 0
    origin = json.loads((tmp_path / "fork" / "parent.json").read_text())
    assert origin["agent_sha256"] == agents(tmp_path / "parent")[120]
    before = nedreamer.load(tmp_path / "parent", env=toy.env(), prefer="newest").state
    after = nedreamer.load(tmp_path / "fork", env=toy.env(), prefer="newest").state
    assert int(after.update) > int(before.update)
    wider = replace(config, agent=replace(agent, heads=replace(agent.heads, units=16)))
    with pytest.raises(ValueError, match="expected an agent of the same shapes"):
        nedreamer.train(wider, tmp_path / "wide", env=toy.env(), fork=tmp_path / "parent", echo=say)
    assert not (tmp_path / "wide").exists()


def test_a_parent_that_is_damaged_is_named(parent, tmp_path):
    gone = shutil.copytree(parent, tmp_path / "gone")
    for arrays in (gone / "checkpoints").glob("*/agent/arrays"):
        arrays.write_bytes(b"")
    with pytest.raises(RefusedError, match=r"gone, the run to begin with: no checkpoint in .* is intact"):
        train(tmp_path / "fork", toy.config(eval_every=None, env_steps=40), gone)
