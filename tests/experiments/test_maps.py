"""Rooms tasks from above: what is played, drawn and refused."""

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

from experiments import maps as command
from ne_dreamer_jax import make_agent
from ne_dreamer_jax.envs.config import RoomsConfig
from ne_dreamer_jax.envs.rooms import names, nonmatching, players, tasks
from ne_dreamer_jax.envs.rooms.game import State
from ne_dreamer_jax.runs import evaluation, maps, video
from tests.experiments import toy

NAME = "rooms/select_nonmatching_object_small"

pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.fixture(scope="module")
def seen(quick_compilation):
    game, forward = tasks.game(NAME), jnp.zeros((), jnp.int32)
    act = lambda timestep, state, kept, key: (forward, kept)
    return maps.play(tasks.make(NAME, image_size=8, length=9), game, act, (), jax.random.key(0), 9)


def test_an_episode_is_seen_as_it_was_played(seen):
    """Straight ahead leads onto the pad and through the teleport, which leaves a gap in the path."""
    at = nonmatching.places(tasks.NONMATCHING[NAME])
    assert len(seen.yaw) == 10, "the first time step, and nine later ones"
    np.testing.assert_array_equal(seen.position[0], at.start)
    paid = int(np.flatnonzero(seen.reward)[0])
    assert seen.reward[paid] == 1.0
    assert seen.position[paid - 1, 0] < at.room_1[1]
    assert seen.position[paid, 0] >= at.exit[0]
    path = maps._path(seen, 0, 10)
    assert np.isnan(path[paid]).all()
    assert np.isfinite(np.delete(path, paid, axis=0)).all()
    assert seen.items.shape == (10, 4, 2)
    assert seen.image.shape == (10, 8, 8, 3)


def test_pictures_and_films_are_drawn(seen, tmp_path, monkeypatch):
    kept = {}
    monkeypatch.setattr(video, "write", lambda frames, path, fps: kept.update(frames=frames, fps=fps))
    maps.picture(seen, tmp_path / "map.png", "a title")
    maps.film(seen, tmp_path / "map.mp4", "a title", 15.0)
    assert (tmp_path / "map.png").read_bytes()[1:4] == b"PNG"
    frames = kept["frames"]
    assert frames.dtype == np.uint8
    assert len(frames) == 10
    assert (frames[0] != frames[5]).any(), "the player moves"


def test_a_player_for_every_task_keeps_what_it_returns():
    for name in names.NAMES:
        player, (body, task) = players.scripted(name), tasks.game(name).begin(jax.random.key(0))
        state = State(body, jnp.zeros((), jnp.int32), task)
        action, kept = jax.eval_shape(player.act, state, player.start, jax.random.key(0))
        assert (action.shape, action.dtype) == ((), jnp.int32)
        assert jax.tree.map(jnp.shape, kept) == jax.tree.map(jnp.shape, player.start)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rooms/watermase"], "no Rooms task is called 'rooms/watermase'. Did you mean rooms/watermaze"),
        (
            ["rooms/watermaze", "--player", "scriptd"],
            "no player is called 'scriptd', and no run lies there. Did you mean",
        ),
        (["rooms/watermaze", "--seed", "-1"], "-1 is not in the range"),
    ],
)
def test_what_is_impossible_is_refused(arguments, message):
    result = CliRunner().invoke(command.main, arguments)
    assert result.exit_code == 2
    assert message in " ".join(result.output.split())


def test_a_mistyped_name_is_told_before_jax_loads():
    code = "import sys; from experiments import maps; assert 'jax' not in sys.modules; maps.main(['rooms/watermase'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr


@pytest.mark.slow
def test_the_policy_of_a_run_plays(monkeypatch):
    """In its own task, and in none that looks otherwise."""
    options = RoomsConfig(NAME, image_size=16, length=5)
    env, agent_config = tasks.make(NAME, image_size=16, length=5), toy.config().agent
    agent = make_agent(agent_config, env.spec)
    config = dataclasses.replace(toy.config(), env=options)
    state = agent.init(jax.random.key(0))
    monkeypatch.setattr(evaluation, "load", lambda path: evaluation.Loaded(config, env, agent, state, None, ()))
    seen, seconds = command.played(NAME, "a run", 0)
    assert seen.image.shape == (6, 16, 16, 3)
    assert seconds == pytest.approx(4 / 60)
    other = make_agent(agent_config, tasks.make(NAME, image_size=32).spec)
    monkeypatch.setattr(evaluation, "load", lambda path: evaluation.Loaded(config, env, other, state, None, ()))
    with pytest.raises(ValueError, match=r"a run: expected an agent for .*16, 16.* got one for .*32, 32"):
        command.played(NAME, "a run", 0)
