"""Draws dm_control states with MuJoCo's own OpenGL renderer and stores them beside the tests.

Needs a software or hardware OpenGL (`MUJOCO_GL=osmesa` or `egl`), which the tests themselves do not::

    MUJOCO_GL=osmesa python -m tests.render.make_references                      # the stored ones: 6 states a domain
    MUJOCO_GL=osmesa python -m tests.render.make_references --states 64 --out /tmp/references.npz

States come from whole episodes under a random policy: a few episodes of ten seconds, the states spread evenly over
them, so that they include starts, fallen bodies and swings at the rails. Where a body can travel, every third state is
moved along the floor by up to fifteen metres, as a trained policy would move it.
"""

from __future__ import annotations

import os
import pathlib

import click
import numpy as np

os.environ.setdefault("MUJOCO_GL", "osmesa")

from dm_control import suite

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
CAMERAS = {"quadruped": 2}
TRAVELLING = {"cheetah": "rootx", "hopper": "rootx", "walker": "rootx", "quadruped": "root"}
PER_EPISODE = ("geom_pos", "geom_size", "site_pos", "site_size", "site_rgba")
STORED = pathlib.Path(__file__).parent / "references.npz"


def draw_states(domain: str, num_states: int, seed: int = 0) -> dict[str, np.ndarray]:
    """States of one domain and MuJoCo's pictures of them.

    Returns arrays with a leading axis of ``num_states``: ``qpos``, ``qvel``, ``image`` uint8 [64, 64, 3], and those of
    ``PER_EPISODE`` that the task has changed from what the model file says.
    """
    rng = np.random.default_rng(seed)
    env = suite.load(domain, TASKS[domain], task_kwargs={"random": seed})
    physics, spec = env.physics, env.action_spec()
    original = {name: np.array(getattr(physics.model, name), np.float32) for name in PER_EPISODE}
    episodes = max(1, min(8, num_states // 2))
    steps = round(10 / env.control_timestep())
    wanted = np.linspace(0, episodes * steps - 1, num_states).astype(int)
    records: list[dict[str, np.ndarray]] = []
    for episode in range(episodes):
        env.reset()
        action = np.zeros(spec.shape)
        for step in range(steps):
            for _ in range(int(np.sum(wanted == episode * steps + step))):
                if domain in TRAVELLING and len(records) % 3 == 2:
                    physics.named.data.qpos[TRAVELLING[domain]][:1] += rng.uniform(0, 15)
                physics.forward()
                records.append(
                    {
                        "qpos": physics.data.qpos.copy(),
                        "qvel": physics.data.qvel.copy(),
                        "image": physics.render(SIZE, SIZE, camera_id=CAMERAS.get(domain, 0)),
                        **{name: np.array(getattr(physics.model, name), np.float32) for name in PER_EPISODE},
                    }
                )
            # Actions that hold for a while carry the body further than white noise does.
            if rng.random() < 0.2:
                action = rng.uniform(spec.minimum, spec.maximum)
            env.step(action)
    arrays = {name: np.stack([record[name] for record in records]) for name in records[0]}
    return {name: value for name, value in arrays.items() if name not in original or (value != original[name]).any()}


@click.command(help=__doc__)
@click.option("--states", default=6, show_default=True, help="States a domain.")
@click.option("--out", type=click.Path(path_type=pathlib.Path), default=STORED, show_default=True)
@click.option("--domain", "domains", multiple=True, type=click.Choice(sorted(TASKS)), help="Default: all ten.")
def main(states: int, out: pathlib.Path, domains: tuple[str, ...]) -> None:
    arrays: dict[str, np.ndarray] = {}
    for domain in domains or sorted(TASKS):
        for name, value in draw_states(domain, states).items():
            arrays[f"{domain}/{name}"] = value
    np.savez_compressed(out, **arrays)  # type: ignore[arg-type]
    print(f"{out}: {states} states of {len(domains or TASKS)} domains, {out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
