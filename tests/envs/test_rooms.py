"""The Rooms tasks: DMLab's rules, each played; and scripted players, who say what there is to reach."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ne_dreamer_jax as nedreamer
from ne_dreamer_jax.envs import base, conformance
from ne_dreamer_jax.envs.config import RoomsConfig
from ne_dreamer_jax.envs.rooms import (
    collect,
    deferred,
    draw,
    layout,
    movement,
    names,
    nonmatching,
    players,
    tasks,
    watermaze,
)
from ne_dreamer_jax.envs.rooms.game import make_core
from tests.marks import slow_but

pytestmark = pytest.mark.usefixtures("quick_compilation")

NOWHERE = movement.Solids(jnp.zeros((0, 4)), jnp.zeros((0,), bool), jnp.zeros((0, 3)))
IDLE = 8
SMALL_NONMATCHING = "rooms/select_nonmatching_object_small"


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
    np.testing.assert_array_equal(played.state.position, nonmatching.places().start)
    assert float(played.state.yaw) == 0.0
    played.put((64.0, -64.0))
    assert played.act() == 1.0
    x, y = np.asarray(played.state.core.position)
    assert 288 < x < 320
    assert y == -64
    for _ in range(4):
        played.act()  # in the air the player keeps going
    assert float(played.state.core.position[0]) == pytest.approx(288 + 102, abs=25)
    played.put(nonmatching.places().choices[int(before.place)])
    assert played.act() == 10.0
    np.testing.assert_array_equal(played.state.core.position, nonmatching.places().start)
    assert int(played.task.match) == int(before.match)
    played.put(nonmatching.places().choices[1 - int(played.task.place)])
    assert played.act() == -10.0


def test_examples_can_be_seen_and_not_reached():
    played = Played(nonmatching.make(), 180)
    for spot, yaw in zip(nonmatching.places().examples, (0.6, -0.6), strict=True):
        played.put((-60.0, float(spot[1])), 0.0)
        for _ in range(30):
            played.act(0)
        assert not bool(movement.within_reach(played.state.core.position, jnp.asarray(spot)[None])[0])
        assert yaw


def test_maps_differ_and_no_other_is_the_match():
    maps = jax.vmap(lambda key: nonmatching._new_map(jnp.asarray(7, jnp.int32), key, nonmatching.OBJECTS))(
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


PICTURES = ["rooms/collect_good_objects", "rooms/select_nonmatching_object", "rooms/watermaze"]


@pytest.mark.parametrize("name", slow_but(PICTURES, "rooms/select_nonmatching_object"))
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


def returns_of(game, player, steps, episodes=16):
    """Returns of whole episodes, [episodes]."""
    env = base.from_core(
        make_core(game, steps, 8)._replace(observe=lambda state: {"image": jnp.zeros((8, 8, 3), jnp.uint8)})
    )

    def step(carry):
        state, kept, done, total, key = carry
        key, act_key = jax.random.split(key)
        action, kept = jax.vmap(player.act)(state.core, kept, jax.random.split(act_key, episodes))
        state, timestep = jax.vmap(env.step)(state, action)
        return state, kept, done | timestep.is_last, total + jnp.where(done, 0.0, timestep.reward), key

    @jax.jit
    def play(key):
        key, reset_key = jax.random.split(key)
        state, _ = jax.vmap(env.reset)(jax.random.split(reset_key, episodes))
        kept = jax.tree.map(lambda x: jnp.broadcast_to(x, (episodes, *x.shape)), player.start)
        begin = (state, kept, jnp.zeros((episodes,), bool), jnp.zeros((episodes,)), key)
        return jax.lax.while_loop(lambda carry: ~carry[2].all(), step, begin)[3]

    return np.asarray(play(jax.random.key(5)))


@pytest.fixture
def whole_compilation():
    """For what computes longer than it compiles."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(tasks.COLLECT))
def test_a_player_collects_what_is_good(name, whole_compilation):
    assert returns_of(tasks.game(name), players.scripted(name), 900).min() >= 10
    assert abs(returns_of(tasks.game(name), players.RANDOM, 900).mean()) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("configs", "optimum"),
    [(deferred.TRAIN[:1], 10), (deferred.TRAIN[1:2], 10), (deferred.TRAIN[2:], 100), (deferred.TEST, 87)],
)
def test_a_player_defers_and_reaches_the_optimum(configs, optimum, whole_compilation):
    player = players.scripted("rooms/exploit_deferred_effects")
    assert returns_of(deferred.make(configs), player, 900).min() >= optimum


def test_a_way_leads_between_what_is_shunned():
    """Around a row of objects whose gaps are wide enough, and not through a wall or a door that is closed."""
    at = lambda *places: jnp.array(places, jnp.float32)
    items = at((-208.0, 0.0), *((32.0, -240.0 + 120 * j) for j in range(5)), (640.0, 0.0))
    wanted, shunned = jnp.arange(7) == 0, (jnp.arange(7) > 0) & (jnp.arange(7) < 6)
    walls = movement.Solids(
        jnp.asarray(layout.around(deferred.ROOM_1), jnp.float32), jnp.ones((4,), bool), jnp.zeros((0, 3))
    )
    way = lambda wanted, shunned: np.asarray(
        players.remaining(
            players.DEFERRING,
            players.distances(players.DEFERRING, walls, items, wanted, shunned),
            jnp.array([272.0, 0.0]),
        )
    )
    straight, around = way(wanted, jnp.zeros((7,), bool)), way(wanted, shunned)
    assert straight == pytest.approx(480.0 - 44.0, abs=10)
    assert straight + 20 < around < straight + 120
    assert np.isinf(way(jnp.arange(7) == 6, shunned)), "the other room is beyond the wall"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "best"), [("rooms/select_nonmatching_object", 77), (SMALL_NONMATCHING, 160)])
def test_memory_is_worth_much_in_nonmatching(name, best, whole_compilation):
    steps = names.default_steps(name)
    play = lambda player: returns_of(tasks.game(name), player, steps)
    assert play(players.scripted(name)).min() >= best
    assert play(players.scripted(name, remembers=False)).mean() < best / 3
    assert play(players.RANDOM).mean() < best / 6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "frames"), [("rooms/select_nonmatching_object", (52, 47)), (SMALL_NONMATCHING, (16, 24))]
)
def test_a_plan_takes_as_few_frames_as_a_wide_search(name, frames, whole_compilation):
    """Walking and strafing in turns, a player is faster than its speed, and lands sideways out of the teleport."""
    at = nonmatching.places(tasks.NONMATCHING[name])
    choice, solids = jnp.asarray(at.choices)[0], nonmatching.solids(at)
    standing = movement.standing(jnp.asarray(at.start), jnp.zeros(()))
    launched = movement.standing(jnp.asarray(at.exit), jnp.zeros(()))._replace(
        velocity=jnp.array([nonmatching.LAUNCH, 0.0]), loose=jnp.asarray(nonmatching.AIRBORNE, jnp.int32)
    )
    legs = [
        (standing, jnp.asarray(at.pad), partial(nonmatching.touches_pad, at)),
        (launched, choice - jnp.array([44.0, 33.0]), lambda place: movement.within_reach(place, choice[None])[0]),
    ]
    walk = jax.jit(lambda body, action: players.walked(body, action, solids, 4))
    for (body, goal, arrived), most in zip(legs, frames, strict=True):
        found = jax.jit(partial(players.plan, arrived=arrived))(body, solids, goal)
        taken = []
        for action in np.asarray(found.actions)[: int(found.length)]:
            body, positions = walk(body, jnp.asarray(action))
            taken += [bool(arrived(place)) for place in positions]
        assert taken.index(True) + 1 <= most
        assert len(taken) - 4 <= taken.index(True), "the plan ends in the step in which it arrives"


def test_a_random_player_of_the_small_nonmatching_meets_rewards_often():
    """And memory is worth much there: a learner has something to begin with, and something to gain."""
    game, returns, met = tasks.game(SMALL_NONMATCHING), [], []
    env = base.from_core(make_core(game, 120, 8)._replace(observe=lambda s: {"image": jnp.zeros((8, 8, 3), jnp.uint8)}))
    state = jax.vmap(env.prepare)(jax.random.split(jax.random.key(0), 64))
    step = jax.jit(jax.vmap(env.step))
    for key in jax.random.split(jax.random.key(1), 121):
        state, timestep = step(state, jax.random.randint(key, (64,), 0, 9, jnp.int32))
        returns.append(np.asarray(timestep.reward))
    met = (np.array(returns) != 0).sum(0)
    assert met.mean() > 5
    assert np.median(met) >= 3
    assert abs(np.sum(returns, axis=0).mean()) < 15


def test_nobody_leaves_the_small_rooms():
    """The player fits in where it starts and lands, and walls hold it."""
    at = nonmatching.places(tasks.NONMATCHING[SMALL_NONMATCHING])
    held = lambda place, room: all(room[2 * i] + 14.9 <= place[i] <= room[2 * i + 1] - 14.9 for i in (0, 1))
    gap = (at.vestibule[0], at.room_2[1], *at.vestibule[2:])
    far = jax.jit(lambda body: players.walked(body, jnp.asarray(0), nonmatching.solids(at), 100)[0].position)
    for start, rooms in ((at.start, [at.room_1]), (at.exit, [at.vestibule, at.room_2, gap])):
        assert held(start, rooms[0])
        for yaw in np.linspace(-3, 3, 9):
            end = np.asarray(far(movement.standing(jnp.asarray(start), jnp.float32(yaw))))
            assert any(held(end, room) for room in rooms), (start, yaw, end)


@pytest.mark.parametrize(
    ("name", "gap"), [("rooms/watermaze_small", 2.0), pytest.param("rooms/watermaze", 1.5, marks=pytest.mark.slow)]
)
def test_memory_is_worth_much_in_the_watermaze(name, gap):
    play = lambda remembers: returns_of(
        tasks.game(name), players.scripted(name, remembers), names.default_steps(name), 64
    )
    best, forgetful = play(True), play(False)
    assert best.mean() > gap * forgetful.mean(), (best.mean(), forgetful.mean())
