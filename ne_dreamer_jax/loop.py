"""Acting, the environments, replay and learning as one compiled program.

``Loop.chunk`` runs a number of vector steps on the device: step the environments, act, add to replay, and as many
updates as the replay ratio asks for. The host sees one dict of metrics a chunk. The whole state is one pytree (but for
images that ``loop.storage=host`` keeps beside it, `Loop.frames`), so that going on from a saved one gives the same bits
as never having stopped; where chunks begin and end changes none.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from ne_dreamer_jax import host_frames, memory, parallel, ranges
from ne_dreamer_jax import replay as replay_lib
from ne_dreamer_jax.host_frames import HostFrames
from ne_dreamer_jax.numerics import in_32_bits
from ne_dreamer_jax.ranges import Count, CountOrNone, Range
from ne_dreamer_jax.types import Array, Batch, ContinuousAction, Metrics, PolicyState, TimeStep, TrainState, Transition

PAPER_CAPACITY = 5_000_000
CHUNK_UPDATES = 64  # between two of these the host can neither report, save nor stop
REDRAWN = 64  # frames drawn together out of replay, so that what lies between state and picture stays small


@dataclass(frozen=True)
class LoopConfig:
    """Settings of the training loop. One agent step is ``env.action_repeat`` environment steps of one environment."""

    env_steps: Annotated[int, Range(1, 10**15)] = 1_000_000
    """Environment steps in all, over all environments."""
    num_envs: Annotated[int, Range(1, 10_000_000)] = 16
    """N, environments stepped together."""
    replay_ratio: Annotated[float, Range(0.0, 1e6)] = 512.0
    """Replayed steps for each agent step; an update replays B * T. 0 never learns."""
    capacity: Annotated[int, Range(1, 10**15)] | None = None
    """Transitions that replay holds; none: what the run can fill, at most the paper's 5e6."""
    prefill: CountOrNone = 4_096
    """Agent steps before the first update."""
    chunk_steps: Count = 64
    """Vector steps (agent steps of each environment) of one call to the device, unless that is too many updates."""
    eval_every: Annotated[int, Range(1, 10**15)] | None = 50_000
    """Environment steps between evaluations, of which there is one at the end too; none: no evaluation at all."""
    eval_episodes: Annotated[int, Range(1, 1_000_000)] = 10
    """Episodes of an evaluation, on environments of their own."""
    write_latents: bool = True
    """Whether the posterior latents of an update replace those in replay."""
    time_limits: Literal["marked", "unmarked", "terminal"] = "marked"
    """How replay holds an episode that a time limit cut: ``is_last`` without ``is_terminal``; neither, as the released
    code for DeepMind Control; or both, as the released code for DeepMind Lab."""
    latent_dtype: Literal["float32", "bfloat16"] = "float32"
    """In which replay stores the deterministic latents; bfloat16 halves their share of the memory."""
    storage: Literal["pixels", "states", "host"] = "pixels"
    """What replay keeps of an image: its pixels; its state, which takes a fraction of the memory and is drawn again, to
    the same bits, whenever it is sampled; or its pixels in the host's memory, from where they travel to the device."""

    def __post_init__(self) -> None:
        ranges.check(self)


class Counters(NamedTuple):
    """How far a run has come, as int32 []."""

    vector_step: Array  # agent steps of each environment
    credit: Array  # replayed steps that are due, in units of 1 / the replay ratio's denominator


class Episodes(NamedTuple):
    """The running episode of each environment."""

    ret: Array  # float32 [N], sum of rewards so far
    length: Array  # int32 [N], agent steps so far


class LoopState(NamedTuple):
    """Everything that a run is, `Loop.frames` apart: saved and restored as a whole."""

    train: TrainState
    env: Any  # environment states, [N, ...]
    policy: PolicyState  # [N, ...]; its prev_action is what the environments are stepped with next
    replay: Any
    episodes: Episodes
    counters: Counters
    key: Array  # typed key []


class Evaluation(NamedTuple):
    """Episodes of a fixed policy."""

    returns: Array  # float32 [M]
    lengths: Array  # int32 [M], agent steps
    complete: Array  # bool [M], False where broken physics or an action that was not finite cut the episode short
    frames: Any  # uint8 numpy [steps, H, W, 3] of the first environment's episode, or None


class Loop(NamedTuple):
    """The functions of a training run."""

    init: Callable[[Array], LoopState]
    """key -> the state before the first step."""
    chunk: Callable[[LoopState, Array], tuple[LoopState, Metrics]]
    """(state, vector steps int32 []) -> new state and metrics. Jitted; donates the state."""
    evaluate: Callable[..., Evaluation]
    """(params, key, episodes, random=False, frames=False) -> returns of the policy's mode, or of random actions."""
    shapes: Callable[[], LoopState]
    """() -> shapes and dtypes of the state and, on a mesh, where each array lies."""
    replay_bytes: int
    """What replay will allocate, over all devices and, for images, on the host."""
    capacity: int
    """Transitions that replay will hold."""
    chunk_steps: int
    """Vector steps of one chunk: as configured, but no more than about `CHUNK_UPDATES` updates."""
    vector_steps: int
    """Vector steps of the whole run."""
    prefill: int
    """Transitions that are collected before the first update."""
    updates: int
    """Updates of the whole run."""
    frames: HostFrames | None = None
    """Where ``loop.storage=host`` keeps images; to be saved and loaded with the state."""


@in_32_bits
def make(config: LoopConfig, env: Any, agent: Any, action_repeat: int, mesh: Mesh | None = None) -> Loop:
    """The training loop of an agent in an environment.

    Args:
      mesh: of `parallel`; environments, replay and batches are divided over its devices. None for one device.

    Raises ValueError where the replay can't hold a sequence, or does not fit the memory, or where it is to keep states
    of an environment whose images can't be drawn again, or images on the host where there are none or several
    processes, or where devices can't get equal shares.
    """
    n, b, length = config.num_envs, agent.config.batch_size, agent.config.batch_length
    devices = 1 if mesh is None else mesh.size
    for name, count in (("loop.num_envs", n), ("agent.batch_size", b)):
        if count % devices:
            raise ValueError(f"{name}: expected a multiple of the {devices} devices, got {count}.")
    vector_steps = -(-config.env_steps // (n * action_repeat))
    ratio = Fraction(config.replay_ratio).limit_denominator(1_000)
    if ratio == 0 and config.replay_ratio != 0:
        raise ValueError(f"loop.replay_ratio: expected 0 (never learn) or at least 0.001, got {config.replay_ratio}")
    price = b * length * ratio.denominator  # of one update, in units of credit
    wage = n * ratio.numerator  # of one vector step
    if price + wage >= 2**31:
        raise ValueError(
            "expected updates that can be counted in 32 bits, got a loop.replay_ratio of "
            f"{config.replay_ratio:g} for {n:,} environments and batches of {b} x {length}; take a rounder ratio"
        )
    prefill = max(-(-config.prefill // n), length + 1)
    updates = max(0, vector_steps - prefill) * wage // price
    least = (length + 1) * n
    if config.capacity is not None and config.capacity < least:
        raise ValueError(
            f"loop.capacity: expected at least {least:,} transitions, a sequence of agent.batch_length {length} and "
            f"the step before it for each of {n} environments, got {config.capacity:,}."
        )
    capacity = min(PAPER_CAPACITY, vector_steps * n) if config.capacity is None else config.capacity
    capacity = max(capacity, least) // n * n

    step_envs, prepare_envs = jax.vmap(env.step), jax.vmap(env.prepare)
    step_share = parallel.per_shard(step_envs, (parallel.SPLIT, parallel.SPLIT), parallel.SPLIT)

    if config.storage == "states" and env.pictures is None:
        raise ValueError(
            "loop.storage: expected 'pixels' for an environment without images that can be drawn again from its state, "
            "got 'states'."
        )
    pictures = env.pictures if config.storage == "states" else None
    images = host_frames.images_of(agent.spec) if config.storage == "host" else {}
    if config.storage == "host":
        _check_host(images)
    frames = HostFrames(capacity // n, n, images) if images else None

    def kept(env_state: Any, obs: Mapping[str, Array], row: Array) -> Mapping[str, Array]:
        """The observation as replay keeps it in this row."""
        if pictures is not None:
            return {**obs, "image": jax.vmap(pictures.record)(env_state)}
        if frames is None:
            return obs
        put = {
            name: parallel.per_shard(partial(frames.put, name), (parallel.SPLIT, parallel.SPLIT), parallel.SPLIT)
            for name in images
        }
        return {**obs, **{name: put[name](frames.tickets(row), obs[name]) for name in images}}

    def redraw(pictures: Any, records: Array) -> Array:
        flat = records.reshape(-1, records.shape[-1])
        drawn = jax.lax.map(pictures.redraw, flat, batch_size=min(REDRAWN, len(flat)))
        return drawn.reshape(*records.shape[:2], *drawn.shape[1:])

    def seen(obs: Mapping[str, Array]) -> Mapping[str, Array]:
        """The inverse of `kept`, for observations [B, T, ...] out of replay."""
        back: dict[str, Callable[[Array], Array]] = {}
        if pictures is not None:
            back = {"image": partial(redraw, pictures)}
        if frames is not None:
            back = {name: partial(frames.get, name) for name in images}
        split = parallel.SPLIT
        return {**obs, **{name: parallel.per_shard(f, (split,), split)(obs[name]) for name, f in back.items()}}

    def transition(timestep: TimeStep, policy: PolicyState, action: Array) -> Transition:
        is_last, is_terminal = timestep.is_last, timestep.is_terminal
        if config.time_limits == "unmarked":
            is_last = is_terminal
        if config.time_limits == "terminal":
            is_terminal = is_last
        return Transition(timestep.obs, action, timestep.reward, timestep.is_first, is_last, is_terminal, policy.latent)

    def example() -> Transition:
        """The shapes of one vector step's transition."""

        def build() -> Transition:
            obs: Mapping[str, Array] = {
                name: jnp.zeros((n, *s.shape), s.dtype) for name, s in agent.spec.observation.items()
            }
            no, policy = jnp.zeros((n,), bool), agent.init_policy(n)
            obs = kept(prepare_envs(jax.random.split(jax.random.key(0), n)), obs, jnp.zeros((), jnp.int32))
            return transition(TimeStep(obs, jnp.zeros((n,)), no, no, no), policy, policy.prev_action)

        return jax.eval_shape(build)

    shapes, latent_dtype = example(), jnp.dtype(config.latent_dtype)
    train = jax.eval_shape(agent.init, jax.random.key(0))
    learner = devices * _nbytes(train) + agent.working_bytes(
        train.params
    )  # the state is on every device, the work divided
    available = int(replay_lib.SHARE * max(0, devices * memory.available() - learner))
    replay_lib.check_capacity(shapes, capacity, n, latent_dtype, available)
    replay_bytes = replay_lib.nbytes(shapes, capacity, n, latent_dtype)
    if frames is not None:
        taken = learner + replay_bytes if jax.default_backend() == "cpu" else 0
        free = int(replay_lib.SHARE * max(0, memory.host_available() - taken))
        if frames.nbytes > free:
            raise ValueError(
                f"loop.storage: the images of {capacity:,} steps take {memory.readable(frames.nbytes)}, and "
                f"{memory.readable(free)} of the host are free for them; expected a loop.capacity of at most "
                f"{free * capacity // frames.nbytes:,} steps"
            )
        replay_bytes += frames.nbytes

    def make_replay() -> Any:
        return replay_lib.init(shapes, capacity, n, latent_dtype, available)

    def init_rest(key: Array) -> LoopState:
        """The state but for replay."""
        agent_key, env_key, key = jax.random.split(key, 3)
        return LoopState(
            train=agent.init(agent_key),
            env=prepare_envs(jax.random.split(env_key, n)),
            policy=agent.init_policy(n),
            replay=(),
            episodes=Episodes(jnp.zeros((n,)), jnp.zeros((n,), jnp.int32)),
            counters=Counters(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)),
            key=key,
        )

    def init(key: Array) -> LoopState:
        if shardings is None:
            return init_rest(key)._replace(replay=make_replay())
        # No device ever holds the whole ring.
        replay = jax.jit(make_replay, out_shardings=shardings.replay)()
        return parallel.place(init_rest(key), shardings._replace(replay=()))._replace(replay=replay)

    def shapes_of_state() -> LoopState:
        state = jax.eval_shape(lambda key: init_rest(key)._replace(replay=make_replay()), jax.random.key(0))
        if shardings is None:
            return state
        return jax.tree.map(lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), state, shardings)

    shardings: Any = None
    if mesh is not None:
        state = shapes_of_state()
        by_env = parallel.P(None, parallel.AXIS)
        specs = LoopState(
            train=parallel.WHOLE,  # type: ignore[arg-type]
            env=parallel.SPLIT,
            policy=parallel.SPLIT,  # type: ignore[arg-type]
            replay=jax.tree.map(lambda x: by_env if x.ndim else parallel.WHOLE, state.replay),
            episodes=parallel.SPLIT,  # type: ignore[arg-type]
            counters=parallel.WHOLE,  # type: ignore[arg-type]
            key=parallel.WHOLE,  # type: ignore[arg-type]
        )
        shardings = parallel.shardings(mesh, specs, state)

    def draw_batch(replay: Any, key: Array) -> Batch:
        batch = replay_lib.sample(replay, key, b, length)
        return batch._replace(obs=seen(batch.obs))

    def update(carry: tuple[TrainState, Any, Array, Metrics]) -> tuple[TrainState, Any, Array, Metrics]:
        train, replay, key, sums = carry
        key, sample_key = jax.random.split(key)
        batch = draw_batch(replay, sample_key)
        train, latents, metrics = agent.train_step(train, batch)
        if config.write_latents:
            replay = replay_lib.write_latents(replay, batch.index, latents)
        return train, replay, key, {name: sums[name] + metrics[name] for name in sums}

    def vector_step(state: LoopState, sums: Metrics, episode_sums: Metrics) -> tuple[LoopState, Metrics, Metrics]:
        key, act_key, update_key = jax.random.split(state.key, 3)
        env_state, timestep = step_share(state.env, state.policy.prev_action)
        policy, action = agent.act(state.train.params, state.policy, timestep, act_key)
        obs = kept(env_state, timestep.obs, state.replay.position)
        step = transition(timestep._replace(obs=obs), policy, action)
        replay = replay_lib.add(state.replay, step)

        ret = jnp.where(timestep.is_first, 0.0, state.episodes.ret) + timestep.reward
        steps = jnp.where(timestep.is_first, 0, state.episodes.length + 1)
        ended = timestep.is_last
        episode_sums = {
            "return": episode_sums["return"] + jnp.sum(jnp.where(ended, ret, 0.0)),
            "length": episode_sums["length"] + jnp.sum(jnp.where(ended, steps, 0)).astype(jnp.float32),
            "episodes": episode_sums["episodes"] + jnp.sum(ended).astype(jnp.float32),
        }

        done = state.counters.vector_step + 1
        credit = state.counters.credit + jnp.where(done > prefill, wage, 0)
        due = credit // price
        train, replay, _, sums = jax.lax.fori_loop(
            0, due, lambda _, carry: update(carry), (state.train, replay, update_key, sums)
        )
        counters = Counters(done, credit - due * price)
        episodes = Episodes(ret, steps)
        return LoopState(train, env_state, policy, replay, episodes, counters, key), sums, episode_sums

    def chunk(state: LoopState, steps: Array) -> tuple[LoopState, Metrics]:
        batch = jax.eval_shape(draw_batch, state.replay, state.key)
        metric_shapes = jax.eval_shape(agent.train_step, state.train, batch)[2]
        sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), metric_shapes)
        episode_sums = {name: jnp.zeros(()) for name in ("return", "length", "episodes")}
        before = state.train.update
        cuts_before = jnp.sum(state.env.faults), jnp.sum(state.env.bad_actions)
        state, sums, episode_sums = jax.lax.fori_loop(
            0, steps, lambda _, carry: vector_step(*carry), (state, sums, episode_sums)
        )
        # Where nothing was counted the mean means nothing, and the host leaves it out.
        count = jnp.maximum((state.train.update - before).astype(jnp.float32), 1.0)
        metrics = {name: value / count for name, value in sums.items()}
        finished = episode_sums.pop("episodes")
        metrics |= {name: value / jnp.maximum(finished, 1.0) for name, value in episode_sums.items()}
        metrics["episodes"] = finished
        # Episodes that the environments cut: because their physics broke down, or an action was not finite.
        for name, count, earlier in zip(
            ("faults", "bad_actions"), (state.env.faults, state.env.bad_actions), cuts_before, strict=True
        ):
            metrics[name] = (jnp.sum(count) - earlier).astype(jnp.float32)
        return state, metrics

    def eval_init(key: Array, episodes: int) -> tuple:
        env_key, key = jax.random.split(key)
        env_state = prepare_envs(jax.random.split(env_key, episodes))
        zeros = jnp.zeros((episodes,))
        complete, done = jnp.zeros((episodes,), bool), jnp.zeros((episodes,), bool)
        return (env_state, agent.init_policy(episodes), key, zeros, zeros.astype(jnp.int32), complete, done)

    def eval_steps(params: Any, carry: tuple, random: Array, frames: bool) -> tuple[tuple, Any]:
        def step(carry: tuple, _: None) -> tuple[tuple, Any]:
            env_state, policy, key, returns, lengths, complete, done = carry
            key, act_key, random_key = jax.random.split(key, 3)
            env_state, timestep = step_envs(env_state, policy.prev_action)
            policy, action = agent.act(params, policy, timestep, act_key, mode="mode")
            action = jnp.where(random, random_action(agent.spec.action, random_key, action.shape[0]), action)
            policy = policy._replace(prev_action=action)
            counts = ~done
            returns = returns + jnp.where(counts, timestep.reward, 0.0)
            lengths = lengths + (counts & ~timestep.is_first).astype(jnp.int32)
            complete = jnp.where(counts, env_state.faults + env_state.bad_actions == 0, complete)
            done = done | timestep.is_last
            seen = (timestep.obs["image"][0], counts[0]) if frames else None
            return (env_state, policy, key, returns, lengths, complete, done), seen

        return jax.lax.scan(step, carry, None, length=config.chunk_steps)

    eval_steps_jit = jax.jit(in_32_bits(eval_steps), static_argnums=3, donate_argnums=1)

    def evaluate(
        params: Any, key: Array, episodes: int | None = None, random: bool = False, frames: bool = False
    ) -> Evaluation:
        if mesh is not None:  # each process plays all the episodes on one of its devices
            params = parallel.local(params)
        record = frames and "image" in agent.spec.observation
        carry, clips = eval_init(key, episodes or config.eval_episodes), []
        while not bool(jnp.all(carry[-1])):
            carry, seen = eval_steps_jit(params, carry, jnp.asarray(random), record)
            if record:
                images, counts = jax.device_get(seen)
                clips.append(images[counts])
        video = None
        if clips:
            video = np.concatenate(clips)
        return Evaluation(carry[3], carry[4], carry[5], video)

    whole = None if mesh is None else parallel.NamedSharding(mesh, parallel.WHOLE)
    out = None if mesh is None else (shardings, whole)
    return Loop(
        init=in_32_bits(init),
        chunk=jax.jit(in_32_bits(parallel.traced_on(mesh, chunk)), donate_argnums=0, out_shardings=out),
        evaluate=in_32_bits(evaluate),
        shapes=in_32_bits(shapes_of_state),
        replay_bytes=replay_bytes,
        capacity=capacity,
        chunk_steps=max(1, min(config.chunk_steps, CHUNK_UPDATES * price // max(wage, 1))),
        vector_steps=vector_steps,
        prefill=prefill * n,
        updates=updates,
        frames=frames,
    )


def over_seeds(
    loop: Loop,
) -> tuple[Callable[[Array], LoopState], Callable[[LoopState, Array], tuple[LoopState, Metrics]]]:
    """``init(keys [R])`` and ``chunk(state, steps)`` of R runs at once, for runs that are too small to fill a device.

    State and metrics have a leading axis R, but for what is the same in all runs: the counters, and how full replay is.
    So each run has its own parameters, environments and replay, and does what it would do alone. ``init`` raises
    ValueError where memory can't hold R replays.

    Raises ValueError for a loop that keeps images on the host, which serve one run.
    """
    if loop.frames is not None:
        raise ValueError("loop.storage: expected 'pixels' or 'states' for several seeds at once, got 'host'")
    shapes = loop.shapes()
    axes: Any = jax.tree.map(lambda _: 0, shapes)
    axes = axes._replace(
        counters=jax.tree.map(lambda _: None, shapes.counters),
        replay=replace(axes.replay, position=None, size=None),
    )

    def init(keys: Array) -> LoopState:
        needed, available = len(keys) * loop.replay_bytes, int(replay_lib.SHARE * memory.available())
        if needed > available:
            fit = available // loop.replay_bytes
            raise ValueError(
                f"{len(keys)} replays take {memory.readable(needed)}, and {memory.readable(available)} are free for "
                f"them; expected at most {fit} seeds, or a smaller loop.capacity"
            )
        return jax.vmap(loop.init, out_axes=axes)(keys)

    return init, jax.jit(jax.vmap(loop.chunk, in_axes=(axes, None), out_axes=(axes, 0)), donate_argnums=0)


def _check_host(images: Mapping[str, Any]) -> None:
    """Raises ValueError where images can't be kept on the host."""
    if not images:
        raise ValueError("loop.storage: expected 'pixels' for an environment without images, got 'host'.")
    if jax.process_count() > 1:
        raise ValueError("loop.storage: expected 'pixels' or 'states' for several processes, got 'host'.")
    try:
        jax.local_devices(backend="cpu")
    except RuntimeError as error:
        raise ValueError(
            "loop.storage: 'host' needs JAX's cpu platform beside the accelerator's; expected both in JAX_PLATFORMS, "
            f"such as 'cuda,cpu', got {os.environ.get('JAX_PLATFORMS', '')!r}."
        ) from error


def _nbytes(tree: Any) -> int:
    """Of all arrays but typed keys, which are small."""
    arrays = [x for x in jax.tree.leaves(tree) if not jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)]
    return sum(x.size * x.dtype.itemsize for x in arrays)


@in_32_bits
def random_action(spec: Any, key: Array, n: int) -> Array:
    """Uniform actions [n, ...] for environments of this action spec."""
    if isinstance(spec, ContinuousAction):
        return jax.random.uniform(key, (n, spec.size), minval=-1.0, maxval=1.0)
    return jax.random.randint(key, (n,), 0, spec.size)
