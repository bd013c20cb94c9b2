"""Draws Control Suite states with MuJoCo's own OpenGL renderer: what ``ne_dreamer_jax.render`` is compared with.

States come from whole episodes under random actions, spread evenly over up to eight episodes of ten seconds, so that
they include starts, falls and limits. Where a body can travel, every third state is moved along the floor by up to
fifteen metres, as a trained policy would move it.

The tests need no OpenGL: they read pictures that this command has stored. With a software OpenGL (Mesa's OSMesa; on
Debian ``apt-get install libosmesa6``), from the repository's root::

    MUJOCO_GL=osmesa python -m benchmarks.mujoco_pictures --states 6 --out tests/render/references.npz
"""

from __future__ import annotations

import os
import pathlib
import sys
import types
from typing import Any, NamedTuple

import click
import numpy as np

from ne_dreamer_jax.commands.options import UserPath

SIZE = 64
TASKS = {
    "acrobot": "swingup",
    "ball_in_cup": "catch",
    "cartpole": "swingup",
    "cheetah": "run",
    "finger": "turn_easy",
    "hopper": "hop",
    "pendulum": "swingup",
    "quadruped": "run",
    "reacher": "easy",
    "walker": "walk",
}
_CAMERAS = {"quadruped": 2}
_TRAVELLERS = {"cheetah": "rootx", "hopper": "rootx", "walker": "rootx", "quadruped": "root"}  # and their joint
_PER_EPISODE = ("geom_pos", "geom_size", "site_pos", "site_size", "site_rgba")
_SECONDS, _MAX_EPISODES = 10, 8
_POSE = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "xpos", "subtree_com")


class Pictures(NamedTuple):
    """States of one domain and MuJoCo's pictures of them; arrays have a leading axis over the states."""

    model: Any  # mujoco.MjModel
    camera: int
    data: dict[str, np.ndarray]  # what draw needs of an mjx.Data, float32
    sizes: dict[str, np.ndarray]  # fields of render.Overrides
    images: np.ndarray  # uint8 [states, 64, 64, 3]


def play(domain: str, num_states: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Plays episodes and draws states of them: ``qpos``, ``qvel``, ``image``, and what the task changed of the model.

    Needs OpenGL.
    """
    rng = np.random.default_rng(seed)
    env = _load(domain, seed)
    physics, spec = env.physics, env.action_spec()
    original = {name: np.array(getattr(physics.model, name), np.float32) for name in _PER_EPISODE}
    episodes = max(1, min(_MAX_EPISODES, num_states // 2))
    steps = round(_SECONDS / env.control_timestep())
    wanted = np.linspace(0, episodes * steps - 1, num_states).astype(int)
    records: list[dict[str, np.ndarray]] = []
    for episode in range(episodes):
        env.reset()
        action = np.zeros(spec.shape)
        for step in range(steps):
            for _ in range(int(np.sum(wanted == episode * steps + step))):
                if domain in _TRAVELLERS and len(records) % 3 == 2:
                    physics.named.data.qpos[_TRAVELLERS[domain]][:1] += rng.uniform(0, 15)
                physics.forward()
                record = {name: np.array(getattr(physics.model, name), np.float32) for name in _PER_EPISODE}
                record |= {"qpos": physics.data.qpos.copy(), "qvel": physics.data.qvel.copy()}
                record["image"] = physics.render(SIZE, SIZE, camera_id=_CAMERAS.get(domain, 0))
                records.append(record)
            # Actions that hold for a while carry a body further than white noise does.
            if rng.random() < 0.2:
                action = rng.uniform(spec.minimum, spec.maximum)
            env.step(action)
    arrays = {name: np.stack([record[name] for record in records]) for name in records[0]}
    return {name: value for name, value in arrays.items() if name not in original or (value != original[name]).any()}


def load(path: pathlib.Path, domain: str) -> Pictures:
    """Reads what the command stored. Needs no OpenGL."""
    import mujoco

    arrays = _read(path, domain)
    model = _load(domain).physics.model.ptr
    original = {name: getattr(model, name).copy() for name in _PER_EPISODE}
    data = mujoco.MjData(model)
    poses: list[dict[str, np.ndarray]] = []
    for i in range(len(arrays["image"])):
        _set_state(model, data, arrays, i)
        poses.append({name: np.array(getattr(data, name), np.float32) for name in _POSE})
    for name, value in original.items():
        getattr(model, name)[:] = value
    stacked = {name: np.stack([pose[name] for pose in poses]) for name in _POSE}
    sizes: dict[str, np.ndarray] = {
        name: arrays[name] for name in ("geom_size", "site_size", "site_rgba") if name in arrays
    }
    return Pictures(model, _CAMERAS.get(domain, 0), stacked, sizes, arrays["image"])


def drawer(scene: Any) -> Any:
    """A function that draws stored states, ``(data, sizes) -> uint8 [states, 64, 64, 3]``; to be jitted."""
    import jax

    from ne_dreamer_jax import render

    def one(data: dict[str, Any], sizes: dict[str, Any]) -> jax.Array:
        return render.draw(scene, types.SimpleNamespace(**data), render.Overrides(**sizes))

    return jax.vmap(one)


def serve(path: pathlib.Path) -> None:
    """For every line ``domain count`` from standard input draws so many of its states, then prints a line.

    Needs OpenGL.
    """
    loaded: dict[str, tuple[Any, dict[str, np.ndarray]]] = {}
    for line in sys.stdin:
        domain, count = line.split()
        if domain not in loaded:
            loaded[domain] = (_load(domain).physics, _read(path, domain))
        physics, arrays = loaded[domain]
        for i in range(int(count)):
            _set_state(physics.model.ptr, physics.data.ptr, arrays, i)
            physics.render(SIZE, SIZE, camera_id=_CAMERAS.get(domain, 0))
        print("drawn", flush=True)


def _load(domain: str, seed: int = 0) -> Any:
    from dm_control import suite

    return suite.load(domain, TASKS[domain], task_kwargs={"random": seed})


def _read(path: pathlib.Path, domain: str) -> dict[str, np.ndarray]:
    with np.load(path) as stored:
        names = [name for name in stored.files if name.startswith(f"{domain}/")]
        return {name.removeprefix(f"{domain}/"): stored[name] for name in names}


def _set_state(model: Any, data: Any, arrays: dict[str, np.ndarray], i: int) -> None:
    import mujoco

    for name in _PER_EPISODE:
        if name in arrays:
            getattr(model, name)[:] = arrays[name][i]
    data.qpos[:], data.qvel[:] = arrays["qpos"][i], arrays["qvel"][i]
    mujoco.mj_forward(model, data)


@click.command(help=__doc__, context_settings={"max_content_width": 110})
@click.option("--states", type=click.IntRange(1), default=64, show_default=True, help="States of each domain.")
@click.option("--out", type=UserPath(), help="Where to store them.")
@click.option("--domain", "domains", multiple=True, type=click.Choice(sorted(TASKS)), help="Default: all ten.")
@click.option("--serve", "stored", type=click.Path(exists=True, path_type=pathlib.Path), hidden=True)
def main(states: int, out: pathlib.Path | None, domains: tuple[str, ...], stored: pathlib.Path | None) -> None:
    os.environ.setdefault("MUJOCO_GL", "osmesa")
    if stored is not None:
        serve(stored)
        return
    if out is None:
        raise click.UsageError("expected --out PATH, where to store the pictures")
    chosen = domains or tuple(sorted(TASKS))
    arrays = {f"{domain}/{name}": value for domain in chosen for name, value in play(domain, states).items()}
    np.savez_compressed(out, **arrays)  # type: ignore[arg-type]
    print(f"{out}: {states} states of {len(chosen)} domains, {out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
