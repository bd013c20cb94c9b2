"""Every method's first updates on a fixed replay of a real task: ``python -m tests.golden.run --help``.

``replay.npz`` holds steps of DeepMind Control's cartpole under random actions, pixels and vectors; ``losses.npz`` the
losses of every update of every method, of a very small agent. Run with ``--write`` after a change that is meant to move
them, and say in the commit why they moved.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax import config as configs
from ne_dreamer_jax import envs, make_agent
from ne_dreamer_jax.agents.dreamer.agent import AgentConfig
from ne_dreamer_jax.agents.dreamer.behavior import BehaviorConfig
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.agents.optim import OptimizerConfig
from ne_dreamer_jax.nets.encoder import EncoderConfig
from ne_dreamer_jax.nets.heads import HeadsConfig
from ne_dreamer_jax.nets.predictor import PredictorConfig
from ne_dreamer_jax.nets.rssm import RSSMConfig
from ne_dreamer_jax.objectives import DreamerPro, NextEmbedding
from ne_dreamer_jax.replay import ring as replays
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.types import ArraySpec, Batch, ContinuousAction, EnvSpec, Latent, Transition

HERE = Path(__file__).parent
REPLAY, LOSSES = HERE / "replay.npz", HERE / "losses.npz"
TASK, SIDE, ENVS, STEPS = "dmc/cartpole_swingup", 16, 4, 96
UPDATES = 200
# Latents are drawn by comparing random numbers with probabilities: where another processor rounds one of them to the
# other side the runs part, which in this many updates is unlikely, and likely in all of them.
ALIKE, PARTED = 20, {"r2dreamer": 8, "ne_dreamer": 16}  # updates that are compared; where a run is known to have parted
TOLERANCE = 1e-3
"""Relative, also to a loss's largest value."""
METHODS = tuple(name for name in names.METHODS if "/" not in name)
FLAGS = ("is_first", "is_last", "is_terminal")


def config(method: str) -> AgentConfig | DrQv2Config:
    """The very small agent of a method."""
    if method == "drqv2":
        return DrQv2Config(batch_size=32, channels=8, features=8, units=32, learning_rate=1e-3, shift=1)
    agent = AgentConfig(
        encoder=EncoderConfig(depth=4, multipliers=(2, 2), layers=1, units=16),
        rssm=RSSMConfig(deter=64, stoch=8, classes=4, hidden=16, blocks=4, prior_layers=1),
        heads=HeadsConfig(units=16, actor_layers=1, critic_layers=1, bins=31),
        objective=NextEmbedding(PredictorConfig(layers=1, width=16, heads=2, feedforward=32, positions=8)),
        behavior=BehaviorConfig(horizon=4),
        optimizer=OptimizerConfig(learning_rate=1e-3, warmup=10),
        batch_size=8,
        batch_length=8,
    )
    made = configs.with_method(configs.Config(agent=agent), method).agent
    if isinstance(made.objective, DreamerPro):  # both phases of the prototypes within the run
        return replace(made, objective=replace(made.objective, prototypes=16, dimension=8, frozen_updates=50))
    return made


def collect() -> dict[str, np.ndarray]:
    """Steps of the task under random actions, ``[STEPS, ENVS, ...]``."""
    env = envs.make(TASK, obs="both", action_repeat=2, image_size=SIDE)

    def step(carry: Any, key: jax.Array) -> Any:
        state, timestep = carry
        action = jax.random.uniform(key, (ENVS, *env.spec.action.shape), minval=-1.0)
        return jax.vmap(env.step)(state, action), (timestep, action)

    start_key, key = jax.random.split(jax.random.key(0))
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(start_key, ENVS))
    _, (timestep, action) = jax.jit(lambda start, keys: jax.lax.scan(step, start, keys))(
        start, jax.random.split(key, STEPS)
    )
    data = {f"obs/{name}": value for name, value in timestep.obs.items()}
    data |= {"action": action, "reward": timestep.reward, **{name: getattr(timestep, name) for name in FLAGS}}
    return {name: np.asarray(value) for name, value in data.items()}


def load(agent: AgentConfig | DrQv2Config) -> tuple[EnvSpec, replays.Replay]:
    """The stored replay as a ring that is full, with zero latents, and the environment's spec."""
    with np.load(REPLAY) as file:
        data = {name: jnp.asarray(file[name]) for name in file.files}
    obs = {name.removeprefix("obs/"): x for name, x in data.items() if name.startswith("obs/")}
    deter, stoch, classes = agent.latent_sizes
    latent = Latent(jnp.zeros((STEPS, ENVS, deter)), jnp.zeros((STEPS, ENVS, stoch), jnp.uint8))
    flags = [data[name] for name in FLAGS]
    ring = replays.Replay(
        Transition(obs, data["action"], data["reward"], *flags, latent),
        jnp.zeros((), jnp.int32),
        jnp.asarray(STEPS, jnp.int32),
        classes,
    )
    observation = {name: ArraySpec(x.shape[2:], x.dtype) for name, x in obs.items()}
    return EnvSpec(observation, ContinuousAction(data["action"].shape[-1])), ring


def draw(ring: replays.Replay, key: jax.Array, batch_size: int, length: int) -> Batch:
    """Sequences from the whole ring, in a way of its own: how ``replay.sample`` draws them moves no loss."""
    rows, envs = ring.data.reward.shape
    choice = jax.random.randint(key, (batch_size, 1), 0, (ring.size - length) * envs)
    row = (ring.position - ring.size + choice // envs + jnp.arange(length + 1)[None]) % rows
    env = jnp.broadcast_to(choice % envs, row.shape)
    data = jax.tree.map(lambda x: x[row, env], ring.data)
    context = Latent(data.latent.deter[:, 0], jax.nn.one_hot(data.latent.stoch[:, 0], ring.classes))
    fields = {name: x[:, 1:] for name, x in data._asdict().items() if name not in ("obs", "latent")}
    obs = {name: x[:, 1:] for name, x in data.obs.items()}
    return Batch(obs=obs, prev_action=data.action[:, :-1], context=context, index=row[:, 1:], **fields)


def losses(method: str, updates: int = UPDATES) -> dict[str, np.ndarray]:
    """Name -> float32 ``[updates]``: the losses of a method's first updates."""
    settings = config(method)
    spec, ring = load(settings)
    agent = make_agent(settings, spec)
    sample = jax.jit(lambda key: draw(ring, key, settings.batch_size, settings.batch_length))
    state, measured = agent.init(jax.random.key(0)), []
    for key in jax.random.split(jax.random.key(1), updates):
        state, _, metrics = agent.train_step(state, sample(key))
        measured.append({name: value for name, value in metrics.items() if name.startswith("loss/")})
    return {name: np.asarray([float(line[name]) for line in measured], np.float32) for name in measured[0]}


def stored(method: str) -> dict[str, np.ndarray]:
    """What `losses` was when ``losses.npz`` was written. Raises KeyError where the method was none yet."""
    with np.load(LOSSES) as file:
        found = {name.removeprefix(f"{method}:"): file[name] for name in file.files if name.startswith(f"{method}:")}
    if not found:
        raise KeyError(f"no run of {method} is stored; python -m tests.golden.run --write --method {method} stores one")
    return found


@click.command()
@click.option("--collect", "fresh", is_flag=True, help="Write replay.npz anew (the losses must then be written, too).")
@click.option("--write", is_flag=True, help="Write losses.npz anew instead of comparing with it.")
@click.option("--method", "methods", type=click.Choice(METHODS), multiple=True, help="Only these; may be repeated.")
def main(fresh: bool, write: bool, methods: tuple[str, ...]) -> None:
    """Run every method's first updates, and compare with what they were."""
    jax.config.update("jax_disable_most_optimizations", True)  # as the tests do
    if fresh:
        np.savez_compressed(REPLAY, **collect())
    kept: dict[str, np.ndarray] = {}
    if write and methods and LOSSES.exists():
        with np.load(LOSSES) as file:
            kept = {name: file[name] for name in file.files}
    worst = 0.0
    for method in methods or METHODS:
        run = losses(method)
        first, last = ({name: x[part].mean() for name, x in run.items()} for part in (slice(20), slice(-20, None)))
        click.echo(f"{method}: " + ", ".join(f"{name[5:]} {first[name]:.3g} to {last[name]:.3g}" for name in run))
        if write:
            kept |= {f"{method}:{name}": x for name, x in run.items()}
            np.savez_compressed(LOSSES, **kept)  # type: ignore[arg-type]
            continue
        known, alike = stored(method), PARTED.get(method, ALIKE)
        error = max(
            float(np.max(np.abs(x - known[name])[:alike] / np.abs(known[name])[:alike].max()))
            for name, x in run.items()
        )
        click.echo(
            f"  its first {alike} differ from the stored ones by {error:.2g}, relative to each loss's largest value"
        )
        worst = max(worst, error)
    raise SystemExit(worst > TOLERANCE)


if __name__ == "__main__":
    main()
