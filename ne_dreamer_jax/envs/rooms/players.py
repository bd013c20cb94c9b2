"""Scripted players, which know where everything is and how they move: what there is to reach, what memory is worth.

Each is a pure function of the environment's state and of what the player keeps, for one environment. `scripted` has one
for every task.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.rooms import collect, deferred, nonmatching, tasks, watermaze
from ne_dreamer_jax.envs.rooms.game import State
from ne_dreamer_jax.envs.rooms.movement import CONTROLS, FRAMES_PER_STEP, HALF_WIDTH, Body, Solids, walk, within_reach
from ne_dreamer_jax.types import Array

FORWARD, LEFT, RIGHT, FORWARD_LEFT, FORWARD_RIGHT, IDLE = 0, 4, 5, 6, 7, 8
COAST = 24  # frames in which any player comes to rest


class Player(NamedTuple):
    """Somebody who plays one environment."""

    start: Any  # what it keeps at the start of an episode
    act: Callable[[State, Any, Array], tuple[Array, Any]]
    """(state, what it keeps, key) -> action int32 [], what it keeps from now on."""


def steer(position: Array, yaw: Array, goal: Array) -> Array:
    """The action, int32 [], that turns and walks straight to ``goal`` [2]."""
    towards = goal - position
    bearing = jnp.arctan2(towards[1], towards[0]) - yaw
    bearing = jnp.mod(bearing + jnp.pi, 2 * jnp.pi) - jnp.pi
    turn = jnp.where(bearing > 0, LEFT, RIGHT)
    both = jnp.where(bearing > 0, FORWARD_LEFT, FORWARD_RIGHT)
    size = jnp.abs(bearing)
    return jnp.where(size > 0.9, turn, jnp.where(size > 0.06, both, FORWARD)).astype(jnp.int32)


def walked(body: Body, action: Array, solids: Solids, frames: int) -> tuple[Body, Array]:
    """The body after so many frames of one action, and its positions [frames, 2] after each."""
    controls = jnp.asarray(CONTROLS)[action]

    def frame(body: Body, _: None) -> tuple[Body, Array]:
        body = walk(body, controls, solids)
        return body, body.position

    return jax.lax.scan(frame, body, None, length=frames)


# Taking some objects and no others.


class Chart(NamedTuple):
    """A grid of places over a task's rooms: the ways that there are."""

    nodes: np.ndarray  # float32 [X, Y, 2]
    pitch: np.ndarray  # float32 [2]


class Way(NamedTuple):
    """What a player that follows a chart keeps."""

    distance: Array  # float32 [X, Y], from each place to the nearest object that is wanted; inf where there is no way
    wanted: Array  # bool [N], for which objects that was found
    open: Array  # bool [K], through which solids


MARGIN = 3.0  # units that a way keeps from what is shunned, beyond what picks it up
COLLECTING = Chart(
    np.stack(np.meshgrid(np.arange(-550.0, 1001.0, 25.0), np.arange(-725.0, 551.0, 25.0), indexing="ij"), -1).astype(
        np.float32
    ),
    np.array([25.0, 25.0], np.float32),
)
# Objects of both rooms lie on these lines, whose lattices are 8 apart.
DEFERRING = Chart(
    np.stack(np.meshgrid(np.arange(-256.0, 1049.0, 8.0), np.arange(-240.0, 241.0, 24.0), indexing="ij"), -1).astype(
        np.float32
    ),
    np.array([8.0, 24.0], np.float32),
)


def nowhere(chart: Chart, items: int, solids: int) -> Way:
    """At the start: nothing was wanted yet, so that the first look finds a way."""
    shape = chart.nodes.shape[:2]
    return Way(jnp.full(shape, jnp.inf, jnp.float32), jnp.zeros((items,), bool), jnp.zeros((solids,), bool))


def distances(chart: Chart, solids: Solids, items: Array, wanted: Array, shunned: Array) -> Array:
    """Length of the way from each place, float32 [X, Y], to a wanted object [N], past the shunned ones [N]."""
    nodes = jnp.asarray(chart.nodes)
    box, item = solids.boxes[None, None], items[None, None]
    x, y, wide = nodes[..., None, 0], nodes[..., None, 1], HALF_WIDTH
    inside = (x > box[..., 0] - wide) & (x < box[..., 1] + wide) & (y > box[..., 2] - wide) & (y < box[..., 3] + wide)
    dx, dy = x - item[..., 0], y - item[..., 1]
    near = (dx >= -50.0 - MARGIN) & (dx <= 44.0 + MARGIN) & (jnp.abs(dy) <= 36.0 + MARGIN)
    blocked = (inside & solids.active[None, None]).any(-1) | (near & shunned[None, None]).any(-1)
    reached = jax.vmap(jax.vmap(lambda place: (within_reach(place, items) & wanted).any()))(nodes)
    here = jnp.where(blocked, jnp.inf, jnp.where(reached, 0.0, jnp.inf)).astype(jnp.float32)
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    lengths = [float(np.hypot(i * chart.pitch[0], j * chart.pitch[1])) for i, j in steps]
    count_x, count_y = here.shape

    def relax(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        old, _ = carry
        around = jnp.pad(old, 1, constant_values=jnp.inf)
        new = old
        for (i, j), length in zip(steps, lengths, strict=True):
            new = jnp.minimum(new, around[1 + i : 1 + i + count_x, 1 + j : 1 + j + count_y] + length)
        new = jnp.where(blocked, jnp.inf, new)
        return new, (new < old).any()

    return jax.lax.while_loop(lambda carry: carry[1], relax, (here, jnp.ones((), bool)))[0]


def remaining(chart: Chart, distance: Array, position: Array) -> Array:
    """Length of the way from ``position`` [2] over the best of the places around it, float32 []."""
    at = jnp.round((position - jnp.asarray(chart.nodes[0, 0])) / jnp.asarray(chart.pitch)).astype(jnp.int32)
    near = at[None] + jnp.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)], jnp.int32)
    near = jnp.clip(near, 0, jnp.array([distance.shape], jnp.int32) - 1)
    off = jnp.linalg.norm(jnp.asarray(chart.nodes)[near[:, 0], near[:, 1]] - position[None], axis=1)
    return jnp.min(distance[near[:, 0], near[:, 1]] + off)


def take(chart: Chart, solids: Solids, body: Body, items: Array, wanted: Array, shunned: Array, way: Way) -> Any:
    """The action that comes nearest to a wanted object and touches no shunned one, int32 [], and the way.

    Each action is tried: for its four frames and until the player is at rest again, which must be safe. What is left
    of the way from there never grows, so that no circles are walked; where nothing shortens it the player turns.
    """
    stale = (way.wanted != wanted).any() | (way.open == solids.active).any()
    fresh = lambda: Way(distances(chart, solids, items, wanted, shunned), wanted, ~solids.active)
    way = base.if_needed(stale, fresh, way)

    def left(action: Array) -> Array:
        moved, first = walked(body, action, solids, FRAMES_PER_STEP)
        rest, then = walked(moved, jnp.full((), IDLE, jnp.int32), solids, COAST)
        touched = jax.vmap(lambda place: within_reach(place, items))(jnp.concatenate([first, then]))
        got = (touched & wanted[None]).any()
        safe = ~(touched & shunned[None]).any()
        return jnp.where(safe, jnp.where(got, 0.0, remaining(chart, way.distance, rest.position)), jnp.inf)

    actions = jnp.array([LEFT, 0, 1, 2, 3, FORWARD_LEFT, FORWARD_RIGHT, IDLE], jnp.int32)
    lengths = jax.vmap(left)(actions)
    best = jnp.where(jnp.isfinite(lengths).any(), jnp.argmin(lengths), len(actions) - 1)
    return actions[best], way


def collects(state: State, way: Way) -> tuple[Array, Way]:
    """Takes the good objects and goes around the bad ones."""
    task: collect.Collect = state.task
    good, there = jnp.arange(20) >= 10, task.taken.there
    return take(COLLECTING, collect.solids(), state.body, task.items, good & there, ~good & there, way)


def defers(state: State, way: Way) -> tuple[Array, Way]:
    """Takes the box where it opens the door, and apples only where there are no cakes to be had."""
    task: deferred.Deferred = state.task
    there, kinds = task.taken.there, jnp.asarray(deferred.KINDS)
    two, box = task.config[0] > 0, there[deferred.BOX]
    opens = two & (task.config[1] > 0)
    cakes = (two & (task.config[3] > 0)) | (task.since_box >= 0)
    wanted = jnp.where(opens & box, kinds == 1, jnp.where(cakes & two, kinds == 2, kinds == 0)) & there
    return take(DEFERRING, deferred.solids(task), state.body, task.items, wanted, there & ~wanted, way)


# Choosing.

AHEAD = 16  # agent steps that a plan has at most
BEAM = 32  # beginnings of plans that are thought on


class Plan(NamedTuple):
    """What a player that thinks first keeps: the actions that bring it where it goes next."""

    actions: Array  # int32 [AHEAD]
    length: Array  # int32 [], actions until it is there
    done: Array  # int32 [], how many of them were taken


def no_plan() -> Plan:
    """At the start."""
    return Plan(jnp.zeros((AHEAD,), jnp.int32), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def plan(body: Body, solids: Solids, goal: Array, arrived: Callable[[Array], Array]) -> Plan:
    """The actions that arrive in the fewest frames, of those that a beam search sees.

    At every step it goes on from the `BEAM` beginnings that end nearest to ``goal`` [2]. Where none arrives within
    `AHEAD` steps, the plan is the one that ends nearest. ``arrived``: position [2] -> bool [].
    """
    choices = len(CONTROLS)

    def grow(carry: tuple[Any, Array, Array, Array, Array], step: Array) -> tuple[Any, None]:
        bodies, alive, plans, frames, best = carry
        move = lambda body: jax.vmap(lambda action: walked(body, action, solids, FRAMES_PER_STEP))(jnp.arange(choices))
        bodies, positions = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), jax.vmap(move)(bodies))
        plans = jnp.repeat(plans, choices, axis=0).at[:, step].set(jnp.tile(jnp.arange(choices, dtype=jnp.int32), BEAM))
        alive = jnp.repeat(alive, choices)
        there = jax.vmap(jax.vmap(arrived))(positions) & alive[:, None]
        when = jnp.where(there.any(1), step * FRAMES_PER_STEP + jnp.argmax(there, 1).astype(jnp.int32), NEVER)
        first = jnp.argmin(when)
        sooner = when[first] < frames
        frames, best = jnp.where(sooner, when[first], frames), jnp.where(sooner, plans[first], best)
        far = jnp.linalg.norm(bodies.position - goal[None], axis=1)
        nearness, top = jax.lax.top_k(jnp.where(alive & (when == NEVER), -far, -jnp.inf), BEAM)
        bodies, plans = jax.tree.map(lambda x: x[top], (bodies, plans))
        return (bodies, jnp.isfinite(nearness), plans, frames, jnp.where(frames == NEVER, plans[0], best)), None

    begin = (
        jax.tree.map(lambda x: jnp.broadcast_to(x, (BEAM, *x.shape)), body),
        jnp.arange(BEAM) == 0,
        jnp.zeros((BEAM, AHEAD), jnp.int32),
        jnp.full((), NEVER, jnp.int32),
        jnp.zeros((AHEAD,), jnp.int32),
    )
    (_, _, _, frames, best), _ = jax.lax.scan(grow, begin, jnp.arange(AHEAD, dtype=jnp.int32))
    length = jnp.minimum(frames // FRAMES_PER_STEP + 1, AHEAD)
    return Plan(best, length, jnp.zeros((), jnp.int32))


NEVER = 1_000_000


def selects(state: State, at: nonmatching.Places, remembers: bool, kept: Plan) -> tuple[Array, Plan]:
    """Goes to the pad and then to the other object; without memory to either, as a coin falls once a map.

    It thinks anew whenever it arrives.
    """
    task: nonmatching.Nonmatching = state.task
    coin = jax.random.bernoulli(jax.random.fold_in(jax.random.key(0), task.other + 36 * task.example))
    choice = jnp.asarray(at.choices)[task.place if remembers else coin.astype(jnp.int32)]
    in_first = state.position[0] < (at.room_1[1] + at.vestibule[0]) / 2
    # Where it is first within reach, coming from the middle.
    aside = jnp.stack([jnp.asarray(-44.0), 33.0 * jnp.sign(jnp.asarray(at.exit)[1] - choice[1])])
    goal = jnp.where(in_first, jnp.asarray(at.pad), choice + aside)

    def arrived(position: Array) -> Array:
        chosen = within_reach(position, choice[None])[0]
        return jnp.where(in_first, nonmatching.touches_pad(at, position), chosen)

    think = lambda: plan(state.body, nonmatching.solids(at), goal, arrived)
    kept = base.if_needed(kept.done >= kept.length, think, kept)
    return kept.actions[kept.done], kept._replace(done=kept.done + 1)


# Finding.


class Memory(NamedTuple):
    """What a player of the watermaze keeps."""

    platform: Array  # float32 [2]
    known: Array  # bool []
    goal: Array  # float32 [2], where it is going while it knows nothing


NO_MEMORY = Memory(jnp.zeros((2,)), jnp.zeros((), bool), jnp.zeros((2,)))
"""At the start."""


def swims(state: State, memory: Memory, remembers: bool, radius: float, key: Array) -> tuple[Array, Memory]:
    """Goes from one place to another in a disc of ``radius`` until it has found the platform.

    If it remembers, it goes straight there in all later trials.
    """
    task: watermaze.Watermaze = state.task
    found = task.found > 0
    radius_key, angle_key = jax.random.split(key)
    angle = jax.random.uniform(angle_key, (), jnp.float32, -jnp.pi, jnp.pi)
    place = (
        radius * jnp.sqrt(jax.random.uniform(radius_key, (), jnp.float32)) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    )
    there = jnp.linalg.norm(memory.goal - state.position) < 60.0
    goal = jnp.where(there | found, place, memory.goal)
    memory = Memory(jnp.where(found, task.platform, memory.platform), memory.known | found, goal)
    target = jnp.where(memory.known & remembers, memory.platform, goal)
    return steer(state.position, state.yaw, target), memory


# Everybody.


def at_random(state: State, kept: tuple[()], key: Array) -> tuple[Array, tuple[()]]:
    """Any action."""
    return jax.random.randint(key, (), 0, len(CONTROLS), jnp.int32), kept


RANDOM = Player((), at_random)


def scripted(name: str, remembers: bool = True) -> Player:
    """The player of a task, by its name; one that forgets goes by what it sees at the moment, where that differs."""
    if name in tasks.NONMATCHING:
        at = nonmatching.places(tasks.NONMATCHING[name])
        return Player(no_plan(), lambda state, kept, key: selects(state, at, remembers, kept))
    if name in tasks.WATERMAZE:
        radius = tasks.WATERMAZE[name] * watermaze.DISC
        return Player(NO_MEMORY, lambda state, kept, key: swims(state, kept, remembers, radius, key))
    if name in tasks.DEFERRED:
        return Player(nowhere(DEFERRING, 21, 7), lambda state, kept, key: defers(state, kept))
    return Player(nowhere(COLLECTING, 20, 4), lambda state, kept, key: collects(state, kept))
