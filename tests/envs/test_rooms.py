"""The Rooms tasks: DMLab's rules, each played; and scripted players, who say what there is to reach."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax.envs import base, conformance
from ne_dreamer_jax.envs.config import RoomsConfig
from ne_dreamer_jax.envs.rooms import collect, deferred, draw, movement, names, nonmatching, players, tasks, watermaze
from ne_dreamer_jax.envs.rooms.game import make_core

pytestmark = pytest.mark.usefixtures("quick_compilation")

NOWHERE = movement.Solids(jnp.zeros((0, 4)), jnp.zeros((0,), bool), jnp.zeros((0, 3)))
IDLE = 8


def walked(controls, frames, solids=NOWHERE, body=None):
    """Bodies after each frame."""
    body = movement.standing(jnp.zeros(2), jnp.zeros(())) if body is None else body
    step = lambda body, _: (movement.walk(body, jnp.asarray(controls, jnp.float32), solids),) * 2
    return jax.jit(lambda body: jax.lax.scan(step, body, None, length=frames)[1])(body)


# Movement.


def test_a_start_takes_dmlabs_frames_and_a_stop_too():
    bodies = walked([1, 0, 0], 40)
    np.testing.assert_array_equal(bodies.velocity[:10, 0], [51, 93, 135, 173, 208, 239, 267, 293, 316, 320])
    np.testing.assert_allclose(bodies.position[3::4, 0][:4], [7.2, 23.3, 43.8, 64.2], atol=0.06)
    np.testing.assert_allclose(np.diff(bodies.position[3::4, 0])[-3:], 20.48, rtol=1e-4)
    coasting = walked([0, 0, 0], 30, body=jax.tree.map(lambda x: x[-1], bodies))
    assert int((np.asarray(coasting.velocity[:, 0]) > 0).sum()) == 21, "at rest in the 22nd frame"
    np.testing.assert_allclose(coasting.position[-1, 0] - bodies.position[-1, 0], 40.3, atol=0.1)


def test_a_look_turns_by_dmlabs_angle_clockwise_to_the_right():
    for action, sign in ((4, 1), (5, -1), (6, 1), (7, -1)):
        yaw = walked(movement.CONTROLS[action], 4).yaw[-1]
        np.testing.assert_allclose(np.rad2deg(yaw), sign * 8.448, rtol=1e-4)


def test_directions_are_the_players_own_and_diagonals_are_no_faster():
    right = walked([0, 1, 0], 40).position[-1]
    assert right[1] < -100
    assert abs(float(right[0])) < 1e-3
    speed = np.linalg.norm(walked([1, 1, 0], 40).velocity[-1])
    assert 318 <= speed <= 322


def test_walls_stop_what_goes_into_them_and_let_the_rest_slide():
    wall = movement.Solids(jnp.array([[100.0, 140.0, -1e3, 1e3]]), jnp.ones((1,), bool), jnp.zeros((0, 3)))
    body = movement.standing(jnp.zeros(2), jnp.asarray(0.5))
    end = jax.tree.map(lambda x: x[-1], walked([1, 0, 0], 120, wall, body))
    assert float(end.position[0]) == pytest.approx(85.0)
    assert float(end.velocity[0]) == 0.0
    assert float(end.position[1]) > 150
    off = wall._replace(active=jnp.zeros((1,), bool))
    assert float(walked([1, 0, 0], 120, off, body).position[-1, 0]) > 200


def test_a_round_arena_holds_the_players_box_inside():
    game = watermaze.make()
    body, task = game.begin(jax.random.key(0))
    ends, _ = (np.asarray(x) for x in (game.scene(body, task, jnp.zeros((), jnp.int32)).walls.ends, 0))
    np.testing.assert_allclose(np.linalg.norm((ends[:, :2] + ends[:, 2:]) / 2, axis=1), 760, rtol=1e-5)
    for yaw in np.linspace(-3, 3, 7):
        body = movement.standing(jnp.zeros(2), jnp.float32(yaw))
        frame = lambda body, _: (
            (game.frame(body, task, jnp.array([1.0, 0, 0]), jnp.zeros((), jnp.int32), jax.random.key(0)).body,) * 2
        )
        far = jax.lax.scan(frame, body._replace(position=jnp.array([10.0, 5.0])), None, length=220)[1].position[-1]
        normals = np.stack([np.cos(2 * np.pi * np.arange(16) / 16), np.sin(2 * np.pi * np.arange(16) / 16)], 1)
        reach = normals @ np.asarray(far) + 15 * np.abs(normals).sum(1)
        assert reach.max() < 761
        assert reach.max() > 740 or task.found == 0


@pytest.mark.parametrize(
    ("offset", "taken"),
    [
        ((-50.0, 0.0), True),
        ((-50.5, 0.0), False),
        ((44.0, 0.0), True),
        ((44.5, 0.0), False),
        ((0.0, 36.0), True),
        ((0.0, -36.5), False),
    ],
)
def test_the_pick_up_volume_is_askew_as_the_engines_is(offset, taken):
    assert (
        bool(movement.within_reach(jnp.array([100.0, 50.0]) + jnp.array(offset), jnp.array([[100.0, 50.0]]))[0])
        == taken
    )


# Environments.


class Played:
    """A task whose player can be put anywhere."""

    def __init__(self, game, steps=900, key=0):
        self.env = base.from_core(make_core(game, steps, 8))
        self.step = jax.jit(self.env.step)
        self.state, self.timestep = self.step(self.env.prepare(jax.random.key(key)), jnp.full((), IDLE, jnp.int32))

    @property
    def task(self):
        return self.state.core.task

    def put(self, position, yaw=0.0):
        body = movement.standing(jnp.asarray(position, jnp.float32), jnp.asarray(yaw, jnp.float32))
        self.state = self.state._replace(core=self.state.core._replace(body=body))

    def act(self, action=IDLE):
        self.state, self.timestep = self.step(self.state, jnp.asarray(action, jnp.int32))
        return float(self.timestep.reward)


def test_collecting_pays_and_the_tenth_pick_up_ends_the_episode_after_its_grace():
    played = Played(collect.make(collect.TRAIN))
    items = np.asarray(played.task.items)
    assert len(np.unique(items, axis=0)) == 20
    rewards = []
    for number in (0, *range(10, 18)):
        played.put(items[number])
        rewards.append(played.act())
    assert rewards == [-1.0] + [1.0] * 8
    assert int(played.task.taken.total) == 9
    played.put(items[18])
    assert played.act() == 1.0
    ends = []
    for _ in range(4):
        ends.append(bool(played.timestep.is_last))
        if ends[-1]:
            break
        played.put(items[19])  # what is touched meanwhile counts
        played.act()
    assert ends == [False, False, False, True], "13 frames: within the fourth step of four frames"
    assert played.timestep.is_terminal
    assert int(played.task.taken.total) == 11


def test_configurations_come_in_equal_shares_and_the_held_out_one_in_the_test_alone():
    for configs, kinds in ((collect.TRAIN, 3), (collect.TEST, 1)):
        game = collect.make(configs)
        drawn = jax.vmap(lambda key, game=game: game.begin(key)[1].config)(jax.random.split(jax.random.key(0), 300))
        found, counts = np.unique(np.asarray(drawn), axis=0, return_counts=True)
        assert {tuple(row) for row in found} == {tuple(row) for row in configs}
        assert len(found) == kinds
        assert counts.min() > 0.7 * 300 / kinds


def test_the_box_costs_three_lights_the_floor_and_opens_the_door_in_time():
    played = Played(deferred.make(deferred.TEST))
    items = np.asarray(played.task.items)
    played.put((300.0, 0.0))
    for _ in range(8):
        played.act(0)
    assert float(played.state.core.position[0]) == pytest.approx(321.0), "the door is closed"
    dark = played.state.core
    game = deferred.make(deferred.TEST)
    floor = lambda core: float(game.scene(core.body, core.task, core.clock).floor[0])
    assert floor(dark) == deferred.DARK
    played.put(items[deferred.BOX])
    assert played.act() == -3.0
    assert floor(played.state.core) == deferred.BRIGHT
    lifts = [float(deferred.lift(played.task))]
    for _ in range(5):
        played.put((0.0, 265.0))
        played.act()
        lifts.append(float(deferred.lift(played.task)))
    assert lifts[0] < 8
    assert lifts[-1] == 80.0
    frames = next(i for i in range(60) if float(deferred.lift(played.task._replace(since_box=jnp.asarray(i)))) == 80.0)
    assert 15 <= frames <= 20, "16 to 20 frames from the box to a door that is open"
    for lifted, passable in ((57.6, False), (70.4, True)):  # the door reaches 8 below the floor, a body is 56 tall
        since = jnp.asarray(deferred.DOOR_DELAY + round(lifted / deferred.DOOR_SPEED), jnp.int32)
        task = played.task._replace(since_box=since)
        assert bool(deferred.solids(task).active[-1]) != passable
    played.put((300.0, 0.0))
    for _ in range(12):
        played.act(0)
    assert float(played.state.core.position[0]) > 400, "through the door"
    played.put(items[11])
    assert played.act() == 10.0


def test_two_rooms_have_cakes_and_one_room_has_none():
    game = deferred.make(deferred.TRAIN)
    tasks_ = jax.vmap(lambda key: game.begin(key)[1])(jax.random.split(jax.random.key(1), 64))
    for config, there in zip(np.asarray(tasks_.config), np.asarray(tasks_.taken.there), strict=True):
        assert there[:10].all()
        assert there[deferred.BOX] == config[1]
        assert there[11:].all() == there[11:].any() == bool(config[0])


def test_the_pad_teleports_for_one_and_the_choice_begins_a_new_map_with_the_same_match():
    played = Played(nonmatching.make(), 180)
    before = played.task
    np.testing.assert_array_equal(played.state.position, nonmatching.START)
    assert float(played.state.yaw) == 0.0
    played.put((64.0, -64.0))
    assert played.act() == 1.0
    x, y = np.asarray(played.state.core.position)
    assert 288 < x < 320
    assert y == -64
    for _ in range(4):
        played.act()  # in the air the player keeps going
    assert float(played.state.core.position[0]) == pytest.approx(288 + 102, abs=25)
    played.put(nonmatching.CHOICES[int(before.place)])
    assert played.act() == 10.0
    np.testing.assert_array_equal(played.state.core.position, nonmatching.START)
    assert int(played.task.match) == int(before.match)
    played.put(nonmatching.CHOICES[1 - int(played.task.place)])
    assert played.act() == -10.0


def test_examples_can_be_seen_and_not_reached():
    played = Played(nonmatching.make(), 180)
    for spot, yaw in zip(nonmatching.EXAMPLES, (0.6, -0.6), strict=True):
        played.put((-60.0, float(spot[1])), 0.0)
        for _ in range(30):
            played.act(0)
        assert not bool(movement.within_reach(played.state.core.position, jnp.asarray(spot)[None])[0])
        assert yaw


def test_maps_differ_and_no_other_is_the_match():
    maps = jax.vmap(lambda key: nonmatching._new_map(jnp.asarray(7, jnp.int32), key))(
        jax.random.split(jax.random.key(0), 4000)
    )
    other = np.asarray(maps.other)
    assert set(other) == set(range(36)) - {7}
    assert np.bincount(other, minlength=36)[[i for i in range(36) if i != 7]].min() > 70
    assert 0.45 < float(maps.example.mean()) < 0.55


def test_finding_the_platform_pays_five_over_time_and_begins_a_new_trial_with_the_same_platform():
    played = Played(watermaze.make())
    platform = np.asarray(played.task.platform)
    assert np.linalg.norm(platform) <= 580
    rewards = []
    played.put(platform + np.array([100.0, 0.0]))
    rewards.append(played.act())  # too far by its corner
    assert int(played.task.found) == 0
    played.put(platform + np.array([60.0, 55.0]))
    for _ in range(9):
        rewards.append(played.act())
        if int(played.task.found) > 1:
            np.testing.assert_allclose(played.state.core.position, platform, atol=1e-3)
    assert sum(rewards) == 5.0
    assert max(rewards) <= 2.0
    assert int(played.task.found) == 0
    assert np.linalg.norm(np.asarray(played.state.core.position) - platform) > 1
    np.testing.assert_array_equal(played.task.platform, platform)


def test_the_clock_ends_an_episode_and_is_no_terminal_state():
    played = Played(watermaze.make(), 3)
    last = []
    for _ in range(4):
        played.act(4)
        last.append((bool(played.timestep.is_last), bool(played.timestep.is_terminal)))
    assert last == [(False, False), (False, False), (True, False), (False, False)]


@pytest.mark.parametrize(
    "name", ["rooms/select_nonmatching_object", *(pytest.param(n, marks=pytest.mark.slow) for n in names.NAMES)]
)
def test_every_task_conforms(name):
    conformance.check(nedreamer.envs.make(name, image_size=16, length=12), jax.random.key(0))


def test_lengths_are_the_papers_or_the_tasks_own():
    assert names.default_steps("rooms/watermaze") == 900
    assert names.NATIVE_STEPS["rooms/watermaze"] == 1800
    assert names.default_steps("rooms/select_nonmatching_object") == 180


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: nedreamer.envs.make("rooms/watermase"),
            r"no environment is called 'rooms/watermase'. Did you mean rooms/watermaze",
        ),
        (lambda: tasks.make("rooms/watermaze", image_size=4), "image_size: expected pixels, at least 8, got 4"),
        (lambda: tasks.make("rooms/watermaze", length=0), "length: expected agent steps, from 1 to"),
        (lambda: RoomsConfig(length="long"), "expected an integer .* native or none, got 'long'"),
    ],
)
def test_what_is_impossible_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_task_of_another_family_brings_its_own_settings():
    config = nedreamer.config.override(nedreamer.config.preset("quickstart"), "env.task=rooms/watermaze_small")
    assert config.env == RoomsConfig("rooms/watermaze_small", image_size=32)
    assert nedreamer.config.preset("rooms").env == RoomsConfig()


# Pictures.


def scene_of(name, key=0):
    game = tasks.game(name)
    body, task = game.begin(jax.random.key(key))
    return game, body, task


@pytest.mark.parametrize("name", ["rooms/collect_good_objects", "rooms/select_nonmatching_object", "rooms/watermaze"])
def test_pictures_are_those_of_four_times_the_resolution(name):
    """What a pixel shows is about the mean of what 4 x 4 finer ones show."""
    worst, errors = [], []
    with jax.numpy_rank_promotion("allow"):
        for key in range(2):
            game, body, task = scene_of(name, key)
            scene = game.scene(body, task, jnp.zeros((), jnp.int32))
            fine, coarse = (
                np.asarray(draw.draw(scene, game.shapes, body.position, body.yaw, size), np.float32)
                for size in (256, 64)
            )
            error = np.abs(fine.reshape(64, 4, 64, 4, 3).mean((1, 3)) - coarse)
            errors.append(error.mean())
            worst.append(np.quantile(error, 0.99))
    assert np.mean(errors) < 3.0
    assert max(worst) < 60


def test_walls_doors_and_distance_hide_and_show():
    with jax.numpy_rank_promotion("allow"):
        game = deferred.make(deferred.TEST)
        body, task = game.begin(jax.random.key(0))
        body = movement.standing(jnp.array([200.0, 0.0]), jnp.zeros(()))
        see = lambda task: np.asarray(
            draw.draw(game.scene(body, task, jnp.zeros((), jnp.int32)), game.shapes, body.position, body.yaw, 64)
        )
        cakes = task._replace(
            items=task.items.at[11:].set(jnp.array([[560.0, 0.0]])).at[:11].set(jnp.array([[-200.0, 0.0]]))
        )
        closed, opened = see(cakes), see(cakes._replace(since_box=jnp.asarray(100, jnp.int32)))
        red = lambda picture: ((picture[..., 0] > 120) & (picture[..., 1] < 60) & (picture[..., 2] < 60)).sum()
        assert red(closed) == 0
        assert red(opened) > 4


def test_thirty_six_objects_look_different():
    with jax.numpy_rank_promotion("allow"):
        game = nonmatching.make()
        body = movement.standing(jnp.array([500.0, 64.0]), jnp.zeros(()))
        pictures = []
        see = jax.jit(
            lambda task: draw.draw(
                game.scene(body, task, jnp.zeros((), jnp.int32)), game.shapes, body.position, body.yaw, 64
            )
        )
        for match in range(36):
            task = nonmatching.Nonmatching(jnp.asarray(match), jnp.asarray(0), jnp.asarray(0), jnp.asarray(1))
            pictures.append(np.asarray(see(task), np.float32))
    for i in range(36):
        for j in range(i):
            assert (np.abs(pictures[i] - pictures[j]).max(-1) > 8).sum() > 8, (i, j)


# Scripted players.


def returns_of(game, policy, steps, episodes=16, memory=None):
    """Returns of whole episodes, [episodes]; ``policy(core state, memory, key) -> action, memory``."""
    env = base.from_core(
        make_core(game, steps, 8)._replace(observe=lambda state: {"image": jnp.zeros((8, 8, 3), jnp.uint8)})
    )

    def episode(key):
        state, _ = env.step(env.prepare(key), jnp.zeros((), jnp.int32))

        def step(carry, key):
            state, memory, done, total = carry
            action, memory = policy(state.core, memory, key)
            state, timestep = env.step(state, action)
            total = total + jnp.where(done, 0.0, timestep.reward)
            return (state, memory, done | timestep.is_last, total), None

        carry = (state, memory, jnp.zeros((), bool), jnp.zeros(()))
        return jax.lax.scan(step, carry, jax.random.split(key, steps))[0][3]

    return np.asarray(jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(5), episodes)))


def at_random(state, memory, key):
    return jax.random.randint(key, (), 0, 9, jnp.int32), memory


@pytest.mark.slow
def test_a_player_collects_what_is_good():
    best = returns_of(collect.make(collect.TRAIN), lambda s, m, k: (players.collects(s), m), 900)
    assert best.mean() > 8.5
    assert np.median(best) == 10
    assert abs(returns_of(collect.make(collect.TRAIN), at_random, 900).mean()) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("configs", "optimum"),
    [(deferred.TRAIN[:1], 10), (deferred.TRAIN[1:2], 10), (deferred.TRAIN[2:], 100), (deferred.TEST, 87)],
)
def test_a_player_defers_and_reaches_the_optimum(configs, optimum):
    best = returns_of(deferred.make(configs), lambda s, m, k: (players.defers(s), m), 900)
    assert best.max() == optimum
    assert best.mean() > 0.8 * optimum


def test_memory_is_worth_much_in_nonmatching():
    def play(remembers):
        def policy(state, memory, key):
            # One coin a map, as one that does not know better chooses.
            coin = jax.random.bernoulli(
                jax.random.fold_in(jax.random.key(0), state.task.other + 36 * state.task.example)
            )
            return players.selects(state, remembers, coin), memory

        return returns_of(nonmatching.make(), policy, 180)

    best, forgetful = play(True), play(False)
    assert best.min() >= 66, "six whole trials in 12 seconds; a search finds seven, worth 77"
    assert forgetful.mean() < 25
    assert returns_of(nonmatching.make(), at_random, 180).mean() < 5


@pytest.mark.parametrize(
    ("scale", "steps", "gap"), [(tasks.SMALL, 300, 2.0), pytest.param(1.0, 900, 1.5, marks=pytest.mark.slow)]
)
def test_memory_is_worth_much_in_the_watermaze(scale, steps, gap):
    radius = scale * watermaze.DISC
    play = lambda remembers: returns_of(
        watermaze.make(scale), lambda s, m, k: players.swims(s, m, remembers, radius, k), steps, 64, players.NO_MEMORY
    )
    best, forgetful = play(True), play(False)
    assert best.mean() > gap * forgetful.mean(), (best.mean(), forgetful.mean())
