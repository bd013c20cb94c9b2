"""Replay on the device: a ring over the last steps of N environments, as pure functions on arrays.

    replay = init(example, capacity, num_envs)          # refuses what memory can't hold
    replay = add(replay, transition)                    # one step of all N environments
    batch = sample(replay, key, batch_size, length)     # once can_sample(replay, length)
    replay = write_latents(replay, batch.index, latents)

Everything but `init` compiles and, with the ring donated, works on it in place, also inside ``lax.scan``. On a mesh
(`parallel.traced_on`) with the N axis divided over devices, every device samples from its own environments, so that no
pixels travel; the sequences are the same on any number of devices.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from ne_dreamer_jax import shapes
from ne_dreamer_jax.system import memory, parallel
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import Array, Batch, ContinuousAction, EnvSpec, Latent, Transition

FREE_FRACTION = 0.9
"""Fraction of the free memory that a ring may use, after the learner's where that is known; the rest is spare."""

_BY_ENV = parallel.P(None, parallel.AXIS)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Replay:
    """A ring of C rows, one vector step of N environments each."""

    data: Transition
    """``[C, N, ...]``, observations as they are; the latent is stored compactly: ``deter`` in the dtype chosen at
    `init`, ``stoch`` as integer classes ``[C, N, S]`` instead of one-hot vectors."""
    position: Array
    """int32 [], the row that the next step goes to."""
    size: Array
    """int32 [], rows filled, at most C."""
    classes: int = field(metadata={"static": True})
    """K, classes per latent."""


@in_32_bits
def init(
    example: Transition,
    capacity: int,
    num_envs: int,
    deter_dtype: Any = jnp.float32,
    available: int | None = None,
) -> Replay:
    """An empty ring.

    Args:
      example: shapes and dtypes (arrays or ``jax.ShapeDtypeStruct``) of one step, of all N environments ``[N, ...]`` or
        of one of them ``[...]``; the values do not matter.
      capacity: steps over all environments together; rounded down to a multiple of N.
      num_envs: N.
      deter_dtype: in which the latents' deterministic part is stored; bfloat16 halves it.
      available: bytes that the ring may take; None for `FREE_FRACTION` of what is free on the default device. For
        a ring over several devices, give the sum.

    Raises:
      ValueError: where the example is no transition of N environments, where the capacity is below two steps for each
        of them, or where memory can't hold it (see `check_capacity`).
    """
    _check_counts(capacity, num_envs)
    check_capacity(example, capacity, num_envs, deter_dtype, available)
    rows = capacity // num_envs
    data = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape), x.dtype), _stored(example, num_envs, deter_dtype))
    position, size = jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)  # two buffers: one can't be donated twice
    return Replay(data, position, size, example.latent.stoch.shape[-1])


def _check_counts(capacity: int, num_envs: int) -> None:
    if num_envs < 1 or capacity < 2 * num_envs:
        raise ValueError(f"expected a capacity of two steps or more for each of {num_envs} envs, got {capacity}")
    if capacity >= 2**31:
        raise ValueError(f"expected a capacity below 2**31 = {2**31:,} steps, got {capacity:,}")


@in_32_bits
def add(replay: Replay, transition: Transition) -> Replay:
    """The ring with one step of all N environments added, in place of the oldest where it is full.

    ``transition.latent.stoch`` must be one-hot; of other vectors the largest component is kept.

    Raises:
      ValueError: where shapes or dtypes differ from the example that the ring was made from.
    """
    rows = replay.data.reward.shape[0]
    step = transition._replace(latent=_compact(transition.latent, replay.data.latent.deter.dtype))
    shapes.check(jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), replay.data), step, "the replay")
    data = jax.tree.map(
        lambda ring, x: jax.lax.dynamic_update_index_in_dim(ring, x, replay.position, 0), replay.data, step
    )
    return replace(replay, data=data, position=(replay.position + 1) % rows, size=jnp.minimum(replay.size + 1, rows))


def full(example: Transition, data: Transition, deter_dtype: Any = jnp.float32) -> Replay:
    """A ring that is full of ``data``, which goes to the device once; its latents are zero.

    Args:
      example, deter_dtype: as for `init`.
      data: ``[C, N, ...]``, oldest row first; the latents, which are not read, may be missing.

    Raises:
      ValueError: where there are fewer than two rows, or memory can't hold them, or the data does not fit the example.
    """
    rows, num_envs = data.reward.shape
    _check_counts(rows * num_envs, num_envs)
    check_capacity(example, rows * num_envs, num_envs, deter_dtype)
    expected = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((rows, *x.shape), x.dtype), _stored(example, num_envs, deter_dtype)
    )
    latent = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), expected.latent)
    data = jax.tree.map(jnp.asarray, data._replace(latent=latent))
    shapes.check(expected, data, "the replay")
    position, size = jnp.zeros((), jnp.int32), jnp.asarray(rows, jnp.int32)
    return Replay(data, position, size, example.latent.stoch.shape[-1])


def next_row(replay: Replay) -> Array:
    """The row that `add` will write to, int32 []."""
    return replay.position


def partition(replay: Replay) -> Replay:
    """How a ring is divided over a mesh's devices: by environments; partition specs in the arrays' places."""
    return jax.tree.map(lambda x: _BY_ENV if x.ndim else parallel.WHOLE, replay)


def can_sample(replay: Replay, length: int) -> Array:
    """Whether the ring holds a slice of ``length`` steps and the one before it, bool []."""
    return replay.size > length


@in_32_bits
def sample(replay: Replay, key: Array, batch_size: int, length: int) -> Batch:
    """B sequences of T steps, each with the step before it as context.

    Slices of T + 1 steps that are consecutive in one environment are drawn uniformly, with replacement, from all that
    the ring holds, so that its oldest step is never more than context; none contains both the newest and the oldest
    step of a full ring. They may cross episodes. The draw is stratified over environments: sequence b comes from one
    between b * N / B and (b + 1) * N / B. So k devices, where k divides B and N, find each their share of the sequences
    in their share of the environments.

    Args:
      replay: the ring; unless ``can_sample(replay, length)``, the batch contains steps that were never written.
      key: consumed. The same ring and key give the same batch, to the bit.
      batch_size: B.
      length: T.

    Raises:
      ValueError: where no ring of this capacity can ever hold T + 1 steps of an environment, or 32 bits N * B.
    """
    rows, envs = replay.data.reward.shape
    if not 1 <= length < rows:
        raise ValueError(
            f"expected a length of 1 to {rows - 1} steps, got {length}: a sequence and the step before it must fit in "
            f"the {rows} steps that the ring keeps of each of {envs} envs (capacity {rows * envs:,})"
        )
    if envs * batch_size >= 2**31:
        raise ValueError(
            f"expected fewer than 2**31 for environments times sequences, got {envs:,} times {batch_size:,}"
        )
    starts = jnp.maximum(replay.size - length, 1)  # of slices, in each environment
    start_key, env_key = jax.random.split(key)
    start = jax.random.randint(start_key, (batch_size, 1), 0, starts)
    # Whole numbers, so that no rounding takes an environment over the border between two devices.
    stratum = envs * jnp.arange(batch_size, dtype=jnp.int32)[:, None]
    env = (stratum + jax.random.randint(env_key, (batch_size, 1), 0, envs)) // batch_size
    row = (replay.position - replay.size + start + jnp.arange(length + 1, dtype=jnp.int32)[None]) % rows
    env = jnp.broadcast_to(env, row.shape)
    gather = parallel.per_shard(
        partial(_gather, replay.classes), (_BY_ENV, parallel.SPLIT, parallel.SPLIT), parallel.SPLIT
    )
    return gather(replay.data, row, env)._replace(index=row[:, 1:] * envs + env[:, 1:])


@in_32_bits
def write_latents(replay: Replay, index: Array, latent: Latent, where: Array | bool = True) -> Replay:
    """The ring with newer latents at steps sampled from it.

    Args:
      replay: the ring, with nothing added since the batch was sampled.
      index: int32 ``[B, T]``, ``Batch.index``. Of a step that is there more than once (overlapping sequences) the last
        latent is kept, in row-major order, on every device.
      latent: ``[B, T, ...]``; ``stoch`` must be one-hot.
      where: bool [], whether to write at all.

    Raises:
      ValueError: where shapes differ from the index's and the ring's.
    """
    rows, envs = replay.data.reward.shape
    new = _compact(latent, replay.data.latent.deter.dtype)
    expected = jax.tree.map(lambda x: jax.ShapeDtypeStruct((*index.shape, *x.shape[2:]), x.dtype), replay.data.latent)
    shapes.check(expected, new, "the replay")

    def scatter(ring: Latent, index: Array, new: Latent) -> Latent:
        flat = index.reshape(-1)
        order = jnp.argsort(flat, stable=True)
        ordered = flat[order]
        last = jnp.concatenate([ordered[1:] != ordered[:-1], jnp.ones(1, bool)])
        last = jnp.zeros_like(last).at[order].set(last)
        # Scatters with repeated indices have no order on a GPU: the others go to rows that do not exist, and are lost.
        row = jnp.where(last & where, flat // envs, rows + jnp.arange(flat.size, dtype=jnp.int32))
        env = flat % envs % ring.deter.shape[1]  # among those of this device

        def put(ring: Array, x: Array) -> Array:
            return ring.at[row, env].set(x.reshape(flat.size, *x.shape[2:]), mode="drop", unique_indices=True)

        return jax.tree.map(put, ring, new)

    scatter = parallel.per_shard(scatter, (_BY_ENV, parallel.SPLIT, parallel.SPLIT), _BY_ENV)
    return replace(replay, data=replay.data._replace(latent=scatter(replay.data.latent, index, new)))


def nbytes(example: Transition, capacity: int, num_envs: int, deter_dtype: Any = jnp.float32) -> int:
    """Bytes that `init` would allocate for the same arguments. Allocates nothing."""
    return capacity // num_envs * _row_bytes(example, num_envs, deter_dtype)


def capacity_for(example: Transition, available: int, num_envs: int, deter_dtype: Any = jnp.float32) -> int:
    """The largest capacity (steps over all environments, a multiple of N) whose ring takes at most that many bytes."""
    return available // _row_bytes(example, num_envs, deter_dtype) * num_envs


def check_capacity(
    example: Transition,
    capacity: int,
    num_envs: int,
    deter_dtype: Any = jnp.float32,
    available: int | None = None,
) -> None:
    """Refuses a ring that memory can't hold, before anything is allocated; arguments as for `init`.

    Raises:
      ValueError: with what it would take, what there is and the largest capacity that fits.
    """
    if available is None:
        available = int(FREE_FRACTION * memory.available())
    needed = nbytes(example, capacity, num_envs, deter_dtype)
    if needed > available:
        fits = capacity_for(example, available, num_envs, deter_dtype)
        halved = "" if jnp.dtype(deter_dtype).itemsize < 4 else "; loop.latent_dtype=bfloat16 halves the latents"
        each, takes, free = (memory.readable(x) for x in (needed // capacity, needed, available))
        raise ValueError(
            f"a replay of {capacity:,} steps takes {takes}, and {free} are free for it; expected a capacity of at most "
            f"{fits:,} steps ({each} each; loop.capacity). loop.storage=states stores what images are drawn from in "
            f"their place, where they can be drawn again{halved}"
        )


@in_32_bits
def random_batch(
    spec: EnvSpec,
    config: Any,
    key: Array,
    batch_size: int | None = None,
    length: int | None = None,
) -> Batch:
    """A batch of noise of the right shapes, dtypes and ranges, for benchmarks and for people who bring their own data.

    Episodes begin where the one before has ended and ``prev_action`` is the action one step before, as in a batch from
    `sample`.

    Args:
      spec: of the environment.
      config: of the agent: ``batch_size``, ``batch_length`` and ``latent_sizes`` are read.
      key: consumed.
      batch_size: B, in place of the config's.
      length: T, likewise.

    Raises:
      ValueError: for observations that are neither uint8 nor float32.
    """
    batch = config.batch_size if batch_size is None else batch_size
    steps = config.batch_length if length is None else length
    deter_size, stoch_size, class_count = config.latent_sizes
    obs_key, action_key, reward_key, end_key, deter_key, stoch_key = jax.random.split(key, 6)

    def observation(name: str, key: Array) -> Array:
        shape, dtype = spec.observation[name]
        if dtype == jnp.uint8:
            return jax.random.bits(key, (batch, steps, *shape), jnp.uint8)
        if dtype == jnp.float32:
            return jax.random.normal(key, (batch, steps, *shape))
        raise ValueError(f"observation {name!r}: expected uint8 or float32, got {jnp.dtype(dtype).name}")

    obs_keys = jax.random.split(obs_key, len(spec.observation))
    shape = (batch, steps + 1, *spec.action.shape)
    if isinstance(spec.action, ContinuousAction):
        action = jax.random.uniform(action_key, shape, minval=-1.0)
    else:
        action = jax.random.randint(action_key, shape, 0, spec.action.size)
    end = jax.random.uniform(end_key, (batch, steps + 1))  # half of the ends are terminal
    is_last, is_terminal = end < 0.02, end < 0.01
    classes = jax.random.randint(stoch_key, (batch, stoch_size), 0, class_count)
    return Batch(
        obs={name: observation(name, k) for name, k in zip(spec.observation, obs_keys, strict=True)},
        action=action[:, 1:],
        prev_action=action[:, :-1],
        reward=jax.random.normal(reward_key, (batch, steps)),
        is_first=is_last[:, :-1],
        is_last=is_last[:, 1:],
        is_terminal=is_terminal[:, 1:],
        context=Latent(
            jax.random.uniform(deter_key, (batch, deter_size), minval=-1.0), jax.nn.one_hot(classes, class_count)
        ),
        index=jnp.arange(batch * steps, dtype=jnp.int32).reshape(batch, steps),
    )


def _gather(classes: int, data: Transition, row: Array, env: Array) -> Batch:
    """The steps at these places [B, T + 1] of a ring, without their index."""
    env = env % data.reward.shape[1]  # among those of this device

    def take(ring: Array, steps: slice) -> Array:
        return ring.at[row[:, steps], env[:, steps]].get(mode="promise_in_bounds")

    current = slice(1, None)
    return Batch(
        obs=jax.tree.map(lambda x: take(x, current), data.obs),
        action=take(data.action, current),
        prev_action=take(data.action, slice(-1)),
        reward=take(data.reward, current),
        is_first=take(data.is_first, current),
        is_last=take(data.is_last, current),
        is_terminal=take(data.is_terminal, current),
        context=_expand(jax.tree.map(lambda x: take(x, slice(1))[:, 0], data.latent), classes),
        index=row[:, current],
    )


def _compact(latent: Latent, deter_dtype: Any) -> Latent:
    """One-hot [..., S, K] to classes [..., S] in the smallest unsigned type."""
    smallest = next(x for x in (jnp.uint8, jnp.uint16, jnp.uint32) if latent.stoch.shape[-1] - 1 <= jnp.iinfo(x).max)
    return Latent(latent.deter.astype(deter_dtype), jnp.argmax(latent.stoch, axis=-1).astype(smallest))


def _expand(latent: Latent, classes: int) -> Latent:
    return Latent(latent.deter.astype(jnp.float32), jax.nn.one_hot(latent.stoch, classes, dtype=jnp.float32))


def _stored(example: Transition, num_envs: int, deter_dtype: Any) -> Transition:
    """Shapes and dtypes of one row, checked: ``[N, ...]``, the latent compact."""
    lead = () if example.reward.ndim == 0 else (num_envs,)
    kinds = {"reward": jnp.float32, "is_first": jnp.bool_, "is_last": jnp.bool_, "is_terminal": jnp.bool_}
    known = {name: jax.ShapeDtypeStruct(lead, dtype) for name, dtype in kinds.items()}
    shapes.check(known, {name: getattr(example, name) for name in kinds}, "the replay")
    for path, leaf in jax.tree.leaves_with_path(example):
        if leaf.shape[: len(lead)] != lead:
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise ValueError(f"{name}: expected a leading axis of num_envs = {num_envs}, got the shape {leaf.shape}")
    if len(example.latent.stoch.shape) != len(lead) + 2:
        raise ValueError(f"latent.stoch: expected [N, S, K] one-hot over K, got the shape {example.latent.stoch.shape}")
    row = jax.eval_shape(lambda x: x._replace(latent=_compact(x.latent, deter_dtype)), example)
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_envs, *x.shape[len(lead) :]), x.dtype), row)


def _row_bytes(example: Transition, num_envs: int, deter_dtype: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(_stored(example, num_envs, deter_dtype)))
