"""The ring against a plain record of everything that was added to it."""

import dataclasses
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ne_dreamer_jax.replay import ring as replay
from ne_dreamer_jax.system import memory
from ne_dreamer_jax.types import ArraySpec, Batch, ContinuousAction, DiscreteAction, EnvSpec, Latent, Transition

N, C, S, K = 3, 7, 2, 5

add = jax.jit(replay.add, donate_argnums=0)
sample = jax.jit(replay.sample, static_argnums=(2, 3))
write_latents = jax.jit(replay.write_latents)


def transition(t, n=N, shift=0):
    """Every value tells the environment and the step it comes from."""
    env = np.arange(n)
    code = 100 * env + t
    one_hot = np.eye(K, dtype=np.float32)[(code[:, None] + np.arange(S) + shift) % K]
    last = (t + env) % 4 == 3
    return Transition(
        obs={
            "image": jnp.asarray((code[:, None, None, None] * np.ones((2, 2, 1)) % 251).astype(np.uint8)),
            "code": jnp.asarray(np.stack([env, np.full(n, t)], -1).astype(np.float32)),
        },
        action=jnp.asarray(code[:, None].astype(np.float32) / 1000),
        reward=jnp.asarray(code.astype(np.float32) + shift),
        is_first=jnp.asarray((t + env) % 4 == 0),
        is_last=jnp.asarray(last),
        is_terminal=jnp.asarray(last & (env % 2 == 0)),
        latent=Latent(jnp.asarray(np.tile(code[:, None] + shift, (1, 4)).astype(np.float32)), jnp.asarray(one_hot)),
    )


STEPS = [transition(t) for t in range(40)]


def ring(steps, rows=C, **options):
    state = replay.init(STEPS[0], rows * N, N, **options)
    for t in range(steps):
        state = add(state, STEPS[t])
    return state


def origin(batch):
    """Environment and step of every element [B, T], and that all of them belong together."""
    code = np.asarray(batch.obs["code"]).astype(int)
    return code[..., 0], code[..., 1]


@settings(deadline=None, max_examples=60)
@given(st.integers(2, 39), st.sampled_from([1, 3, C - 1]), st.integers(0, 2**31 - 1))
def test_sequences_are_whole_consecutive_and_still_held(steps, length, seed):
    state = ring(steps)
    assert bool(replay.can_sample(state, length)) == (min(steps, C) >= length + 1)
    if not replay.can_sample(state, length):
        return
    batch = sample(state, jax.random.key(seed), 8, length)
    env, t = origin(batch)
    assert (env == env[:, :1]).all()
    assert (t == t[:, :1] + np.arange(length)).all()
    assert (t[:, 0] - 1 >= max(0, steps - C)).all()  # the context too
    assert (t[:, -1] < steps).all()
    want = jax.tree.map(lambda *x: np.stack(x), *STEPS)
    for name in ("action", "reward", "is_first", "is_last", "is_terminal"):
        np.testing.assert_array_equal(getattr(batch, name), getattr(want, name)[t, env], err_msg=name)
    np.testing.assert_array_equal(batch.obs["image"], want.obs["image"][t, env])
    np.testing.assert_array_equal(batch.prev_action, want.action[t - 1, env])
    np.testing.assert_array_equal(batch.context.deter, want.latent.deter[t[:, 0] - 1, env[:, 0]])
    np.testing.assert_array_equal(batch.context.stoch, want.latent.stoch[t[:, 0] - 1, env[:, 0]])
    np.testing.assert_array_equal(batch.index, t % C * N + env)


@pytest.mark.parametrize("steps", [4, 6, C, C + 1, 3 * C + 2])
def test_every_valid_start_is_drawn_and_equally_often(steps):
    length, draws = 3, 6000
    env, t = origin(sample(ring(steps), jax.random.key(0), draws, length))
    held = range(max(0, steps - C) + 1, steps - length + 1)
    starts, counts = np.unique(t[:, 0] * N + env[:, 0], return_counts=True)
    np.testing.assert_array_equal(starts, sorted(s * N + n for s in held for n in range(N)))
    mean = draws / len(starts)
    assert np.abs(counts - mean).max() < 5 * np.sqrt(mean)


def test_samples_are_functions_of_the_key_to_the_bit():
    state = ring(20)
    batches = [sample(state, jax.random.key(seed), 4, 3) for seed in (0, 0, 1)]
    jax.tree.map(np.testing.assert_array_equal, batches[0], batches[1])
    assert (batches[0].index != batches[2].index).any()


@settings(deadline=None, max_examples=30)
@given(st.integers(C, 30), st.integers(0, 2**31 - 1))
def test_written_latents_come_back_and_nothing_else_changes(steps, seed):
    state = ring(steps)
    batch = sample(state, jax.random.key(seed), 4, 3)
    env, t = origin(batch)
    new = Latent(
        jnp.asarray(np.random.default_rng(seed).normal(size=(4, 3, 4)).astype(np.float32)),
        jnp.asarray(np.eye(K, dtype=np.float32)[np.random.default_rng(seed).integers(0, K, (4, 3, S))]),
    )
    written = write_latents(state, batch.index, new)

    want = np.array(state.data.latent.deter), np.array(state.data.latent.stoch)
    for b, s in np.ndindex(4, 3):  # in row-major order: the last one stays
        want[0][t[b, s] % C, env[b, s]] = new.deter[b, s]
        want[1][t[b, s] % C, env[b, s]] = np.argmax(new.stoch[b, s], -1)
    np.testing.assert_array_equal(written.data.latent.deter, want[0])
    np.testing.assert_array_equal(written.data.latent.stoch, want[1])
    same = dataclasses.replace(written, data=written.data._replace(latent=state.data.latent))
    jax.tree.map(np.testing.assert_array_equal, same, state)

    again = sample(written, jax.random.key(seed + 1), 64, 3)
    env, t = origin(again)
    np.testing.assert_array_equal(again.context.deter, want[0][(t[:, 0] - 1) % C, env[:, 0]])
    np.testing.assert_array_equal(again.context.stoch, np.eye(K)[want[1][(t[:, 0] - 1) % C, env[:, 0]]])


def test_repeated_steps_keep_the_last_latent():
    index = jnp.asarray([[4, 5, 6], [5, 6, 4], [4, 4, 9]], jnp.int32)
    deter = jnp.arange(36, dtype=jnp.float32).reshape(3, 3, 4)
    stoch = jax.nn.one_hot(jnp.arange(18).reshape(3, 3, 2) % K, K)
    written = write_latents(ring(C), index, Latent(deter, stoch))
    for flat, (b, t) in {4: (2, 1), 5: (1, 0), 6: (1, 1), 9: (2, 2)}.items():
        np.testing.assert_array_equal(written.data.latent.deter[flat // N, flat % N], deter[b, t])
        np.testing.assert_array_equal(written.data.latent.stoch[flat // N, flat % N], np.argmax(stoch[b, t], -1))


@pytest.mark.parametrize(
    ("classes", "dtype"), [(1, "uint8"), (256, "uint8"), (257, "uint16"), (300, "uint16"), (65_537, "uint32")]
)
def test_every_class_survives_storage(classes, dtype):
    latents = min(100, 100_000 // classes)
    stoch = jax.nn.one_hot(jnp.arange(N * latents).reshape(N, latents) % classes, classes)
    stoch = stoch.at[0, 0].set(jax.nn.one_hot(classes - 1, classes))
    step = STEPS[0]._replace(latent=Latent(jnp.ones((N, 1)), stoch))
    state = replay.add(replay.add(replay.init(step, 2 * N, N), step), step)
    assert state.data.latent.stoch.dtype == dtype
    batch = replay.sample(state, jax.random.key(0), 20, 1)
    np.testing.assert_array_equal(batch.context.stoch, stoch[np.asarray(batch.index[:, 0]) % N])


def test_agents_without_latents_need_no_special_case():
    step = STEPS[0]._replace(latent=Latent(jnp.zeros((N, 0)), jnp.zeros((N, 0, 1))))
    state = replay.add(replay.add(replay.init(step, 2 * N, N), step), step)
    assert replay.sample(state, jax.random.key(0), 4, 1).context.stoch.shape == (4, 0, 1)


def test_deter_can_be_stored_in_half_precision():
    state = ring(5, deter_dtype=jnp.bfloat16)
    assert state.data.latent.deter.dtype == jnp.bfloat16
    batch = sample(state, jax.random.key(0), 8, 2)
    env, t = origin(batch)
    want = jnp.asarray(100 * env[:, 0] + t[:, 0] - 1, jnp.float32).astype(jnp.bfloat16).astype(jnp.float32)
    np.testing.assert_array_equal(batch.context.deter[:, 0], want)
    assert batch.context.deter.dtype == jnp.float32
    new = Latent(jnp.full((8, 2, 4), 0.1), batch.context.stoch[:, None].repeat(2, 1))
    assert write_latents(state, batch.index, new).data.latent.deter.dtype == jnp.bfloat16


def test_example_may_be_one_environment_or_shapes_alone():
    full = replay.init(STEPS[0], C * N, N)
    for example in (
        jax.tree.map(lambda x: x[0], STEPS[0]),
        jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), STEPS[0]),
    ):
        jax.tree.map(np.testing.assert_array_equal, replay.init(example, C * N + N - 1, N), full)


def test_compiled_collect_and_learn_works_on_the_ring_in_place():
    """A scan of add and an inner loop of sample and write_latents needs nothing near a second ring."""
    rows, envs, batch_size, length = 512, 4, 2, 8
    one = jax.tree.map(lambda x: jnp.zeros((envs, *x.shape[1:]), x.dtype), STEPS[0])
    one = one._replace(
        obs={"image": jnp.zeros((envs, 64, 64, 3), jnp.uint8)},
        latent=Latent(jnp.zeros((envs, 256)), jnp.zeros((envs, 8, 4))),
    )
    state = replay.init(one, rows * envs, envs)
    size = sum(x.nbytes for x in jax.tree.leaves(state))

    def update(_, carry):
        state, key, total = carry
        key, sample_key = jax.random.split(key)
        batch = replay.sample(state, sample_key, batch_size, length)
        total += jnp.sum(batch.obs["image"], dtype=jnp.float32) + jnp.sum(batch.reward)
        latent = jax.tree.map(lambda x: jnp.broadcast_to(x[:, None], (batch_size, length, *x.shape[1:])), batch.context)
        return replay.write_latents(state, batch.index, latent), key, total

    def chunk(state, key):
        def step(carry, _):
            state, key = carry
            state, key, total = jax.lax.fori_loop(0, 3, update, (replay.add(state, one), key, jnp.zeros(())))
            return (state, key), total

        return jax.lax.scan(step, (state, key), length=20)

    compiled = jax.jit(chunk, donate_argnums=0).lower(state, jax.random.key(0)).compile()
    usage = compiled.memory_analysis()
    assert usage.alias_size_in_bytes > 0.99 * size  # the ring goes out where it came in
    assert usage.temp_size_in_bytes < 0.05 * size
    (state, _), totals = compiled(state, jax.random.key(0))
    assert (state.position, state.size) == (20, 20)
    assert np.isfinite(totals).all()


def test_every_environment_has_its_share_of_every_batch():
    """Stratified, so that devices with equal shares of the environments have equal shares of the batch."""
    for batch_size in (1, 2, 4, 6, 7):
        shares = []
        for seed in range(60):
            env, _ = origin(sample(ring(20), jax.random.key(seed), batch_size, 3))
            place = env[:, 0]
            assert (place >= np.arange(batch_size) * N // batch_size).all()
            assert (place <= ((np.arange(batch_size) + 1) * N - 1) // batch_size).all()
            shares.append(np.bincount(place, minlength=N))
        assert (np.mean(shares, 0) > 0).all()


def test_bytes_are_known_before_allocation():
    for options in ({}, {"deter_dtype": jnp.bfloat16}):
        state = replay.init(STEPS[0], C * N, N, **options)
        assert replay.nbytes(STEPS[0], C * N + 1, N, **options) == sum(x.nbytes for x in jax.tree.leaves(state.data))


def test_what_memory_cannot_hold_is_refused_with_what_it_can():
    per_step = 4 + 8 + 4 + 4 + 3 + 16 + 2  # image, code, action, reward, flags, deter, classes
    available = 100 * N * per_step + 7
    assert replay.capacity_for(STEPS[0], available, N) == 100 * N
    replay.init(STEPS[0], 100 * N + 1, N, available=available)
    with pytest.raises(
        ValueError, match=r"303 steps takes 12.1 KiB.* 12.0 KiB are free.* at most 300 steps \(41 B each"
    ):
        replay.init(STEPS[0], 101 * N, N, available=available)
    half = replay.capacity_for(STEPS[0], available, N, jnp.bfloat16)
    replay.check_capacity(STEPS[0], half, N, jnp.bfloat16, available)
    with pytest.raises(ValueError, match=f"at most {half} steps"):
        replay.check_capacity(STEPS[0], half + N, N, jnp.bfloat16, available)


def test_the_device_is_asked_where_nothing_is_given(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: 10_000)
    with pytest.raises(ValueError, match=r"8.8 KiB are free for it"):
        replay.init(STEPS[0], 10**9, N)


def bad(**fields):
    return STEPS[0]._replace(**fields)


@pytest.mark.parametrize(
    ("example", "message"),
    [
        (bad(reward=jnp.zeros(N, jnp.int32)), r"reward: expected float32\[3\], got int32\[3\]"),
        (bad(is_last=jnp.zeros((N, 1), bool)), r"is_last: expected bool\[3\], got bool\[3, 1\]"),
        (bad(obs={"image": jnp.zeros((2, 4, 4, 1), jnp.uint8)}), r"obs.image: expected a leading axis of num_envs = 3"),
        (bad(latent=Latent(jnp.zeros((N, 4)), jnp.zeros((N, 4)))), r"latent.stoch: expected \[N, S, K\]"),
    ],
)
def test_examples_that_are_no_transition_are_refused(example, message):
    with pytest.raises(ValueError, match=message):
        replay.init(example, C * N, N)


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (transition(0, n=2), r"reward: expected float32\[3\], got float32\[2\]"),
        (bad(obs={"code": STEPS[0].obs["code"]}), r"obs.image: expected uint8\[3, 2, 2, 1\], got nothing"),
        (bad(action=jnp.zeros(N, jnp.int32)), r"action: expected float32\[3, 1\], got int32\[3\]"),
        (bad(latent=Latent(jnp.zeros((N, 5)), STEPS[0].latent.stoch)), r"latent.deter: expected float32\[3, 4\]"),
    ],
)
def test_steps_unlike_the_example_are_refused(step, message):
    with pytest.raises(ValueError, match=message):
        replay.add(ring(0), step)


def test_latents_unlike_the_batch_are_refused():
    state = ring(C)
    batch = sample(state, jax.random.key(0), 4, 3)
    with pytest.raises(ValueError, match=r"deter: expected float32\[4, 3, 4\], got float32\[4, 4\]"):
        replay.write_latents(state, batch.index, batch.context)


@pytest.mark.parametrize("length", [0, C, C + 5])
def test_lengths_that_never_fit_are_refused(length):
    with pytest.raises(ValueError, match="expected a length of 1 to 6 steps"):
        replay.sample(ring(C), jax.random.key(0), 2, length)


def test_more_sequences_of_environments_than_32_bits_count_are_refused():
    with pytest.raises(ValueError, match=r"expected fewer than 2\*\*31 for environments times sequences"):
        jax.eval_shape(lambda state: replay.sample(state, jax.random.key(0), -(-(2**31) // N), 2), ring(C))


@pytest.mark.parametrize(("capacity", "envs"), [(5, 3), (10, 0), (2**31, 3)])
def test_senseless_capacities_are_refused(capacity, envs):
    with pytest.raises(ValueError, match="expected a capacity"):
        replay.init(jax.tree.map(lambda x: x[0], STEPS[0]), capacity, envs)


AGENT = SimpleNamespace(batch_size=4, batch_length=50, latent_sizes=(6, S, K))


@pytest.mark.parametrize("action", [ContinuousAction(2), DiscreteAction(5)])
def test_random_batch_is_shaped_like_a_sampled_one(action):
    spec = EnvSpec({"image": ArraySpec((8, 8, 3), jnp.uint8), "speed": ArraySpec((), jnp.float32)}, action)
    batch = jax.jit(partial(replay.random_batch, spec, AGENT))(jax.random.key(0))
    example = Transition(
        {name: jnp.zeros((N, *s.shape), s.dtype) for name, s in spec.observation.items()},
        jnp.zeros((N, *action.shape), action.dtype),
        *(jnp.zeros(N, dtype) for dtype in (jnp.float32, bool, bool, bool)),
        Latent(jnp.zeros((N, 6)), jnp.zeros((N, S, K))),
    )
    sampled = jax.eval_shape(
        lambda s, k: replay.sample(s, k, 4, 50), replay.init(example, 60 * N, N), jax.random.key(0)
    )
    assert isinstance(batch, Batch)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), batch) == jax.tree.map(lambda x: (x.shape, x.dtype), sampled)

    np.testing.assert_array_equal(batch.prev_action[:, 1:], batch.action[:, :-1])
    np.testing.assert_array_equal(batch.is_first[:, 1:], batch.is_last[:, :-1])
    assert not (batch.is_terminal & ~batch.is_last).any()
    assert batch.is_first.any()
    assert batch.obs["image"].max() > 200
    low, high = (-1, 1) if isinstance(action, ContinuousAction) else (0, 4)
    assert low <= batch.action.min() < batch.action.max() <= high
    np.testing.assert_array_equal(batch.context.stoch.sum(-1), 1)
    small = jax.eval_shape(lambda key: replay.random_batch(spec, AGENT, key, 2, 3), jax.random.key(0))
    assert small.obs["image"].shape == (2, 3, 8, 8, 3)


def test_random_batch_refuses_other_observations():
    spec = EnvSpec({"ids": ArraySpec((3,), jnp.int32)}, ContinuousAction(2))
    with pytest.raises(ValueError, match="observation 'ids': expected uint8 or float32, got int32"):
        replay.random_batch(spec, AGENT, jax.random.key(0))
