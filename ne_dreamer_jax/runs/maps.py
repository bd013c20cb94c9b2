"""An episode of a Rooms task from above: walls, objects, the player's path, and beside them what it saw."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs.base import Env
from ne_dreamer_jax.envs.rooms import movement, watermaze
from ne_dreamer_jax.envs.rooms.game import Game, State
from ne_dreamer_jax.runs import plots, video
from ne_dreamer_jax.types import Array, TimeStep

Act = Callable[[TimeStep, State, Any, Array], tuple[Array, Any]]
"""(time step, state of the rules, what the player keeps, key) -> action, what it keeps; for one environment."""

FRAMES_SHOWN = 8  # beside a picture
JUMP = 60.0  # units; who moves farther in a step was carried
PATH, GAIN, LOSS = "#0072b2", "#009e73", "#d55e00"  # of the Okabe-Ito palette


class Seen(NamedTuple):
    """An episode of T time steps; numpy throughout."""

    position: np.ndarray  # float32 [T, 2], units
    yaw: np.ndarray  # float32 [T], radians
    reward: np.ndarray  # float32 [T], on arrival
    image: np.ndarray  # uint8 [T, H, W, 3]
    walls: np.ndarray  # float32 [T, S, 4], ends; NaN where one is not there
    items: np.ndarray  # float32 [T, N, 2], objects or, where there are none, landmarks; NaN where one is not there
    colours: np.ndarray  # float32 [T, N, 3], 0 to 1
    hidden: np.ndarray  # float32 [T, 3]: x, y and radius of what is not seen; NaN where there is no such thing


def play(env: Env, game: Game, act: Act, kept: Any, key: Array, steps: int) -> Seen:
    """The first episode from ``key``, of at most ``steps`` steps.

    Args:
      env: made of ``game``, with an ``image``.
      kept: what the player keeps at the start.
    """

    def look(state: State) -> dict[str, Array]:
        with jax.numpy_rank_promotion("allow"):
            scene = game.scene(state.body, state.task, state.clock)
        there = lambda x, mask: jnp.where(mask[:, None], x, jnp.nan)
        platform = isinstance(state.task, watermaze.Watermaze)
        hidden = jnp.append(state.task.platform, watermaze.REACH) if platform else jnp.full((3,), jnp.nan)
        items, landmarks = scene.items, scene.posters
        places, colours = there(items.position, items.active), items.colour
        if landmarks is not None:
            places, colours = landmarks.position, landmarks.colour
        return {
            "walls": there(scene.walls.ends, scene.walls.active & (scene.walls.bottom <= 0)),
            "items": places,
            "colours": jnp.clip(colours / 255, 0, 1),
            "hidden": hidden,
        }

    def step(carry: tuple[Any, Any, Array, Array], key: Array) -> tuple[Any, Any]:
        state, kept, action, over = carry
        state, timestep = env.step(state, action)
        action, kept = act(timestep, state.core, kept, key)
        seen = {
            "position": state.position, "yaw": state.yaw, "reward": timestep.reward, "image": timestep.obs["image"],
            **look(state.core),
        }  # fmt: skip
        return (state, kept, action, over | timestep.is_last), (seen, over)

    begin = (env.prepare(key), kept, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    seen, over = jax.jit(lambda begin, keys: jax.lax.scan(step, begin, keys)[1])(
        begin, jax.random.split(jax.random.fold_in(key, 1), steps + 1)
    )
    length = int((~np.asarray(over)).sum())
    return Seen(**{name: np.asarray(value)[:length] for name, value in seen.items()})


def picture(seen: Seen, path: Path, title: str) -> None:
    """The whole path on the map, and frames of moments that are numbered there, as a PNG that is replaced whole."""
    length = len(seen.yaw)
    moments = _moments(seen)
    with plots.figure(10.4, 3.9, dpi=110) as figure:
        grid = figure.add_gridspec(2, 6)
        axes = figure.add_subplot(grid[:, :2])
        _room(axes, seen, 0)
        _items(axes, seen, 0)
        walked = _path(seen, 0, length)
        axes.plot(walked[:, 0], walked[:, 1], color=PATH, lw=1.0, alpha=0.7)
        _rewards(axes, seen, length)
        for number, t in enumerate(moments, 1):
            axes.annotate(str(number), seen.position[t], fontsize=7, ha="center", va="center", zorder=6,
                          bbox={"boxstyle": "circle,pad=0.15", "fc": "white", "ec": PATH, "lw": 0.8})  # fmt: skip
        axes.set_title(f"{title}\nreturn {seen.reward.sum():g} in {length - 1} steps", fontsize=8)
        for number, t in enumerate(moments):
            frame = figure.add_subplot(grid[number // 4, 2 + number % 4])
            frame.imshow(seen.image[t], interpolation="nearest")
            frame.set_title(f"{number + 1}: step {t}", fontsize=7, pad=2)
            frame.set_axis_off()
        plots.save(figure, path)


def film(seen: Seen, path: Path, title: str, fps: float) -> None:
    """The map and the frame of each step side by side, as an mp4; errors as of `video.write`."""
    with plots.figure(6.4, 3.4, dpi=100) as figure:
        left, right = figure.subplots(1, 2)
        _room(left, seen, 0)
        right.set_axis_off()
        figure.suptitle(title, fontsize=8)
        left.set_title(" ", fontsize=8)
        canvas: Any = figure.canvas
        canvas.draw()
        figure.set_layout_engine("none")  # what follows moves nothing
        frames = []
        image = right.imshow(seen.image[0], interpolation="nearest", animated=True)
        line = left.plot([], [], color=PATH, lw=1.2, animated=True)[0]
        told = left.set_title(" ", fontsize=8)
        told.set_animated(True)
        canvas.draw()
        clean = canvas.copy_from_bbox(figure.bbox)
        for t in range(len(seen.yaw)):
            canvas.restore_region(clean)
            walked = _path(seen, max(0, t - 150), t + 1)
            line.set_data(walked[:, 0], walked[:, 1])
            image.set_data(seen.image[t])
            told.set_text(f"step {t}, return {seen.reward[: t + 1].sum():g}")
            passing = [*_items(left, seen, t), *_player(left, seen, t), *_door(left, seen, t)]
            for artist in (*passing, line, image, told):
                artist.axes.draw_artist(artist)
            frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
            for artist in passing:
                artist.remove()
    video.write(np.stack(frames), path, fps=fps)


def _room(axes: Any, seen: Seen, t: int) -> None:
    """What stays: walls, and the rim of what is hidden."""
    stays = np.isfinite(seen.walls).all((0, 2))
    for x0, y0, x1, y1 in seen.walls[t][stays]:
        axes.plot([x0, x1], [y0, y1], color="k", lw=1.6, solid_capstyle="round")
    if np.isfinite(seen.hidden[t]).all():
        x, y, radius = seen.hidden[t]
        turn = np.linspace(0, 2 * np.pi, 60)
        axes.plot(x + radius * np.cos(turn), y + radius * np.sin(turn), color="k", lw=0.8, ls=":")
    axes.set_aspect("equal")
    axes.set_axis_off()


def _door(axes: Any, seen: Seen, t: int) -> list[Any]:
    """Walls that are there for a part of the episode."""
    passing = ~np.isfinite(seen.walls).all((0, 2)) & np.isfinite(seen.walls[t]).all(1)
    return [axes.plot([a, c], [b, d], color="0.5", lw=3)[0] for a, b, c, d in seen.walls[t][passing]]


def _items(axes: Any, seen: Seen, t: int) -> list[Any]:
    shown = np.isfinite(seen.items[t]).all(1)
    x, y = seen.items[t][shown].T
    return [axes.scatter(x, y, c=seen.colours[t][shown], s=26, edgecolors="k", linewidths=0.4, zorder=3)]


def _player(axes: Any, seen: Seen, t: int) -> list[Any]:
    """Where it is, and the quarter of a circle that it sees."""
    (x, y), yaw = seen.position[t], seen.yaw[t]
    rim = yaw + np.linspace(-np.pi / 4, np.pi / 4, 9)
    view = axes.fill([x, *(x + 110 * np.cos(rim))], [y, *(y + 110 * np.sin(rim))], color=PATH, alpha=0.25, lw=0)
    half = movement.HALF_WIDTH
    body = axes.fill([x - half, x + half, x + half, x - half], [y - half, y - half, y + half, y + half], color=PATH)
    return [*view, *body]


def _moments(seen: Seen) -> np.ndarray:
    """Evenly spaced steps, int [..], whose frames are shown; of two rounds, where a player is carried to and fro."""
    carried = np.flatnonzero(_carried(seen))
    length = int(carried[3]) if len(carried) > 3 else len(seen.yaw)
    return np.linspace(0, length - 1, min(FRAMES_SHOWN, length)).round().astype(int)


def _rewards(axes: Any, seen: Seen, length: int) -> None:
    """Where something was gained or lost: where the player was before, as some rewards carry it away."""
    for t in np.flatnonzero(seen.reward[:length]):
        at = seen.position[t - 1 if _carried(seen)[t] else t]
        axes.plot(*at, marker="*", ms=6, color=GAIN if seen.reward[t] > 0 else LOSS, mec="k", mew=0.3, zorder=5)


def _carried(seen: Seen) -> np.ndarray:
    """Whether each step ends elsewhere than walking leads, bool [T]."""
    moved = np.linalg.norm(np.diff(seen.position, axis=0), axis=1)
    return np.concatenate([[False], moved > JUMP])


def _path(seen: Seen, begin: int, end: int) -> np.ndarray:
    """Positions with gaps (NaN) where the player was carried, [.., 2]."""
    places = seen.position[begin:end]
    return np.insert(places, np.flatnonzero(_carried(seen)[begin:end]), np.nan, axis=0)
