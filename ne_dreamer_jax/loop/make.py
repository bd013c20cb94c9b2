"""Acting, the environments, replay and learning as one compiled program.

``Loop.chunk`` runs a number of vector steps on the device: step the environments, act, add to replay, and as many
updates as the replay ratio asks for. The host sees one report a chunk. The whole state is one pytree (but for images
that ``loop.storage=host`` keeps beside it, `Loop.frames`). Resuming is bit-exact; chunk boundaries do not matter.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.envs.vector import VectorEnv, as_vector
from ne_dreamer_jax.loop import placement
from ne_dreamer_jax.loop.budget import Budget
from ne_dreamer_jax.loop.collect import collect, transition
from ne_dreamer_jax.loop.config import LoopConfig
from ne_dreamer_jax.loop.learn import Learning, draw_batch, learn_what_is_due
from ne_dreamer_jax.loop.play import Evaluation, make_play
from ne_dreamer_jax.loop.state import Counters, Episodes, Finished, LoopState, Report
from ne_dreamer_jax.replay import ring
from ne_dreamer_jax.replay import storage as storages
from ne_dreamer_jax.replay.host_frames import HostFrames
from ne_dreamer_jax.replay.storage import Storage
from ne_dreamer_jax.system import memory, parallel
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import Array, TimeStep, Transition


class Evaluate(Protocol):
    """Plays episodes of its own, with the policy's mode or with random actions."""

    def __call__(
        self, params: Any, key: Array, episodes: int | None = None, random: bool = False, frames: bool = False
    ) -> Evaluation:
        """(params, key) -> ``episodes`` of them, or as many as configured; ``frames`` keeps the first one's images."""
        ...


class Loop(NamedTuple):
    """The functions of a training run."""

    init: Callable[[Array], LoopState]
    """key -> the state before the first step."""
    chunk: Callable[[LoopState, Array], tuple[LoopState, Report]]
    """(state, vector steps int32 []) -> new state and what happened. Jitted; donates the state."""
    evaluate: Evaluate
    state_shapes: Callable[[], LoopState]
    """() -> shapes and dtypes of the state and, on a mesh, where each array lies."""
    budget: Budget
    """Steps, updates and capacity."""
    replay_bytes: int
    """What replay will allocate, over all devices and, for images, on the host."""
    frames: HostFrames | None = None
    """Where ``loop.storage=host`` keeps images; to be saved and loaded with the state."""


@in_32_bits
def make(config: LoopConfig, env: Any, agent: Agent, action_repeat: int, mesh: Mesh | None = None) -> Loop:
    """The training loop of an agent in an environment.

    Args:
      env: an ``envs.base.Env``, or a `VectorEnv`.
      mesh: of `parallel`; environments, replay and batches are divided over its devices. None for one device.

    Raises ValueError where the replay can't hold a sequence, or does not fit the memory, or where it is to keep states
    of an environment whose images can't be drawn again, or images on the host where there are none or several
    processes, or where devices can't get equal shares.
    """
    microbatches = getattr(agent.config, "microbatches", 1)  # DrQ-v2 has none
    devices = placement.check_divisible(mesh, config.num_envs, agent.config.batch_size, microbatches)
    venv = as_vector(env)
    if venv.host is not None and mesh is not None:
        raise ValueError("expected one device for environments in worker processes; leave out --devices and a mesh")
    budget = Budget.of(config, agent.config.batch_size, agent.config.batch_length, action_repeat)
    if config.storage == "host":
        if jax.process_count() > 1:
            raise ValueError("loop.storage: expected 'pixels' or 'states' for several processes, got 'host'.")
        _check_cpu("loop.storage: 'host' needs")
    if venv.host is not None:
        _check_cpu("environments in worker processes need")
    storage = storages.make(
        config.storage, agent.spec, venv.pictures, budget.capacity // budget.num_envs, config.num_envs
    )
    row, latent_dtype = row_shapes(config, venv, agent, storage), jnp.dtype(config.latent_dtype)
    available, replay_bytes = fit_memory(agent, storage, row, budget, latent_dtype, devices)
    budget.check()
    make_replay = lambda: ring.init(row, budget.capacity, budget.num_envs, latent_dtype, available)
    start = partial(init_state, config, venv, agent)

    shapes = jax.eval_shape(lambda key: start(key)._replace(replay=make_replay()), jax.random.key(0))
    where: Any = None if mesh is None else placement.shardings(mesh, shapes)

    def init(key: Array) -> LoopState:
        if where is None:
            return start(key)._replace(replay=make_replay())
        # No device ever holds the whole ring.
        replay = jax.jit(make_replay, out_shardings=where.replay)()
        return parallel.place(start(key), where._replace(replay=()))._replace(replay=replay)

    def state_shapes() -> LoopState:
        if where is None:
            return shapes
        return jax.tree.map(lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), shapes, where)

    play = make_play(venv, agent, config.eval_max_steps)

    def evaluate(
        params: Any, key: Array, episodes: int | None = None, random: bool = False, frames: bool = False
    ) -> Evaluation:
        if mesh is not None:  # each process plays all the episodes on one of its devices
            params = parallel.local(params)
        return play(params, key, episodes or config.eval_episodes, random=random, frames=frames)

    run = in_32_bits(parallel.traced_on(mesh, partial(chunk, config, budget, venv, agent, storage)))
    out = None if mesh is None else (where, parallel.NamedSharding(mesh, parallel.WHOLE))
    return Loop(
        init=in_32_bits(init),
        chunk=jax.jit(run, donate_argnums=0, out_shardings=out),
        evaluate=evaluate,
        state_shapes=in_32_bits(state_shapes),
        budget=budget,
        replay_bytes=replay_bytes,
        frames=storage.frames,
    )


def init_state(config: LoopConfig, env: VectorEnv, agent: Agent, key: Array) -> LoopState:
    """The state before the first step, but for replay."""
    agent_key, env_key, key = jax.random.split(key, 3)
    n = config.num_envs
    return LoopState(
        train=agent.init(agent_key),
        env=env.prepare(jax.random.split(env_key, n)),
        policy=agent.init_policy(n),
        replay=(),
        episodes=Episodes(jnp.zeros((n,), jnp.float32), jnp.zeros((n,), jnp.int32)),
        counters=Counters(*(jnp.zeros((), jnp.int32) for _ in Counters._fields)),
        key=key,
    )


def chunk(
    config: LoopConfig, budget: Budget, env: VectorEnv, agent: Agent, storage: Storage, state: LoopState, steps: Array
) -> tuple[LoopState, Report]:
    """So many vector steps (int32 []), each with the updates that it pays for, and what happened in them."""
    batch = jax.eval_shape(partial(draw_batch, agent, storage), state.replay, state.key)
    metrics = jax.eval_shape(agent.train_step, state.train, batch)[2]
    sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), metrics)
    updates_before, cuts_before = state.train.update, jax.tree.map(jnp.sum, env.cuts(state.env))

    def vector_step(state: LoopState, finished: Finished, sums: Any) -> tuple[LoopState, Finished, Any]:
        key, act_key, update_key = jax.random.split(state.key, 3)
        state, finished = collect(env, agent, storage, config.time_limits, state, finished, act_key)
        done = state.counters.vector_step + 1
        credit = state.counters.credit + jnp.where(done > budget.prefill, budget.step_credit, 0)
        due = credit // budget.update_cost
        if env.start is not None:  # learning begins when the environments' step has begun
            due, env_state = jax.lax.optimization_barrier((due, state.env))
            state = state._replace(env=env_state)
        learning = Learning(state.train, state.replay, update_key, sums, state.counters.skipped)
        train, replay, _, sums, skipped = learn_what_is_due(agent, storage, config.write_latents, due, learning)
        counters = Counters(done, credit - due * budget.update_cost, skipped)
        return state._replace(train=train, replay=replay, counters=counters, key=key), finished, sums

    state, finished, sums = jax.lax.fori_loop(
        0, steps, lambda _, carry: vector_step(*carry), (state, Finished.none(), sums)
    )
    cuts = jax.tree.map(lambda now, before: jnp.sum(now) - before, env.cuts(state.env), cuts_before)
    report = Report(state.train.update - updates_before, sums, finished, cuts.faults, cuts.bad_actions)
    return state, report


def row_shapes(config: LoopConfig, env: VectorEnv, agent: Agent, storage: Storage) -> Transition:
    """Shapes and dtypes of what one vector step puts into replay, [N, ...]."""
    n = config.num_envs

    def build() -> Transition:
        obs = {name: jnp.zeros((n, *s.shape), s.dtype) for name, s in agent.spec.observation.items()}
        no, policy = jnp.zeros((n,), bool), agent.init_policy(n)
        env_state = env.prepare(jax.random.split(jax.random.key(0), n))
        kept = storage.encode_obs(env_state, obs, jnp.zeros((), jnp.int32))
        timestep = TimeStep(kept, jnp.zeros((n,), jnp.float32), no, no, no)
        return transition(config.time_limits, timestep, policy, policy.prev_action, no)

    return jax.eval_shape(build)


def fit_memory(
    agent: Agent, storage: Storage, row: Transition, budget: Budget, latent_dtype: Any, devices: int
) -> tuple[int, int]:
    """How many bytes the ring may take, and how many replay will, over all devices and on the host.

    Raises ValueError with the largest capacity that fits, where the budget's does not.
    """
    train = jax.eval_shape(agent.init, jax.random.key(0))
    # The state is on every device; the work of an update is divided.
    learner = devices * _nbytes(train) + agent.working_bytes(train.params)
    memories = jax.process_count() if jax.default_backend() == "cpu" else devices  # virtual devices share the host's
    available = int(ring.FREE_FRACTION * max(0, memories * memory.available() - learner))
    ring.check_capacity(row, budget.capacity, budget.num_envs, latent_dtype, available)
    replay_bytes = ring.nbytes(row, budget.capacity, budget.num_envs, latent_dtype)
    if storage.host_bytes:
        taken = learner + replay_bytes if jax.default_backend() == "cpu" else 0
        free = int(ring.FREE_FRACTION * max(0, memory.host_available() - taken))
        if storage.host_bytes > free:
            raise ValueError(
                f"loop.storage: the images of {budget.capacity:,} steps take {memory.readable(storage.host_bytes)}, "
                f"and {memory.readable(free)} of the host are free for them; expected a loop.capacity of at most "
                f"{free * budget.capacity // storage.host_bytes:,} steps"
            )
    return available, replay_bytes + storage.host_bytes


def over_seeds(
    loop: Loop,
) -> tuple[Callable[[Array], LoopState], Callable[[LoopState, Array], tuple[LoopState, Report]]]:
    """``init(keys [R])`` and ``chunk(state, steps)`` of R runs at once, for runs that are too small to fill a device.

    State and report have a leading axis R, but for what is the same in all runs: the steps, the credit, and how full
    replay is. So each run has its own parameters, environments and replay, and does what it would do alone. ``init``
    raises ValueError where memory can't hold R replays.

    Raises ValueError for a loop that keeps images on the host, which serve one run.
    """
    if loop.frames is not None:
        raise ValueError("loop.storage: expected 'pixels' or 'states' for several seeds at once, got 'host'")
    shapes = loop.state_shapes()
    axes: Any = jax.tree.map(lambda _: 0, shapes)
    axes = axes._replace(
        counters=axes.counters._replace(vector_step=None, credit=None),
        replay=replace(axes.replay, position=None, size=None),
    )

    def init(keys: Array) -> LoopState:
        needed, available = len(keys) * loop.replay_bytes, int(ring.FREE_FRACTION * memory.available())
        if needed > available:
            fit = available // loop.replay_bytes
            raise ValueError(
                f"{len(keys)} replays take {memory.readable(needed)}, and {memory.readable(available)} are free for "
                f"them; expected at most {fit} seeds, or a smaller loop.capacity"
            )
        return jax.vmap(loop.init, out_axes=axes)(keys)

    return init, jax.jit(jax.vmap(loop.chunk, in_axes=(axes, None), out_axes=(axes, 0)), donate_argnums=0)


def _check_cpu(what: str) -> None:
    """Raises ValueError where compiled programs can't call back to the host."""
    try:
        jax.local_devices(backend="cpu")
    except RuntimeError as error:
        raise ValueError(
            f"{what} JAX's cpu platform beside the accelerator's; expected both in JAX_PLATFORMS, such as 'cuda,cpu', "
            f"got {os.environ.get('JAX_PLATFORMS', '')!r}."
        ) from error


def _nbytes(tree: Any) -> int:
    """Of all arrays but typed keys, which are small."""
    arrays = [x for x in jax.tree.leaves(tree) if not jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)]
    return sum(x.size * x.dtype.itemsize for x in arrays)
