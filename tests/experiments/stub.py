"""A run that compiles in no time: the host's part of training sees a loop like any other, whose learner is a coin."""

from __future__ import annotations

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.loop import Budget, Counters, Evaluation, Finished, Loop, LoopState, Report
from ne_dreamer_jax.replay.host_frames import HostFrames
from ne_dreamer_jax.runs import building
from ne_dreamer_jax.types import Array, ArraySpec, ContinuousAction, EnvSpec, ReturnScale, TrainState
from tests.experiments import toy

EPISODE = 8  # vector steps


def build(config, *, image: bool = True) -> building.Run:
    """A run of a configuration."""
    n = config.loop.num_envs
    total = config.loop.env_steps // n
    prefill = config.loop.prefill // n
    rows = -(-(config.loop.capacity or total * n) // n)
    observation = {"image": ArraySpec((16, 16, 3), jnp.uint8)} if image else {"position": ArraySpec((1,), jnp.float32)}

    picture = ArraySpec((2, 2, 3), jnp.uint8)
    frames = HostFrames(rows, n, {"image": picture}) if config.loop.storage == "host" else None

    def init(key: Array) -> LoopState:
        start_key, key = jax.random.split(key)
        zeros = [jnp.zeros((), jnp.int32) for _ in range(4)]  # apart, since the state is donated
        params = {"actor": {"kernel": jax.random.normal(start_key, (3,))}}
        scale = ReturnScale(jnp.zeros(()), jnp.zeros(()))
        train = TrainState(params, {}, {}, (), scale, jnp.copy(start_key), zeros[0])
        replay = jnp.zeros((rows, n), jnp.uint8)
        return LoopState(train, (), (), replay, (), Counters(*zeros[1:]), key)  # type: ignore[arg-type]

    def step(state: LoopState) -> LoopState:
        key, noise_key = jax.random.split(state.key)
        done = state.counters.vector_step
        kernel = 0.9 * state.train.params["actor"]["kernel"] + jax.random.normal(noise_key, (3,))
        update = state.train.update + (done >= prefill).astype(jnp.int32)
        train = state.train._replace(params={"actor": {"kernel": kernel}}, update=update)
        drawn = jax.random.bits(noise_key, (n,), jnp.uint8)
        if frames is not None:  # replay is a sum of all that the host keeps
            images = jax.random.bits(noise_key, (n, *picture.shape), jnp.uint8)
            tickets = frames.put("image", frames.tickets(done), images)
            back = frames.get("image", jnp.minimum(jnp.arange(rows)[:, None], done) * n + (tickets % n)[None])
            drawn = jnp.sum(back, axis=(0, 2, 3, 4), dtype=jnp.uint8)
        replay = state.replay.at[done % rows].set(drawn)
        return state._replace(
            train=train, replay=replay, counters=Counters(done + 1, done, state.counters.skipped), key=key
        )

    @functools.partial(jax.jit, donate_argnums=0)
    def chunk(state: LoopState, steps: Array):
        before, updates = state.counters.vector_step, state.train.update
        state = jax.lax.fori_loop(0, steps, lambda _, state: step(state), state)
        kernel = jnp.sum(state.train.params["actor"]["kernel"])
        episodes = (n * (state.counters.vector_step // EPISODE - before // EPISODE)).astype(jnp.float32)
        updates = state.train.update - updates
        none = jnp.zeros((), jnp.int32)
        finished = Finished(episodes, kernel * episodes, EPISODE * episodes)
        return state, Report(
            updates, {"loss/total": jnp.square(kernel) * updates.astype(jnp.float32)}, finished, none, none
        )

    def evaluate(params, key: Array, episodes: int | None = None, random: bool = False, frames: bool = False):
        count = episodes or config.loop.eval_episodes
        mean = 0.0 if random else jnp.sum(params["actor"]["kernel"])
        clip = np.zeros((5, 16, 16, 3), np.uint8) if frames and image else None
        return Evaluation(
            mean + jax.random.normal(key, (count,)),
            jnp.full((count,), EPISODE, jnp.int32),
            jnp.ones((count,), bool),
            clip,
        )

    agent = SimpleNamespace(spec=EnvSpec(observation, ContinuousAction(1)))
    loop = Loop(
        init,
        chunk,
        evaluate,
        state_shapes=lambda: jax.eval_shape(init, jax.random.key(0)),
        budget=Budget(n, config.env.action_repeat, total, prefill, 1, 1, rows * n, config.loop.chunk_steps),
        replay_bytes=rows * n,
        frames=frames,
    )
    return building.Run(config, agent, loop, loop.state_shapes())  # type: ignore[arg-type]


def run() -> building.Run:
    """A run of the toy configuration."""
    return build(toy.config())
