"""One call that trains, one that evaluates, one that loads: with an environment of one's own, and without."""

import json
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax import envs
from ne_dreamer_jax.envs import base, registry
from ne_dreamer_jax.envs.config import GIVEN, DmcConfig, OwnConfig, RoomsConfig, with_images
from ne_dreamer_jax.envs.vector import as_vector, vectorize
from ne_dreamer_jax.runs.run_directory import RefusedError
from tests.experiments import toy

pytestmark = pytest.mark.usefixtures("quick_compilation")

NAME = "tests.experiments.toy:env"


def quiet(_: str) -> None:
    pass


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """A run on an environment that was passed as an object."""
    path = tmp_path_factory.mktemp("given") / "run"
    said = []
    outcome = nedreamer.train(toy.config(), path, env=toy.env(), echo=said.append)
    assert outcome.code == 0
    return path, said


def test_a_run_has_all_that_the_command_makes(given):
    path, said = given
    assert {entry.name for entry in path.iterdir()} >= {"config.json", "metrics.jsonl", "checkpoints", "curve.png"}
    lines = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    assert any("eval/return" in line for line in lines)
    assert lines[-1]["update"] > 0
    assert any("Finished" in line for line in said)


def test_a_run_on_a_given_environment_says_so_and_is_refused_without_it(given):
    path, _ = given
    stored = json.loads((path / "config.json").read_text())
    assert stored["env"] == {"type": "OwnConfig", "task": GIVEN, "action_repeat": 1}
    for call in (nedreamer.load, nedreamer.evaluate, lambda path: nedreamer.train(toy.config(), path, echo=quiet)):
        with pytest.raises((ValueError, RefusedError), match=r"environment given in code|holds another run"):
            call(path)


def test_with_its_environment_it_is_evaluated_and_loaded(given):
    path, _ = given
    result = nedreamer.evaluate(path, env=toy.env(), episodes=3, echo=quiet)
    assert json.loads((path / "evaluation.json").read_text()) == result
    assert len(result["policy"]["returns"]) == 3
    assert result["policy"]["lengths"] == [toy.LENGTH] * 3
    loaded = nedreamer.load(path, env=toy.env(), prefer="newest")
    policy, (_, timestep) = loaded.agent.init_policy(2), jax.vmap(loaded.env.reset)(jax.random.split(jax.random.key(0)))
    _, action = loaded.agent.act(loaded.state.params, policy, timestep, jax.random.key(1), mode="mode")
    assert action.shape == (2, *loaded.env.spec.action.shape)
    assert int(loaded.state.update) > 0


def test_a_run_goes_on_only_with_its_environment(given):
    path, _ = given
    before = (path / "metrics.jsonl").read_bytes()
    said = []
    assert nedreamer.train(toy.config(), path, env=toy.env(), echo=said.append).code == 0
    assert (path / "metrics.jsonl").read_bytes() == before, "it was finished"


def test_another_environment_is_refused_for_a_run_of_a_named_one(tmp_path):
    config = replace(toy.config(), env=DmcConfig("dmc/pendulum_swingup", obs="vector"))
    nedreamer.run_directory.RunDirectory(tmp_path / "run")
    with nedreamer.run_directory.claim(tmp_path / "run", config):
        pass
    with pytest.raises(ValueError, match=r"is a run of dmc/pendulum_swingup; expected no other environment"):
        nedreamer.load(tmp_path / "run", env=toy.env())


def test_a_registered_environment_is_known_by_its_name(monkeypatch):
    monkeypatch.setattr(registry, "_registered", {})
    envs.register("mine/point", toy.env)
    envs.register("mine/point", toy.env)  # the same again, as a notebook's cell does
    with pytest.raises(ValueError, match="another environment has already"):
        envs.register("mine/point", lambda: toy.env())
    with pytest.raises(ValueError, match="begins with none of dmc/"):
        envs.register("dmc/point", toy.env)
    assert "mine/point" in envs.names()
    assert nedreamer.envs.make("mine/point").spec == toy.env().spec
    config = nedreamer.config.override(toy.config(), "env.task=mine/point")
    assert config.env == OwnConfig("mine/point", action_repeat=1)
    back = nedreamer.config.override(config, "env.task=dmc/walker_walk")
    assert back.env == DmcConfig("dmc/walker_walk")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("tests.experiments.toy:en", r"expected a function en in tests.experiments.toy. Did you mean env"),
        ("tests.experiments.nowhere:env", r"No module named 'tests.experiments.nowhere'; run the command where"),
        ("a:b:c", r"expected module:function, such as"),
        ("dmc/waker_walk", r"no environment is called 'dmc/waker_walk'. Did you mean .*dmc/walker_walk"),
    ],
)
def test_names_that_lead_nowhere_are_refused(name, message):
    with pytest.raises(ValueError, match=message):
        envs.make(name)


def test_a_module_and_function_serve_a_new_process(tmp_path):
    """Trained here, evaluated by the command elsewhere, from the name that the run remembers."""
    config = nedreamer.config.override(toy.config(), f"env.task={NAME}")
    assert nedreamer.train(config, tmp_path / "run", echo=quiet).code == 0
    command = [sys.executable, "-m", "ne_dreamer_jax", "evaluate", str(tmp_path / "run"), "--episodes", "2"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert f"{NAME}, ne_dreamer, after 120 environment steps" in done.stdout


def endless() -> base.Env:
    """Never ends."""

    def step(state, action):
        no = jnp.zeros((), bool)
        return state + 1.0, base.Progress(jnp.ones(()), no, no, ~no)

    spec = toy.env().spec
    reset = lambda key: jnp.zeros(())
    (name,) = spec.observation
    observe = lambda state: {name: jnp.broadcast_to(state, spec.observation[name].shape)}
    return base.from_core(base.Core(spec, reset, base.restart_or_step(reset, step), observe))


@pytest.mark.slow
def test_an_environment_that_never_ends_is_evaluated_up_to_the_bound(tmp_path):
    said = []
    outcome = nedreamer.train(toy.config(eval_max_steps=100), tmp_path / "run", env=endless(), echo=said.append)
    assert outcome.code == 0
    assert any("had not ended after 100 steps" in line for line in said)
    result = nedreamer.evaluate(tmp_path / "run", env=endless(), episodes=2, echo=quiet)
    assert result["policy"]["unfinished"] == 2
    assert result["policy"]["lengths"] == [100, 100]


@pytest.mark.slow
def test_without_evaluations_there_are_none(tmp_path):
    said = []
    assert nedreamer.train(toy.config(eval_every=None), tmp_path / "run", env=endless(), echo=said.append).code == 0
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert not any(name.startswith("eval/") for line in lines for name in line)
    assert not any("Evaluation return" in line for line in said)
    assert nedreamer.load(tmp_path / "run", env=endless()).state.update > 0


def test_play_keeps_what_was_seen_and_done(given):
    path, _ = given
    loaded = nedreamer.load(path, env=toy.env())
    play = nedreamer.loop.make_play(vectorize(loaded.env), loaded.agent, max_steps=50, chunk_steps=4)
    played = play(loaded.state.params, jax.random.key(0), 3, steps=True)
    steps = played.steps
    assert steps.counts[: toy.LENGTH + 1].all()
    assert not steps.counts[toy.LENGTH + 1 :].any()
    np.testing.assert_allclose((steps.reward * steps.counts).sum(0), played.returns, rtol=1e-6)
    assert steps.latent.deter.shape[:2] == steps.action.shape[:2] == steps.counts.shape


@pytest.mark.parametrize("bound", [3, 4, toy.LENGTH])
def test_episodes_are_played_up_to_the_bound_and_no_further(given, bound):
    loaded = nedreamer.load(given[0], env=toy.env())
    make = lambda bound: nedreamer.loop.make_play(vectorize(loaded.env), loaded.agent, max_steps=bound, chunk_steps=4)
    played = make(bound)(loaded.state.params, jax.random.key(0), 2, steps=True)
    whole = make(50)(loaded.state.params, jax.random.key(0), 2, steps=True)
    assert np.asarray(played.lengths).tolist() == [bound] * 2
    assert played.unfinished == (2 if bound < toy.LENGTH else 0)
    np.testing.assert_allclose(whole.steps.reward[: bound + 1].sum(0), played.returns, rtol=1e-5)


def test_images_that_the_agent_does_not_see_change_nothing_and_are_kept(given):
    path, _ = given
    loaded = nedreamer.load(path, env=toy.env())
    play = lambda env: nedreamer.loop.make_play(as_vector(env), loaded.agent, max_steps=50, chunk_steps=4)(
        loaded.state.params, jax.random.key(0), 3, frames=True, steps=True
    )
    plain, shown = play(loaded.env), play(toy.env(image=True))
    assert plain.frames is None
    assert shown.frames.shape == (toy.LENGTH + 1, 4, 4, 3)
    np.testing.assert_array_equal(shown.returns, plain.returns)
    assert set(shown.steps.obs) - set(plain.steps.obs) == {"image"}


def test_vectors_of_dmc_are_drawn_for_a_video():
    assert with_images(DmcConfig(obs="vector", image_size=32)) == DmcConfig(obs="both", image_size=64)
    assert with_images(DmcConfig(obs="vector", image_size=96)) == DmcConfig(obs="both", image_size=96)
    for same in (DmcConfig(), RoomsConfig()):
        assert with_images(same) is same


@pytest.mark.parametrize(
    ("given", "advice"),
    [
        (toy.env, "got a function; call it"),
        (base.Core(toy.env().spec, None, None, None), "got a Core; envs.base.from_core"),
        ("toy", "got a str; see envs.base.from_core"),
    ],
)
def test_what_is_no_environment_is_refused_with_what_to_make_of_it(tmp_path, given, advice):
    with pytest.raises(ValueError, match=advice):
        nedreamer.train(toy.config(), tmp_path / "run", env=given, echo=quiet)
    with pytest.raises(ValueError, match=advice):
        envs.conformance.check(given, jax.random.key(0), echo=quiet)


def test_a_step_that_returns_another_state_than_reset_is_named():
    reset = lambda key: (jnp.zeros(2),)
    step = lambda state, action: (state[0], base.Progress(*jnp.zeros((4,))))
    observe = lambda state: {"position": state[0]}
    with pytest.raises(ValueError, match="the state that step returns: expected the structure"):
        base.from_core(base.Core(toy.env().spec, reset, base.restart_or_step(reset, step), observe))


@pytest.mark.parametrize("name", ["reset", "step", "observe"])
def test_what_is_no_function_in_a_core_is_named(name):
    core = base.Core(toy.env().spec, lambda key: (), lambda *_: (), lambda state: {})._replace(**{name: None})
    with pytest.raises(ValueError, match=f"Core.{name}: expected a function, got None"):
        base.from_core(core)
