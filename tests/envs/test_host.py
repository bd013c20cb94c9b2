"""Environments of other libraries in worker processes: what agents see of them, and what becomes of failures."""

from __future__ import annotations

import functools
import gc
import os
import re
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax import envs
from ne_dreamer_jax.envs import conformance
from ne_dreamer_jax.envs.host import Options, Workers, dmlab, factories, from_dm_env, from_gymnasium, players, spaces
from ne_dreamer_jax.envs.vector import VectorEnv
from ne_dreamer_jax.types import ArraySpec, ContinuousAction, DiscreteAction, TimeStep
from tests.envs import host_fakes

KEYS = jax.random.split(jax.random.key(3), 4)


# Spaces.


def seen(space: Any, value: Any, image_size: int | None = 8) -> tuple[str, np.ndarray]:
    name, shape, dtype, read = spaces.observation("", space, image_size)
    result = read(value)
    assert result.shape == shape
    assert result.dtype == dtype
    return name, result


def test_numbers_of_any_dtype_become_float32_vectors():
    for dtype in (np.int64, np.float64, np.int8, np.float16, np.bool_):
        space = gymnasium.spaces.Box(0, 1, (2, 3), dtype) if dtype != np.bool_ else players._Array((2, 3), np.bool_)
        name, value = seen(space, np.ones((2, 3), dtype))
        assert name == "vector"
        np.testing.assert_array_equal(value, np.ones(6, np.float32))
    assert seen(gymnasium.spaces.Box(0, 1, (), np.float32), np.float32(0.5))[1].tolist() == 0.5
    assert seen(gymnasium.spaces.MultiBinary(3), np.array([1, 0, 1], np.int8))[1].tolist() == [1, 0, 1]


def test_choices_become_one_hot_vectors():
    assert seen(gymnasium.spaces.Discrete(4, start=-1), -1)[1].tolist() == [1, 0, 0, 0]
    assert seen(gymnasium.spaces.MultiDiscrete([2, 3]), np.array([1, 2]))[1].tolist() == [0, 1, 0, 0, 1]
    with pytest.raises(ValueError, match="expected values in"):
        seen(gymnasium.spaces.Discrete(4), 4)


def test_images_are_scaled_by_means_of_areas():
    image = np.zeros((16, 16, 3), np.uint8)
    image[:8, :8] = (200, 100, 50)
    image[8:10, 8:10] = 100
    name, value = seen(gymnasium.spaces.Box(0, 255, (16, 16, 3), np.uint8), image)
    assert name == "image"
    np.testing.assert_array_equal(value[:4, :4], np.broadcast_to([200, 100, 50], (4, 4, 3)))
    np.testing.assert_array_equal(value[4, 4], 100)
    assert value[5:, 5:].max() == 0
    larger = seen(gymnasium.spaces.Box(0, 255, (4, 4, 1), np.uint8), np.arange(16, dtype=np.uint8).reshape(4, 4, 1))[1]
    np.testing.assert_array_equal(larger[::2, ::2, 0], np.arange(16).reshape(4, 4))


def test_a_picture_without_channels_gets_one():
    assert seen(gymnasium.spaces.Box(0, 255, (8, 8), np.uint8), np.ones((8, 8), np.uint8))[1].shape == (8, 8, 1)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (gymnasium.spaces.Box(0, 255, (3, 64, 64), np.uint8), "channels first; move them by a wrapper"),
        (gymnasium.spaces.Box(0, 255, (64, 64, 9), np.uint8), "with 1 to 4 channels"),
        (gymnasium.spaces.Box(0, 1, (64, 64, 3), np.float32), "expected images as uint8"),
        (gymnasium.spaces.Box(0, 255, (2, 64, 64, 3), np.uint8), "expected images as uint8"),
        (gymnasium.spaces.Text(4), "expected a Box, Discrete"),
        (gymnasium.spaces.Discrete(10**6), "as a one-hot vector"),
    ],
)
def test_observations_that_no_encoder_takes_are_named_with_what_to_do(space, message):
    with pytest.raises(ValueError, match=f"observation 'front'.*{message}"):
        spaces.observation("front", space, 64)


def test_nested_observations_are_joined():
    space = gymnasium.spaces.Dict(
        {
            "a": gymnasium.spaces.Dict({"b": gymnasium.spaces.Discrete(2)}),
            "t": gymnasium.spaces.Tuple([gymnasium.spaces.Discrete(2)]),
        }
    )
    assert [name for name, _ in spaces.leaves(space)] == ["a/b", "t/0"]
    assert spaces.flat({"a": {"b": 1}, "t": (0,)}) == {"a/b": 1, "t/0": 0}


def test_actions_are_scaled_to_the_bounds_and_clipped_there():
    size, discrete, scaled = spaces.action(
        gymnasium.spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([4.0, 1.0], np.float32), dtype=np.float32)
    )
    assert (size, discrete) == (2, False)
    np.testing.assert_array_equal(scaled(np.array([0.0, 0.0])), np.array([1.0, 0.5], np.float32))
    np.testing.assert_array_equal(scaled(np.array([-9.0, 9.0])), np.array([-2.0, 1.0], np.float32))
    size, discrete, chosen = spaces.action(gymnasium.spaces.Discrete(3, start=5))
    assert (size, discrete, chosen(np.int32(2))) == (3, True, 7)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (gymnasium.spaces.Box(-np.inf, 1.0, (2,), np.float32), "finite bounds"),
        (gymnasium.spaces.Box(0, 3, (2,), np.int32), "box of int32"),
        (gymnasium.spaces.MultiDiscrete([2, 3]), "expected a Discrete action space"),
        (gymnasium.spaces.MultiBinary(2), "expected a Discrete action space"),
    ],
)
def test_actions_that_no_agent_takes_are_named(space, message):
    with pytest.raises(ValueError, match=message):
        spaces.action(space)


# One environment.


def test_truncated_is_last_and_terminated_is_terminal():
    for made, terminal in ((host_fakes.Counting(terminal=2), True), (host_fakes.Counting(limit=2), False)):
        player = players.GymnasiumPlayer(made, Options())
        assert player.reset(0)["count"][0] == 0
        assert not player.step(np.int32(0)).is_last
        end = player.step(np.int32(0))
        assert (end.is_last, end.is_terminal) == (True, terminal)
        assert end.obs["count"][0] == 2  # the frame at which it ended


def test_repeated_actions_sum_rewards_and_end_with_the_episode():
    player = players.GymnasiumPlayer(host_fakes.Counting(terminal=5), Options(action_repeat=3))
    player.reset(0)
    assert player.step(np.int32(1)).reward == 18.0
    end = player.step(np.int32(1))
    assert (end.reward, end.is_last) == (12.0, True)


def test_dm_env_ends_are_terminal_where_the_discount_is_zero():
    for discount in (0.0, 1.0):
        player = players.DmEnvPlayer(host_fakes.Walk(discount), Options(action_repeat=4))
        np.testing.assert_array_equal(player.reset(None)["phase"], [1, 0, 0, 0])
        assert player.step(np.array([0.5])).reward == 6.0
        end = player.step(np.array([7.0]))
        assert (end.reward, end.is_last, end.is_terminal) == (6.0, True, discount == 0.0)
        np.testing.assert_array_equal(end.obs["t"], 6.0)


class Lab:
    """A stand-in for deepmind_lab's, with its interface."""

    def __init__(self, level: str, observations: list[str], config: dict[str, str], renderer: str) -> None:
        assert (observations, renderer) == (["RGB_INTERLEAVED"], "software")
        assert level in ("contributed/dmlab30/rooms_x", "contributed/dmlab30/rooms_x_test")
        if level.endswith("_test"):  # held out, as the real one says
            assert config.get("allowHoldOutLevels") == "true"
        self.size, self.frames, self.seed = int(config["width"]), 0, None

    def reset(self, seed: int | None = None) -> None:
        self.frames, self.seed = 0, seed

    def is_running(self) -> bool:
        return self.frames < 10

    def observations(self) -> dict[str, np.ndarray]:
        assert self.is_running()  # as the real one demands
        return {"RGB_INTERLEAVED": np.full((self.size, self.size, 3), self.frames, np.uint8)}

    def step(self, action: np.ndarray, num_steps: int) -> float:
        assert (action.shape, action.dtype) == ((7,), np.intc)
        self.frames += num_steps
        return float(action[3])


def test_dmlab_is_stepped_by_its_own_interface(monkeypatch):
    monkeypatch.setitem(sys.modules, "deepmind_lab", SimpleNamespace(Lab=Lab))
    player = dmlab.LabPlayer("rooms_x", Options(image_size=16, action_repeat=4))
    assert player.described.observations == {"image": ((16, 16, 3), "uint8")}
    assert player.described.actions == 9
    assert player.reset(3)["image"].max() == 0
    forward, back = player.step(np.int32(0)), player.step(np.int32(1))
    assert (forward.reward, forward.obs["image"].max(), forward.is_last) == (1.0, 4, False)
    assert (back.reward, back.obs["image"].max(), back.is_last) == (-1.0, 8, False)
    end = player.step(np.int32(8))
    assert (end.obs["image"].max(), end.is_last, end.is_terminal) == (8, True, False)
    assert player.reset(None)["image"].max() == 0
    dmlab.LabPlayer("rooms_x_test", Options(image_size=16))


def test_lists_of_observations_are_seen_by_their_places():
    class Listing(host_fakes.Walk):
        def observation_spec(self):
            return list(super().observation_spec().values())

        def _obs(self):
            return list(super()._obs().values())

    player = players.DmEnvPlayer(Listing(), Options())
    assert {name: x.tolist() for name, x in player.reset(None).items()} == {"0": 0.0, "1": [1, 0, 0, 0]}


# N environments.


def counting(workers: Workers | None = None, **options: Any) -> VectorEnv:
    return from_gymnasium(functools.partial(host_fakes.Counting, **options), workers=workers)


def play(env: VectorEnv, steps: int, keys: jax.Array = KEYS, action: Any = None) -> tuple[Any, list[TimeStep]]:
    spec = env.spec.action
    if action is None:
        action = jnp.zeros((len(keys), *spec.shape), spec.dtype)
    state, step, timesteps = env.prepare(keys), jax.jit(env.step), []
    for _ in range(steps):
        state, timestep = step(state, action)
        timesteps.append(jax.device_get(timestep))
    return state, timesteps


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: from_gymnasium(host_fakes.BeginsOnce), "RuntimeError: no level found"),
        (
            lambda: from_gymnasium(lambda: gymnasium.make("CartPole-v1"), Options("pixels")),
            "expected a picture",
        ),
        (lambda: from_dm_env(host_fakes.Walk, Options("pixels")), "without physics to draw"),
        (lambda: from_gymnasium(lambda: None), "expected a gymnasium.Env of the factory, got None"),
        (lambda: from_dm_env(host_fakes.Counting), "expected a dm_env.Environment of the factory"),
    ],
)
def test_what_cant_begin_an_episode_is_refused_when_it_is_made(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obs": "pictures"}, "obs: expected own, pixels or both, got 'pictures'"),
        ({"image_size": -3}, "image_size: expected an integer from 1 to 4,096, got -3"),
        ({"action_repeat": 0}, "action_repeat: expected an integer from 1 to 1,000,000, got 0"),
        ({"workers": -1}, "workers: expected an integer from 1 to 65,536 or none, got -1"),
        ({"step_seconds": -1.0}, r"step_seconds: expected a number from 0.001 to 1e\+06, got -1.0"),
        ({"on_failure": "stpo"}, "on_failure: expected restart or stop, got 'stpo'"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        envs.make("gym:CartPole-v1", **options)


def test_a_factory_that_holds_an_environment_is_refused():
    lock = threading.Lock()
    with pytest.raises(ValueError, match="expected a factory that makes the environment where it is called"):
        from_gymnasium(lambda: (lock, host_fakes.Counting())[1])


def test_environments_of_a_worker_have_a_steps_time_each():
    env = from_gymnasium(host_fakes.SlowToBegin, workers=Workers(processes=1, step_seconds=1.5))
    _, timesteps = play(env, 2, KEYS[:2])
    assert env.host.lines() == []
    assert not timesteps[0].is_last.any()
    env.host.close()


def test_an_environment_that_is_made_anew_begins_as_its_seed_says():
    """Also after an error of its own, so that a run in which it fails repeats."""
    starts = []
    for _ in range(2):
        env = from_gymnasium(functools.partial(host_fakes.Failing, "raises"), workers=Workers(processes=1))
        _, timesteps = play(env, 9, KEYS[:1])
        starts.append([float(t.obs["count"][0, 1]) for t in timesteps if t.is_first[0]])
        env.host.close()
    assert len(starts[0]) == len(set(starts[0])) > 1
    assert starts[0] == starts[1]


def column(timesteps: list[TimeStep], name: str, env: int) -> list[Any]:
    return [getattr(timestep, name)[env].item() for timestep in timesteps]


def counts(timesteps: list[TimeStep], env: int) -> list[float]:
    return [timestep.obs["count"][env, 0].item() for timestep in timesteps]


@pytest.fixture(autouse=True)
def ended(request):
    """No worker outlives its test."""
    before = set(children())
    yield
    for made in MADE:
        made.host.close()
    MADE.clear()
    assert set(children()) <= before


MADE: list[VectorEnv] = []


def made(env: VectorEnv) -> VectorEnv:
    MADE.append(env)
    return env


def children() -> list[int]:
    found = subprocess.run(
        ["ps", "-ww", "-o", "pid=,ppid=,args=", "-A"], capture_output=True, text=True, check=True
    ).stdout
    rows = [line.split(None, 2) for line in found.splitlines()]
    return [int(row[0]) for row in rows if int(row[1]) == os.getpid() and "host.worker" in row[2]]


def alive(pid: int) -> bool:
    """Whether there is such a process, and no mere entry of one that has ended."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_episodes_follow_one_another_with_their_ends_kept():
    env = made(counting(Workers(processes=2), terminal=3))
    assert env.spec.action == DiscreteAction(3)
    assert env.spec.observation == {"count": ArraySpec((2,), jnp.dtype("float32"))}
    _, timesteps = play(env, 9)
    for i in range(4):
        assert counts(timesteps, i) == [0, 1, 2, 3, 0, 1, 2, 3, 0]
        assert column(timesteps, "is_first", i) == [True, False, False, False, True, False, False, False, True]
        assert column(timesteps, "is_last", i) == column(timesteps, "is_terminal", i)
        assert column(timesteps, "is_last", i) == [False, False, False, True, False, False, False, True, False]
        assert column(timesteps, "reward", i) == [0, 5, 5, 5, 0, 5, 5, 5, 0]


def test_time_limits_are_not_terminal():
    _, timesteps = play(made(counting(limit=2)), 3)
    assert column(timesteps, "is_last", 0) == [False, False, True]
    assert not any(column(timesteps, "is_terminal", 0))


def test_the_same_keys_begin_the_same_episodes_and_each_episode_is_another():
    env = made(counting(Workers(processes=3), terminal=2))
    starts = []
    for _ in range(2):
        state, timesteps = play(env, 6)
        starts.append(np.stack([timestep.obs["count"][:, 1] for timestep in timesteps]))
        env.release(state)  # the same workers begin anew
    np.testing.assert_array_equal(*starts)
    assert len(set(starts[0][0])) == 4
    assert (starts[0][0] != starts[0][3]).any()
    _, others = play(env, 1, jax.random.split(jax.random.key(4), 4))
    assert (others[0].obs["count"][:, 1] != starts[0][0]).any()


@pytest.mark.parametrize(
    "make",
    [
        functools.partial(from_gymnasium, functools.partial(host_fakes.Counting, terminal=7, pixels=True)),
        functools.partial(from_gymnasium, functools.partial(host_fakes.Counting, limit=7, discrete=False)),
        functools.partial(from_dm_env, host_fakes.Walk),
        functools.partial(envs.make, "dm_env:tests.envs.host_fakes:make_walk", action_repeat=2),
        functools.partial(envs.make, "gym:CartPole-v1"),
        functools.partial(envs.make, "dm_control:cartpole_balance", obs="vector", action_repeat=2),
    ],
    ids=["pixels", "box", "dm_env", "dm_env-name", "gymnasium-name", "dm_control"],
)
def test_conformance(make):
    assert conformance.findings(made(make()), jax.random.key(0), beginning_steps=20, echo=lambda line: None) == []


def test_conformance_names_what_is_not_repeatable():
    env = made(from_gymnasium(lambda: Unseeded()))
    found = conformance.findings(env, jax.random.key(0), echo=lambda line: None)
    assert {finding.kind for finding in found} == {"determinism"}


def test_a_seed_reaches_environments_that_take_it_when_they_are_made():
    made_with: list[Any] = []

    class Drawn(host_fakes.Walk):
        """Has a random start, as Memory Maze's levels, and physics that are gone when it is closed."""

        def __init__(self, seed: int | None) -> None:
            super().__init__()
            made_with.append(seed)
            self.random_state = np.random.RandomState(seed)

        @property
        def physics(self) -> Any:
            return SimpleNamespace(free=gone)

        def _obs(self) -> Any:
            return {"t": np.int64(self.random_state.randint(1_000)), "phase": np.int32(0)}

    def gone() -> None:
        raise ReferenceError("weakly-referenced object no longer exists")

    player = factories._Remade(lambda seed: players.DmEnvPlayer(Drawn(seed), Options()))
    first, second = (player.reset(seed)["t"] for seed in (5, None))
    again, other = (player.reset(seed)["t"] for seed in (5, 6))
    player.close()
    assert first == again
    assert len({float(x) for x in (first, second, other)}) == 3
    assert made_with == [None, 5, 5, 6]
    composers = players.DmEnvPlayer(Drawn(1), Options())
    assert composers.reset(7)["t"] == composers.reset(7)["t"]


@pytest.mark.parametrize(("how", "why"), [("raises", "the door is stuck"), ("nan", r"obs['count'] is not finite")])
def test_conformance_says_why_episodes_are_cut(how, why):
    env = made(from_gymnasium(functools.partial(host_fakes.Failing, how)))
    found = conformance.findings(env, jax.random.key(0), echo=lambda line: None)
    assert any(finding.kind == "error" and why in finding.got for finding in found), found


class Unseeded(host_fakes.Counting):
    """Draws from the system's randomness."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return super().reset(seed=int.from_bytes(os.urandom(4), "little"))


def test_a_gymnasium_environment_by_its_function():
    env = made(envs.make("gym:tests.envs.host_fakes:Counting"))
    _, timesteps = play(env, 3, KEYS[:1])
    assert counts(timesteps, 0) == [0, 1, 2]
    with pytest.raises(ValueError, match=r"gym:no\.such:thing: No module named 'no'; run the command where"):
        envs.make("gym:no.such:thing")


# Failures.


@pytest.mark.parametrize(
    ("how", "line"),
    [
        ("dies", r"worker 1 was ended by signal 9 \(SIGKILL\)"),
        ("exits", "worker 1 ended with exit code 7"),
        ("hangs", "worker 1 did not answer for 5 s"),
        ("raises", r"environment 1 raised RuntimeError: the door is stuck \(host_fakes.py, line"),
        ("nan", r"environment 1: obs\['count'\] is not finite"),
        ("shape", r"environment 1 raised ValueError: observation 'count': expected float32 \[2\], got float32 \[5\]"),
    ],
)
def test_a_failure_cuts_the_episode_and_is_counted_and_named(tmp_path, how, line):
    env = made(from_gymnasium(FailsInSecond(how, str(tmp_path)), workers=Workers(processes=2, step_seconds=5.0)))
    state, timesteps = play(env, 7, KEYS[:2])
    assert counts(timesteps, 0) == [0, 1, 2, 3, 4, 5, 6]
    last_seen = 0.0 if how == "nan" else 2.0
    assert counts(timesteps, 1) == [0, 1, 2, last_seen, 0, 1, 2]
    assert column(timesteps, "is_last", 1) == [False, False, False, True, False, False, False]
    assert column(timesteps, "is_first", 1) == [True, False, False, False, True, False, False]
    assert column(timesteps, "reward", 1)[3] == 0
    assert not any(column(timesteps, "is_terminal", 1))
    assert env.cuts(state).faults.tolist() == [0, 1]
    (told,) = env.host.lines()
    assert re.match(line, told), told
    assert env.host.failure is None
    assert not env.host.should_stop


class FailsInSecond:
    """Makes environments of which the second worker's fails, once."""

    def __init__(self, how: str, folder: str) -> None:
        self.how, self.folder = how, folder

    def __call__(self) -> Any:
        if os.environ["NE_DREAMER_WORKER"] == "1":
            return host_fakes.Failing(self.how, os.path.join(self.folder, "failed"))
        return host_fakes.Counting()


def test_an_image_of_another_shape_than_its_space_is_named_as_it_came():
    env = made(from_gymnasium(ChannelsFirst, Options(image_size=16)))
    state, _ = play(env, 2, KEYS[:1])
    assert env.cuts(state).faults.tolist() == [1]
    (told,) = env.host.lines()
    assert "'image': expected uint8 [32, 32, 3], as its space says, got uint8 [3, 32, 32]" in told


class ChannelsFirst(host_fakes.Counting):
    """Its pictures are not as its space says once an episode has begun."""

    def __init__(self) -> None:
        super().__init__(pixels=True)

    def _obs(self) -> Any:
        obs = super()._obs()
        return obs | ({"image": obs["image"].transpose(2, 0, 1)} if self.t else {})


def test_an_environment_that_always_fails_is_given_up():
    env = made(from_gymnasium(functools.partial(host_fakes.Failing, "raises")))
    with pytest.raises(jax.errors.JaxRuntimeError):
        jax.block_until_ready(play(env, 60, KEYS[:1]))
    assert "the door is stuck" in env.host.failure
    assert "5 failures came before it" in env.host.failure
    assert len(env.host.lines()) == 5


def test_an_environment_that_never_begins_again_is_given_up(tmp_path):
    env = made(from_gymnasium(functools.partial(host_fakes.BeginsOnce, str(tmp_path / "mark"))))
    with pytest.raises(jax.errors.JaxRuntimeError):
        jax.block_until_ready(play(env, 1, KEYS[:1]))
    assert "no level found" in env.host.failure


def test_an_environment_whose_episodes_all_begin_with_nan_is_given_up():
    env = made(from_gymnasium(NanAtReset))
    with pytest.raises(jax.errors.JaxRuntimeError):
        jax.block_until_ready(play(env, 20, KEYS[:1]))
    assert "where each episode begins" in env.host.failure


class NanAtReset(host_fakes.Counting):
    """Its first observation is not finite."""

    def _obs(self) -> Any:
        return super()._obs() | ({"count": np.array([np.nan, 0.0])} if self.t == 0 else {})


def test_one_environment_alone_is_refused_with_what_to_do():
    with pytest.raises(ValueError, match=r"prepare: expected N keys, \[N\], got \[\]; .*without jax.vmap"):
        jax.vmap(made(counting()).prepare)(KEYS)


def test_a_state_is_stepped_once():
    env = made(counting())
    state = env.prepare(KEYS)
    action = jnp.zeros(4, jnp.int32)
    env.step(state, action)
    with pytest.raises(jax.errors.JaxRuntimeError, match="can't be stepped twice"):
        jax.block_until_ready(env.step(state, action))


def test_what_opens_once_only_is_named(tmp_path):
    env = made(from_gymnasium(functools.partial(licensed, str(tmp_path / "taken"))))
    with pytest.raises(jax.errors.JaxRuntimeError):
        jax.block_until_ready(env.prepare(KEYS))
    assert "no licence is free" in env.host.failure


def licensed(mark: str) -> Any:
    if os.path.exists(mark):
        raise OSError("no licence is free")
    with open(mark, "w"):
        return host_fakes.Counting()


def test_workers_leave_signals_of_their_group_to_the_main_process():
    before = set(children())
    env = made(counting(Workers(processes=1)))
    state, _ = play(env, 2)
    (worker,) = set(children()) - before
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        os.kill(worker, number)
    state, timestep = env.step(state, jnp.zeros(4, jnp.int32))
    assert timestep.obs["count"][:, 0].tolist() == [2, 2, 2, 2]


def test_environments_that_nobody_holds_end():
    before = set(children())
    env = counting(Workers(processes=1))
    state, _ = play(env, 2)
    env.release(state)
    state = env.prepare(KEYS)
    workers = set(children()) - before
    assert workers
    del env, state
    jax.clear_caches()  # of the steps, whose programs hold the environments as long as they are kept
    gc.collect()
    assert not set(children()) & workers


def test_a_second_beginning_compiles_nothing():
    env, events = made(counting(Workers(processes=1))), []
    env.release(env.prepare(KEYS))
    listen = lambda name, *_, **__: events.append(name)
    jax.monitoring.register_event_duration_secs_listener(listen)
    compilations = lambda: sum("backend_compile" in name for name in events)
    try:
        env.prepare(KEYS)
        assert compilations() == 0
        env.prepare(KEYS[:3])
        assert compilations() > 0  # of another number of environments: the listener hears them
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_what_can_not_be_made_is_refused():
    def broken() -> Any:
        raise FileNotFoundError("no such level: level.xml")

    with pytest.raises(ValueError, match="FileNotFoundError: no such level"):
        from_gymnasium(broken)


def test_failures_can_be_made_to_stop_a_run():
    env = made(from_gymnasium(functools.partial(host_fakes.Failing, "raises"), workers=Workers(on_failure="stop")))
    play(env, 3, KEYS[:1])
    assert not env.host.should_stop
    play(env, 4, KEYS[:1])
    assert env.host.should_stop


def test_episodes_of_another_process_are_cut_and_begin_anew():
    env = made(counting())
    step = jax.jit(env.step)
    state, _ = play(env, 4)
    before = jax.device_get(state)
    env.host.close()
    cut, timestep = step(state, jnp.zeros(4, jnp.int32))
    assert timestep.is_last.all()
    assert not timestep.is_terminal.any()
    np.testing.assert_array_equal(timestep.obs["count"], before.obs["count"])
    assert env.host.lines() == ["4 episodes of another process are cut; others begin."]
    state, timestep = step(cut, jnp.zeros(4, jnp.int32))
    assert timestep.is_first.all()
    assert (timestep.obs["count"][:, 1] != before.obs["count"][:, 1]).any()
    assert env.cuts(state).faults.tolist() == [1, 1, 1, 1]


def test_actions_that_are_not_finite_cut_the_episode():
    env = made(counting(discrete=False))
    assert env.spec.action == ContinuousAction(2)
    action = jnp.zeros((4, 2), jnp.float32).at[2, 0].set(jnp.nan)
    state, timesteps = play(env, 2, action=action)
    assert timesteps[0].is_last.tolist() == [False] * 4
    assert timesteps[1].is_last.tolist() == [False, False, True, False]
    assert env.cuts(state).bad_actions.tolist() == [0, 0, 1, 0]
    assert env.cuts(state).faults.tolist() == [0, 0, 0, 0]


def test_beginning_a_step_early_changes_nothing():
    env = made(counting(terminal=3))

    def early(state: Any, action: Any) -> Any:
        state, timestep = env.step(state, action)
        return env.start(state, jnp.ones(4, jnp.int32)), timestep

    state, seen, step = env.prepare(KEYS), [], jax.jit(early)
    for _ in range(8):
        state, timestep = step(state, jnp.ones(4, jnp.int32))
        seen.append(jax.device_get(timestep))
    env.release(state)  # with a step begun that nobody has waited for
    late = play(env, 8, action=jnp.ones(4, jnp.int32))[1]
    jax.tree.map(np.testing.assert_array_equal, seen, late)


@pytest.mark.parametrize("how", ["waits", "hangs"])
def test_workers_end_when_the_main_process_is_killed(tmp_path, how):
    program = (
        "import functools, sys, numpy as np\\n"
        "from ne_dreamer_jax.envs.host import factories, players, pool\\n"
        "from tests.envs import host_fakes\\n"
        f"env = functools.partial(host_fakes.Failing, {how!r})\\n"
        "factory = factories.Made(players.GymnasiumPlayer, env, players.Options())\\n"
        "pools = pool.Pools(factory, pool.Workers(processes=2))\\n"
        "number = pools.open([1, 2])\\n"
        "found = pools.get(number)\\n"
        "actions = np.zeros(2, np.int32)\\n"
        "for i in range(3):\\n"
        "    found.start(i, actions, np.full(2, i == 0)); found.finish(actions, np.full(2, i == 0))\\n"
        "found.start(3, actions, np.zeros(2, bool))\\n"
        "print(*[worker.process.pid for worker in found._workers], flush=True)\\n"
        "sys.stdin.read()\\n"
    ).replace("\\n", "\n")
    child = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    workers = [int(pid) for pid in child.stdout.readline().split()]
    assert len(workers) == 2
    assert all(map(alive, workers))
    child.send_signal(signal.SIGKILL)
    child.communicate()
    until = time.monotonic() + 30
    while any(map(alive, workers)) and time.monotonic() < until:
        time.sleep(0.1)
    assert not any(map(alive, workers))


# Names.


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gym:CartPole-v9", "no environment is called 'gym:CartPole-v9'.*CartPole-v1"),
        ("gym:", "expected a name such as gym:CartPole-v1"),
        ("dm_env:module", "expected dm_env:module:function"),
        ("dm_env:no such:make", "expected the name of a module"),
        ("dm_control:walkerwalk", "Did you mean walker_walk"),
        ("dmlab:rooms_watermaze", "need the package deepmind_lab, which is not installed; install it with: its own"),
        ("memory_maze:9x9", "needs? the package memory_maze, which is not installed; install it with: pip install"),
    ],
)
def test_names_are_checked_before_anything_starts(name, message):
    with pytest.raises(ValueError, match=message):
        envs.check(name)


def test_what_only_a_worker_can_find_out_is_named():
    with pytest.raises(ValueError, match=r"no task of dm_control is called 'walker_fly'\. Did you mean"):
        envs.make("dm_control:walker_fly")
    with pytest.raises(ValueError, match=r"expected a function make_run in tests\.envs\.host_fakes"):
        envs.make("dm_env:tests.envs.host_fakes:make_run")


def test_every_setting_reaches_the_environments():
    env = made(envs.make("dm_env:tests.envs.host_fakes:make_walk", workers=1, step_seconds=9.0, on_failure="stop"))
    assert env.host.workers == Workers(1, 9.0, "stop")
    made(counting(Workers(processes=2), pixels=True))
    small = made(from_gymnasium(functools.partial(host_fakes.Counting, pixels=True), Options(image_size=16)))
    assert small.spec.observation["image"].shape == (16, 16, 3)


def test_as_many_workers_as_asked_for():
    before = set(children())
    env = made(counting(Workers(processes=3)))
    play(env, 1)
    assert len(set(children()) - before) == 3
