"""The README's commands are the ones that are checked."""

import re
import sys
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ne_dreamer_jax as nedreamer
from experiments import train
from ne_dreamer_jax import make_agent
from ne_dreamer_jax.envs import host, registry
from ne_dreamer_jax.settings import names
from tests.envs import fakes
from tests.experiments import toy

pytestmark = pytest.mark.usefixtures("quick_compilation")

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_check_is_what_the_clean_clone_runs():
    commands = re.findall(r"^python3 -m venv .*$", README, re.MULTILINE)
    assert len(commands) == 2
    assert (ROOT / ".ci" / "run").read_text().splitlines()[-1] == commands[1]


def test_every_option_and_preset_in_the_readme_exists():
    options = {name for option in train.main.params for name in option.opts}
    for command in re.findall(r"experiments\.train (.*)$", README, re.MULTILINE):
        assert set(re.findall(r"--[a-z-]+", command)) <= options
        assert set(re.findall(r"--preset (\S+)", command)) <= set(names.PRESETS)


def test_every_path_in_the_readme_exists():
    for row in re.findall(r"^\| (`.*?`) \|", README.split("## Where things are")[1], re.MULTILINE):
        for path in re.findall(r"`([^`]+)`", row):
            assert (ROOT / path).exists() or (ROOT / "ne_dreamer_jax" / path).exists(), path


def blocks(heading):
    """The Python code under a heading of the README."""
    text = README.split(f"\n{heading}\n")[1].split("\n#")[0]
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


@pytest.fixture
def tiny_runs(tmp_path, monkeypatch):
    """The folder that runs of the README's code go to, with a tiny agent in place of a preset's."""
    monkeypatch.chdir(tmp_path)
    tiny = toy.config()
    monkeypatch.setattr("ne_dreamer_jax.config.preset", lambda name: tiny)
    monkeypatch.setattr("ne_dreamer_jax.config.override", lambda config, assignment: config)
    return tmp_path / "runs"


def test_the_readmes_gymnasium_environment_is_trained_in(tiny_runs):
    made: dict[str, Any] = {}
    code, _ = blocks("### Environments of gymnasium and dm_env")
    exec(compile(code, "README.md", "exec"), made)
    made["env"].host.close()
    assert made["env"].spec.observation["vector"].shape == (3,)
    assert (tiny_runs / "pendulum" / "curve.png").exists()


@pytest.mark.slow
def test_the_readmes_dm_env_environment_is_trained_in(tiny_runs):
    _, code = blocks("### Environments of gymnasium and dm_env")
    made: dict[str, Any] = {"host": host, "nedreamer": nedreamer, "config": toy.config()}
    exec(compile(code, "README.md", "exec"), made)
    made["env"].host.close()
    assert set(made["env"].spec.observation) == {"position", "to_target", "velocity"}
    assert (tiny_runs / "reacher" / "curve.png").exists()


@pytest.mark.slow
def test_the_readmes_gymnax_environment_is_trained_in(tiny_runs, monkeypatch):
    """With a stand-in for the library, whose package tests do not need."""
    (code,) = blocks("### Environments of other JAX libraries")
    asked = []

    class Parameters:
        def replace(self, **changes: int) -> fakes.Params:
            asked.append(changes)
            return fakes.Params()

    library: Any = types.ModuleType("gymnax")
    library.make = lambda name: (fakes.Gymnax(), Parameters())
    monkeypatch.setitem(sys.modules, "gymnax", library)
    exec(compile(code, "README.md", "exec"), {})
    assert asked == [{"memory_length": 20}]
    assert (tiny_runs / "chain" / "evaluation.json").exists()


def test_the_readmes_environment_is_one(tmp_path, monkeypatch):
    """Its code runs as it stands, trained with a tiny agent in place of a preset's."""
    monkeypatch.chdir(tmp_path)
    tiny = toy.config()
    monkeypatch.setattr("ne_dreamer_jax.config.preset", lambda name: tiny)
    monkeypatch.setattr(registry, "_registered", {})
    made = {}
    for code in blocks("### Your own environment"):
        exec(compile(code, "README.md", "exec"), made)
    assert (tmp_path / "runs" / "corridor" / "evaluation.json").exists()
    assert nedreamer.load("runs/named").config.env.task == "mine/corridor"
    env = made["corridor"]()
    state, _ = env.reset(jax.random.key(0))
    for _ in range(6):  # to the right, as far as any corridor goes
        state, timestep = env.step(state, jnp.ones((), jnp.int32))
        if timestep.is_last:
            break
    assert timestep.is_terminal
    assert float(timestep.reward) == 1.0


def test_the_readmes_loop_acts():
    _, code = blocks("## As a library")
    env, key = toy.env(), jax.random.key(0)
    agent = make_agent(toy.config().agent, env.spec)
    given = {"env": env, "agent": agent, "state": agent.init(key), "jax": jax, "keys": jax.random.split(key, 2)}
    exec(compile(code.replace("500", "3"), "README.md", "exec"), given)
    assert given["timestep"].reward.shape == (2,)
    assert (given["env_state"].steps == 2).all()


def test_the_readmes_episodes_are_learned_from():
    (code,) = blocks("### Your own episodes")
    config = toy.config()
    env = toy.env()
    agent = make_agent(config.agent, env.spec)
    obs, actions, rewards = np.zeros((8, 1)), np.zeros((7, 1)), np.zeros(7)
    given = {"config": config, "env": env, "agent": agent, "state": agent.init(jax.random.key(0)), "jax": jax}
    given |= {"obs": obs, "actions": actions, "rewards": rewards, "nedreamer": nedreamer}
    code = code.replace('{"vector": obs}', '{"position": obs}').replace("[episode, ...]", "[episode]")
    exec(compile(code.replace("1_000", "2"), "README.md", "exec"), given)
    assert int(given["state"].update) == 2
