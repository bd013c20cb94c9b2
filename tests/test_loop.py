"""The loop: what it stores, when it learns, and what it reports. An agent's stub keeps the programs small; the last
tests run the whole agent."""

import dataclasses
import operator
from fractions import Fraction
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax import agents
from ne_dreamer_jax import loop as loops
from ne_dreamer_jax.agents.guard import SKIPPED
from ne_dreamer_jax.loop import LoopConfig
from ne_dreamer_jax.loop.collect import transition
from ne_dreamer_jax.system import memory
from ne_dreamer_jax.types import TimeStep
from tests import counting, tiny
from tests.tiny import assert_same

pytestmark = pytest.mark.usefixtures("quick_compilation")

N, STEPS = 3, 20
CONFIG = LoopConfig(
    env_steps=N * STEPS * 2, num_envs=N, replay_ratio=1.0, prefill=15, chunk_steps=4, eval_every=60, eval_episodes=5
)


def make(discrete=False, image=False, **changes):
    env = counting.env(discrete, image)
    agent = counting.stub(env.spec)
    return loops.make(dataclasses.replace(CONFIG, **changes), env, agent, action_repeat=2)


def steps(n):
    return jnp.asarray(n, jnp.int32)


def ran(loop, *chunks, seed=0):
    """The state after chunks of these many steps, and the metrics of each."""
    state, out = loop.init(jax.random.key(seed)), []
    for n in chunks:
        state, report = loop.chunk(state, steps(n))
        out.append(jax.device_get(report))
    return state, out


@pytest.fixture(scope="module", params=[(False, True), (True, False)], ids=["continuous, image", "discrete, vector"])
def filled(request):
    """A run that never learns, and what it stored: [steps, N, ...]."""
    discrete, image = request.param
    loop = make(discrete, image, prefill=1000)
    state, metrics = ran(loop, STEPS)
    return SimpleNamespace(
        discrete=discrete, image=image, state=state, metrics=metrics[0].means(), data=jax.device_get(state.replay.data)
    )


def test_replay_holds_every_step_in_the_time_convention(filled):
    data = filled.data
    assert int(filled.state.replay.size) == STEPS
    name, t, effect = np.moveaxis(data.obs["vector"], -1, 0)
    action = data.action.astype(np.float32) if filled.discrete else data.action[..., 0]
    assert len(np.unique(action)) > 2
    np.testing.assert_array_equal(data.is_first, t == 0)
    np.testing.assert_array_equal(data.is_last, t == counting.length_of(name))
    np.testing.assert_array_equal(data.is_terminal, data.is_last & (name % 2 == 0))
    assert (data.is_terminal != data.is_last).any()
    assert data.is_first[0].all()
    # The reward was received on arrival at obs[t]; nothing is received at a reset.
    np.testing.assert_array_equal(data.reward, np.where(data.is_first, 0, counting.reward_of(t, effect)))
    # action[t] was taken FROM obs[t]: its effect is seen at t + 1, except that the one at a last step does nothing.
    going_on = ~data.is_last[:-1]
    np.testing.assert_array_equal(effect[1:][going_on], action[:-1][going_on])
    np.testing.assert_array_equal(t[1:][going_on], t[:-1][going_on] + 1)
    np.testing.assert_array_equal(name[1:][going_on], name[:-1][going_on])
    np.testing.assert_array_equal(data.is_first[1:], data.is_last[:-1])
    # The latent is the one of obs[t].
    np.testing.assert_array_equal(data.latent.deter[..., 0], t)
    if filled.image:
        np.testing.assert_array_equal(data.obs["image"], np.broadcast_to(t[..., None, None, None], (STEPS, N, 8, 8, 3)))


@pytest.mark.parametrize(("time_limits", "field"), [("unmarked", "is_terminal"), ("terminal", "is_last")])
def test_time_limits_are_held_as_asked(time_limits, field):
    marked, other = (
        ran(make(prefill=1000, time_limits=kind), STEPS)[0].replay.data for kind in ("marked", time_limits)
    )
    assert np.any(marked.is_last != marked.is_terminal)
    want = getattr(marked, field)
    assert_same(other, marked._replace(is_last=want, is_terminal=want))


@pytest.mark.parametrize("time_limits", ["marked", "unmarked", "terminal"])
def test_what_a_fault_has_cut_is_last_and_not_terminal_whatever_becomes_of_time_limits(time_limits):
    last, terminal, cut = (jnp.asarray(x) for x in ([1, 1, 1, 0], [0, 0, 1, 0], [1, 0, 0, 0]))
    step = TimeStep({}, jnp.zeros(4), jnp.zeros(4, bool), last > 0, terminal > 0)
    policy = counting.stub(counting.env().spec, 2).init_policy(4)
    held = transition(time_limits, step, policy, policy.prev_action, cut > 0)
    by_limit = {"marked": (True, False), "unmarked": (False, False), "terminal": (True, True)}[time_limits]
    assert (held.is_last.tolist(), held.is_terminal.tolist()) == (
        [True, by_limit[0], True, False],
        [False, by_limit[1], True, False],
    )


def test_the_state_goes_on_where_replay_ends(filled):
    policy, last = filled.state.policy, jax.tree.map(lambda x: x[STEPS - 1], filled.data)
    np.testing.assert_array_equal(policy.prev_action, last.action)
    np.testing.assert_array_equal(policy.latent.deter, last.latent.deter)
    np.testing.assert_array_equal(filled.state.env.needs_reset, last.is_last)


def test_reported_episodes_are_the_true_ones(filled):
    """Episodes that ended within the chunk, from what replay holds."""
    returns, lengths = [], []
    for env in range(N):
        begin = 0
        for t in range(STEPS):
            if filled.data.is_last[t, env]:
                returns.append(filled.data.reward[begin : t + 1, env].sum())
                lengths.append(t - begin)  # the first observation took no step
                begin = t + 1
    assert len(returns) > 2 * N
    assert filled.metrics["faults"] == 0
    assert filled.metrics["episodes"] == len(returns)
    np.testing.assert_allclose(filled.metrics["return"], np.mean(returns), rtol=1e-6)
    np.testing.assert_allclose(filled.metrics["length"], np.mean(lengths), rtol=1e-6)


def test_broken_episodes_are_cut_and_counted_chunk_by_chunk():
    env = counting.env(image=False, breaks=True)
    loop = loops.make(dataclasses.replace(CONFIG, prefill=1000), env, counting.stub(env.spec), action_repeat=2)
    state, metrics = ran(loop, 8, STEPS - 8)
    data = jax.device_get(state.replay.data)
    name, t, _ = np.moveaxis(data.obs["vector"], -1, 0)
    broken = (name % 3 == 0) & (t == 1)
    assert broken[:8].any()
    assert broken[8:].any()
    assert [int(chunk.faults) for chunk in metrics] == [broken[:8].sum(), broken[8:].sum()]
    assert data.is_last[broken].all()
    assert not data.is_terminal[broken].any()
    assert not data.reward[broken].any()
    assert data.is_first[1:][broken[:-1]].all()


@pytest.fixture(scope="module")
def learning():
    loop = make()
    return SimpleNamespace(loop=loop, whole=ran(loop, STEPS), parts=ran(loop, 3, 10, 0, 7))


def test_where_chunks_end_changes_no_bit(learning):
    assert_same(learning.parts[0], learning.whole[0])


def test_the_same_seed_gives_the_same_bits_and_another_one_others(learning):
    state, metrics = ran(learning.loop, STEPS)
    assert_same(state, learning.whole[0])
    assert_same(metrics, learning.whole[1])
    other, _ = ran(learning.loop, STEPS, seed=1)
    assert np.any(other.replay.data.action != state.replay.data.action)
    assert np.any(other.replay.data.obs["vector"] != state.replay.data.obs["vector"])


def test_metrics_are_means_over_the_chunks_updates(learning):
    (metrics,) = learning.whole[1]
    total = int(learning.whole[0].train.update)
    assert total > 3
    assert metrics.means()["update"] == (total + 1) / 2  # the stub reports its number
    nothing, _, none, _ = (report.means() for report in learning.parts[1])
    assert "update" not in nothing, "a mean over nothing"
    assert not {"return", "length"} & set(none)
    assert none["episodes"] == 0


@pytest.mark.parametrize("ratio", [0.0, 0.3, 1.0, 2.5, 7.0])
@pytest.mark.parametrize("prefill", [0, 15, 31, 1000])
def test_the_replay_ratio_and_prefill_decide_how_often_it_learns(ratio, prefill):
    # The loop's bookkeeping alone, without running it: the program takes the counters on, step by step.
    loop = make(replay_ratio=ratio, prefill=prefill)
    before = max(-(-prefill // N), 4)  # not before there is a sequence of 3 steps and the one before it
    due = Fraction(str(ratio)) * N * max(0, STEPS - before) / (2 * 3)
    assert loop.budget.updates == int(due)


@pytest.mark.parametrize(("ratio", "prefill"), [(0.3, 0), (2.5, 31)])
def test_it_learns_as_often_as_it_says(ratio, prefill):
    loop = make(replay_ratio=ratio, prefill=prefill)
    state, done = loop.init(jax.random.key(0)), []
    for _ in range(STEPS):
        state, _ = loop.chunk(state, steps(1))
        done.append(int(state.train.update))
    before = max(-(-prefill // N), 4)
    due = [int(Fraction(str(ratio)) * N * max(0, t + 1 - before) / 6) for t in range(STEPS)]
    assert done == due
    assert done[-1] == loop.budget.updates > 0


def test_updates_learn_from_the_newest_parameters_and_latents_return_to_replay(learning):
    marks = np.asarray(learning.whole[0].replay.data.latent.deter[..., 0])
    total = int(learning.whole[0].train.update)
    written = marks < 0
    assert written.any()
    assert set(marks[written]) <= set(range(-total, 0))
    assert -total in marks  # the last update's latents lie on top
    kept, _ = ran(make(write_latents=False), STEPS)
    t = np.asarray(kept.replay.data.obs["vector"][..., 1])
    np.testing.assert_array_equal(kept.replay.data.latent.deter[..., 0], t)


@pytest.mark.parametrize(("good", "in_a_row"), [(0, 7), (3, 4), (7, 0)])
def test_updates_skipped_in_a_row_are_those_since_the_last_one_that_was_made(good, in_a_row):
    """Of the eight of each vector step one is made, the first, the fourth or the last."""
    env = counting.env(image=False)
    agent = counting.stub(env.spec, weight=1.0)  # so that params count the calls
    made = agent.train_step

    def train_step(state, batch):
        new, latent, metrics = made(state, batch)
        is_made = state.params.astype(jnp.int32) % 8 == good
        update = jnp.where(is_made, new.update, state.update)
        return new._replace(update=update), latent, metrics | {SKIPPED: jnp.where(is_made, 0.0, 1.0)}

    agent.train_step = train_step
    config = dataclasses.replace(CONFIG, replay_ratio=16.0)  # eight updates of 2 x 3 steps for three agent steps
    loop = loops.make(config, env, agent, action_repeat=2)
    state, (report,) = ran(loop, 10)
    assert report.learning[SKIPPED] == 7 * int(state.train.update) > 0
    assert int(state.counters.skipped) == in_a_row


def test_latents_are_stored_in_the_chosen_dtype():
    state = jax.eval_shape(make(latent_dtype="bfloat16").init, jax.random.key(0))
    assert state.replay.data.latent.deter.dtype == jnp.bfloat16
    assert make(latent_dtype="bfloat16").replay_bytes < make().replay_bytes


def test_runs_of_several_seeds_at_once_are_those_runs(learning):
    init, chunk = loops.over_seeds(learning.loop)
    seeds = [3, 0]
    together = init(jnp.stack([jax.random.key(seed) for seed in seeds]))
    assert together.replay.position.shape == together.counters.vector_step.shape == ()
    for n in (5, STEPS - 5):
        together, metrics = chunk(together, steps(n))
    assert metrics.learning["update"].shape == (2,)
    for i, seed in enumerate(seeds):
        alone, (_, want) = ran(learning.loop, 5, STEPS - 5, seed=seed)
        one = jax.tree.map(operator.itemgetter(i), together._replace(counters=(), replay=together.replay.data))
        ring = dataclasses.replace(together.replay, data=one.replay)
        counters = together.counters._replace(skipped=together.counters.skipped[i])
        assert_same(one._replace(counters=counters, replay=ring), alone)
        np.testing.assert_allclose(metrics.learning["update"][i], want.learning["update"])


def test_replay_gets_nine_tenths_of_what_the_learner_leaves(monkeypatch):
    env = counting.env()
    agent = counting.stub(env.spec)
    config = dataclasses.replace(CONFIG, capacity=600)
    per_step = loops.make(config, env, agent, 2).replay_bytes / 600
    agent.working_bytes = lambda params: 10**6
    monkeypatch.setattr(memory, "available", lambda: int(10**6 + 300 * per_step / 0.9) + 100)
    loops.make(dataclasses.replace(config, capacity=300), env, agent, 2)
    with pytest.raises(ValueError, match="expected a capacity of at most 300 steps"):
        loops.make(config, env, agent, 2)


def test_more_replays_than_memory_holds_are_refused(monkeypatch):
    loop = make()
    monkeypatch.setattr(memory, "available", lambda: 3 * loop.replay_bytes)
    init, _ = loops.over_seeds(loop)
    with pytest.raises(ValueError, match="expected at most 2 seeds"):
        init(jax.random.split(jax.random.key(0), 3))


def test_states_and_the_host_give_the_pixels_back():
    """The learner's batches are the same to the bit, and the device's ring (it wraps) is smaller by what they took."""

    def last_batch(storage):
        env = counting.env()
        agent = counting.stub(env.spec)
        learn, seen = agent.train_step, []

        def train_step(state, batch):
            jax.debug.callback(lambda *obs: seen.append(obs), batch.obs["image"], batch.obs["vector"], ordered=True)
            return learn(state, batch)

        agent.train_step = train_step
        loop = loops.make(dataclasses.replace(CONFIG, storage=storage, capacity=30), env, agent, action_repeat=2)
        ran(loop, STEPS)
        jax.effects_barrier()
        return loop, seen

    (pixels, want), (states, redrawn), (host, fetched) = map(last_batch, ("pixels", "states", "host"))
    assert len(want) == pixels.budget.updates > 3
    assert_same(redrawn, want)
    assert_same(fetched, want)
    assert want[0][0].shape == (2, 3, 8, 8, 3)
    capacity = pixels.budget.capacity
    assert states.budget.capacity == host.budget.capacity == capacity
    assert pixels.replay_bytes - states.replay_bytes == capacity * (8 * 8 * 3 - 4)
    assert host.frames.nbytes == capacity * 8 * 8 * 3
    assert host.replay_bytes - host.frames.nbytes == states.replay_bytes  # a ticket takes what the counter's state does


def test_a_full_ring_on_the_host_keeps_the_newest_images():
    """Images count the steps of their episode, as the vectors do, so that each row can be told to hold its own."""
    loop = make(image=True, storage="host", capacity=21)
    state, _ = ran(loop, STEPS)
    data = state.replay.data
    assert int(state.replay.size) == 7 < STEPS
    tickets = np.asarray(data.obs["image"])
    np.testing.assert_array_equal(np.sort(tickets, axis=None), np.arange(21))
    kept = loop.frames.arrays["image"].reshape(21, 8, 8, 3)[tickets]
    time = np.asarray(data.obs["vector"][..., 1]).astype(np.uint8)
    np.testing.assert_array_equal(kept, np.broadcast_to(time[..., None, None, None], kept.shape))


def no_platform(local_devices, *args, backend=None, **kwargs):
    if backend == "cpu":
        raise RuntimeError("Unknown backend cpu")
    return local_devices(*args, **kwargs)


def test_images_on_the_host_are_refused_where_they_can_not_be(monkeypatch):
    with pytest.raises(ValueError, match=r"loop.storage: expected 'pixels' for an environment without"):
        make(image=False, storage="host")
    with pytest.raises(ValueError, match=r"several seeds at once, got 'host'"):
        loops.over_seeds(make(image=True, storage="host"))
    with monkeypatch.context() as patch:
        patch.setattr(jax, "process_count", lambda: 2)
        with pytest.raises(ValueError, match=r"several processes, got 'host'"):
            make(image=True, storage="host")
    with monkeypatch.context() as patch:
        patch.setattr(jax, "local_devices", partial(no_platform, jax.local_devices))
        with pytest.raises(ValueError, match="needs JAX's cpu platform"):
            make(image=True, storage="host")
    loop = make(image=True, storage="host")
    images, rest = loop.frames.nbytes, loop.replay_bytes - loop.frames.nbytes
    working = counting.stub(counting.env().spec).working_bytes(None)
    learner = sum(x.nbytes for x in jax.tree.leaves(loop.state_shapes().train) if hasattr(x, "nbytes")) + working
    monkeypatch.setattr(memory, "available", lambda: 2**40)
    monkeypatch.setattr(memory, "host_available", lambda: int(images / 2 / 0.9) + rest + learner + 200)
    with pytest.raises(ValueError, match=r"loop.storage: the images of .* expected a loop.capacity of at most"):
        make(image=True, storage="host")


def test_states_are_refused_where_images_cannot_be_drawn_again():
    with pytest.raises(ValueError, match=r"loop.storage: expected 'pixels'"):
        make(image=False, storage="states")


def episodes_of_the_mode(names):
    """Returns and lengths (in steps) of the stub's mode: action t / 4 at step t."""
    length = counting.length_of(names)
    returns = [sum(counting.reward_of(t, min((t - 1) / 4, 1)) for t in range(1, n + 1)) for n in length]
    return np.asarray(returns), length


def test_evaluation_returns_are_the_true_ones():
    loop = make(image=True)
    state = loop.init(jax.random.key(0))
    got = loop.evaluate(state.train.params, jax.random.key(7), frames=True)
    assert got.returns.shape == got.lengths.shape == (5,)
    # Which episodes these were follows from their lengths: 2, 3 or 4 steps.
    names = np.asarray(got.lengths) - 2
    assert len(set(names)) > 1
    want, lengths = episodes_of_the_mode(names)
    np.testing.assert_allclose(got.returns, want, rtol=1e-6)
    np.testing.assert_array_equal(got.lengths, lengths)
    assert got.frames.dtype == np.uint8
    np.testing.assert_array_equal(
        got.frames, np.broadcast_to(np.arange(lengths[0] + 1)[:, None, None, None], got.frames.shape)
    )
    again = loop.evaluate(state.train.params, jax.random.key(7), episodes=5)
    assert_same((again.returns, again.lengths), (got.returns, got.lengths))
    assert again.frames is None
    assert loop.evaluate(state.train.params, jax.random.key(8), episodes=2).returns.shape == (2,)


@pytest.mark.parametrize("discrete", [False, True])
def test_random_evaluation_takes_uniform_actions(discrete):
    spec = counting.env(discrete).spec.action
    actions = np.asarray(loops.random_action(spec, jax.random.key(0), 3_000))
    assert actions.shape == (3_000, *spec.shape)
    assert actions.dtype == spec.dtype
    if discrete:
        assert np.abs(np.bincount(actions, minlength=3) - 1_000).max() < 120
    else:
        assert np.abs(np.histogram(actions, 4, (-1, 1))[0] - 750).max() < 120
    loop = make(discrete)
    params = jnp.zeros(())
    key = jax.random.key(7)
    random, mode = (np.asarray(loop.evaluate(params, key, random=r).returns) for r in (True, False))
    assert (random != mode).any()
    assert (np.abs(random - mode) <= 4 * 0.25 * 2).all()  # the same episodes, other actions


@pytest.mark.parametrize(
    ("changes", "steps", "capacity"),
    [
        ({"env_steps": 1200}, 200, 600),
        ({"env_steps": 1201}, 201, 603),
        ({"env_steps": 1201, "capacity": 100}, 201, 99),
        ({"env_steps": 6}, 1, 12),
    ],
)
def test_the_budget_is_counted_in_environment_steps(changes, steps, capacity):
    loop = make(**changes)
    assert (loop.budget.vector_steps, loop.budget.capacity) == (steps, capacity)
    state = jax.eval_shape(loop.init, jax.random.key(0))
    assert loop.replay_bytes == sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state.replay.data))


def test_what_replay_cannot_hold_is_refused():
    with pytest.raises(ValueError, match=r"expected a capacity of at most"):
        make(env_steps=10**15, capacity=10**13)
    with pytest.raises(ValueError, match=r"loop.capacity: expected at least 12 transitions.* got 11"):
        make(capacity=11)


# With the whole agent.


@pytest.fixture(scope="module")
def whole():
    env = counting.env(image=False)
    config = dataclasses.replace(tiny.CONFIG, batch_length=4)
    agent = agents.make_agent(config, env.spec)
    loop = loops.make(dataclasses.replace(CONFIG, replay_ratio=8.0, prefill=9, env_steps=60), env, agent, 2)

    # The parameters come from numpy; compiling their initialisation would take longer than all the rest.
    shapes = jax.eval_shape(loop.init, jax.random.key(0))
    stub = loops.make(CONFIG, env, counting.stub(env.spec), 2)
    return SimpleNamespace(agent=agent, loop=loop, shapes=shapes, stub=stub)


def fresh(whole, seed=0):
    """A first state; environments and replay as ``Loop.init`` makes them."""
    start = whole.stub.init(jax.random.key(seed))
    replay = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), whole.shapes.replay)
    policy = whole.agent.init_policy(N)
    return start._replace(train=tiny.state(whole.agent, seed), policy=policy, replay=replay)


def test_the_whole_agent_learns_in_the_loop(whole):
    """One program: no transfer to or from the host inside, donated state, one compilation, the same bits whenever."""
    loop = whole.loop
    first, ten, five, zero = fresh(whole), steps(10), steps(5), steps(0)
    jax.block_until_ready((first, ten, five))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), first) == jax.tree.map(lambda x: (x.shape, x.dtype), whole.shapes)
    state, _ = loop.chunk(first, zero)  # compiles
    assert all(x.is_deleted() for x in jax.tree.leaves((first.train.params, first.train.optimizer, first.replay)))
    with jax.transfer_guard("disallow"):
        state, metrics = loop.chunk(state, ten)
        jax.block_until_ready(metrics)
    assert int(state.train.update) == loop.budget.updates > 5
    assert all(np.isfinite(x) for x in metrics.means().values())
    assert {f"loss/{name}" for name in tiny.CONFIG.loss_scales} <= set(metrics.means())

    halves = fresh(whole)
    for _ in range(2):
        halves, _ = loop.chunk(halves, five)
    assert_same(halves, state)
    assert loop.chunk._cache_size() == 1


def test_virtual_devices_have_no_more_memory_than_the_host(monkeypatch):
    from ne_dreamer_jax.envs.vector import as_vector
    from ne_dreamer_jax.loop.make import fit_memory, row_shapes
    from ne_dreamer_jax.replay import storage

    env = counting.env()
    agent, kept = counting.stub(env.spec), storage.pixels()
    row, budget = row_shapes(CONFIG, as_vector(env), agent, kept), make().budget
    monkeypatch.setattr(memory, "available", lambda: 10**9)
    alone, divided = (fit_memory(agent, kept, row, budget, jnp.float32, devices)[0] for devices in (1, 8))
    assert divided <= alone < 10**9


@pytest.mark.parametrize("ratio", [1e-9, 0.0004, 0.0009])
def test_replay_ratios_that_cant_be_kept_are_refused(ratio):
    with pytest.raises(ValueError, match=r"expected 0 \(never learn\) or at least 0.001"):
        loops.Budget.of(LoopConfig(replay_ratio=ratio), 2, 3, 1)
    loops.Budget.of(LoopConfig(replay_ratio=0.001), 2, 3, 1)


def test_more_sequences_of_environments_than_32_bits_count_are_refused():
    with pytest.raises(
        ValueError, match=r"loop.num_envs times agent.batch_size below 2\*\*31, got 65,536 times 32,768"
    ):
        loops.Budget.of(LoopConfig(num_envs=2**16, replay_ratio=0.001), 2**15, 1, 1)
