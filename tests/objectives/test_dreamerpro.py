"""DreamerPro's objective: the views, which of them predicts what, the teacher, and when prototypes move."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from ne_dreamer_jax.objectives import DreamerPro, Model
from ne_dreamer_jax.objectives.augment import random_shift, shift_images
from ne_dreamer_jax.types import ArraySpec, EnvSpec, Rollout
from tests import tiny

pytestmark = pytest.mark.usefixtures("quick_compilation")

CONFIG = DreamerPro(prototypes=7, dimension=3, frozen_updates=2, max_shift=1.0)
B, T, E, F = 2, 5, 4, 6
KEY = jax.random.key(0)
NAMES = ("swav", "temporal", "norm")


# Views.


def images(seed=0, shape=(2, 3, 6, 7, 3)):
    return jnp.asarray(np.random.default_rng(seed).uniform(size=shape).astype(np.float32))


def test_a_shift_is_bilinear_and_continues_the_edges():
    shift = np.asarray([[1.25, -2.5], [-0.75, 3.0]], np.float32)
    got = shift_images(images(), jnp.asarray(shift))
    for b, t, c in np.ndindex(2, 3, 3):
        want = ndimage.shift(np.asarray(images())[b, t, :, :, c], -shift[b], order=1, mode="nearest")
        np.testing.assert_allclose(got[b, t, :, :, c], want, atol=1e-5)


def test_shifts_differ_among_sequences_but_not_across_time():
    still = jnp.broadcast_to(images(shape=(1, 1, 6, 7, 1)), (40, 3, 6, 7, 1))
    got = np.asarray(random_shift(KEY, still, 3.0))
    assert (got == got[:, :1]).all()
    assert len({x.tobytes() for x in got[:, 0]}) == 40
    np.testing.assert_allclose(random_shift(KEY, still, 0.0), still, atol=1e-6)


# The losses, on known networks: an embedding is a linear map of the image's mean, a state one of the embedding.

SPEC = EnvSpec({"image": ArraySpec((4, 4, 1), jnp.uint8)}, None)


def encode(name, params, obs):
    return jnp.mean(obs["image"], axis=(2, 3)) @ params["encoder"]


def unroll(params, key, batch):
    embedding = encode("encoder", params, batch.obs)
    return Rollout(batch, embedding, None, embedding @ params["rssm"], None, None)


NETS = SimpleNamespace(spec=SPEC, embedding=E, feature=F, dtype=jnp.float32, apply=encode)


@pytest.fixture(scope="module")
def made():
    objective = CONFIG.build(Model(NETS, T, unroll))
    own = tiny.fill(jax.eval_shape(objective.init, KEY), std=1.0)
    params = {"encoder": tiny.fill(jnp.zeros((1, E)), 1), "rssm": tiny.fill(jnp.zeros((E, F)), 2), "objective": own}
    image = jnp.asarray(np.random.default_rng(3).integers(0, 256, (B, T, 4, 4, 1)), jnp.uint8)
    batch = tiny.batch(tiny.VECTORS, (B, T))._replace(obs={"image": image})
    rollout = Rollout(batch, None, None, None, None, None)  # the batch is all that may be read
    return objective, params, rollout, jax.jit(objective.loss)


def test_losses_are_named_finite_and_drawn_anew(made):
    objective, params, rollout, loss = made
    target = objective.init_target(params)
    losses, metrics = loss(params, target, KEY, rollout)
    assert set(losses) == set(CONFIG.losses) == set(NAMES)
    assert all(np.isfinite(x) for x in (*losses.values(), *metrics.values()))
    # A cross-entropy is at least the entropy, and at most about twice the range of the scores over the temperature.
    assert 0 < losses["swav"] < 2 / CONFIG.temperature + np.log(7)
    assert loss(params, target, jax.random.key(1), rollout)[0]["swav"] != losses["swav"]


def test_a_state_is_paired_with_the_assignment_of_its_own_step_and_view():
    """A state that is the embedding of its own step predicts best what that embedding is assigned to."""
    config = replace(CONFIG, max_shift=0.0)
    projection = {"kernel": jax.random.normal(KEY, (E, 3)), "bias": jnp.zeros((3,))}
    prototypes = jax.random.normal(jax.random.key(1), (7, 3))
    own = {"embedding": projection, "feature": projection, "prototypes": prototypes}
    params = {"encoder": tiny.fill(jnp.zeros((1, E)), 1), "objective": own}
    image = jnp.asarray(np.random.default_rng(3).integers(0, 2, (4, 40, 4, 4, 1)) * 255, jnp.uint8)
    batch = tiny.batch(tiny.VECTORS, (4, 40))._replace(obs={"image": image})

    def temporal(offset):
        """Where the state is the embedding ``offset`` steps before."""

        def late(params, key, batch):
            embedding = encode("encoder", params, batch.obs)
            return Rollout(batch, embedding, None, jnp.roll(embedding, offset, axis=1), None, None)

        made = config.build(Model(NETS, 40, late))
        rollout = Rollout(batch, None, None, None, None, None)
        return float(made.loss(params, made.init_target(params), KEY, rollout)[0]["temporal"])

    assert temporal(0) < min(temporal(1), temporal(-1))


def test_the_warm_up_counts_for_norm_alone(made):
    objective, params, rollout, loss = made
    target = objective.init_target(params)
    changed = rollout.batch._replace(obs={"image": rollout.batch.obs["image"].at[:, 0].set(7)})
    before, _ = loss(params, target, KEY, rollout)
    after, _ = loss(params, target, KEY, rollout._replace(batch=changed))
    assert [bool(before[name] == after[name]) for name in NAMES] == [True, True, False]


def test_gradients_reach_encoder_states_and_projections_and_no_teacher(made):
    objective, params, rollout, _ = made
    target = objective.init_target(params)
    floats = {name: target[name] for name in ("encoder", "projection")}

    def total(params, floats, name):
        return objective.loss(params, {**target, **floats}, KEY, rollout)[0][name]

    touched = {}
    for name in NAMES:
        of_params, of_teacher = jax.jit(jax.grad(total, argnums=(0, 1)), static_argnums=2)(params, floats, name)
        assert tiny.is_zero(of_teacher)
        assert tiny.is_zero(of_params["objective"]["prototypes"])  # frozen
        touched[name] = {
            "encoder": not tiny.is_zero(of_params["encoder"]),
            "rssm": not tiny.is_zero(of_params["rssm"]),
            **{k: not tiny.is_zero(of_params["objective"][k]) for k in ("embedding", "feature")},
        }
    assert touched == {
        "swav": {"encoder": True, "rssm": False, "embedding": True, "feature": False},
        "temporal": {"encoder": True, "rssm": True, "embedding": False, "feature": True},
        "norm": {"encoder": True, "rssm": True, "embedding": True, "feature": True},
    }


def test_prototypes_move_once_they_are_no_longer_frozen(made):
    objective, params, rollout, _ = made
    of_prototypes = jax.jit(
        jax.grad(lambda own, target: objective.loss({**params, "objective": own}, target, KEY, rollout)[0]["swav"])
    )
    moved = []
    target = objective.init_target(params)
    for update in range(4):
        assert target["update"] == update
        moved.append(not tiny.is_zero(of_prototypes(params["objective"], target)["prototypes"]))
        target = objective.after_update(params, target, jnp.asarray(update + 1, jnp.int32))
    assert moved == [False, False, True, True]


def test_the_teacher_starts_as_a_copy_and_follows_at_its_rate(made):
    objective, params, _, _ = made
    target = objective.init_target(params)
    tiny.assert_same(target["encoder"], params["encoder"])
    tiny.assert_same(target["projection"], params["objective"]["embedding"])
    moved = jax.tree.map(lambda x: x + 1.0, params)
    after = objective.after_update(moved, target, jnp.asarray(1, jnp.int32))
    for name in ("encoder", "projection"):
        for x, y in zip(jax.tree.leaves(after[name]), jax.tree.leaves(target[name]), strict=True):
            np.testing.assert_allclose(x, y + CONFIG.teacher_rate, rtol=1e-5)


@pytest.mark.parametrize(
    ("changes", "spec", "message"),
    [
        ({}, tiny.VECTORS, r"expected one among the observations, got \['vector'\]"),
        ({"warm_up": 5}, SPEC, "objective.warm_up: expected 0 or more and less than agent.batch_length 5, got 5"),
    ],
)
def test_what_does_not_fit_is_refused(changes, spec, message):
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **changes).build(Model(SimpleNamespace(**{**vars(NETS), "spec": spec}), T, unroll))


def test_whole_shifts_only_move_pixels():
    picture = images(shape=(300, 1, 5, 5, 1))
    got = random_shift(KEY, picture, 1.0, whole=True)
    inner = np.asarray(got)[:, 0, 2, 2, 0]
    sources = np.asarray(picture)[:, 0, 1:4, 1:4, 0].reshape(300, 9)
    assert (np.abs(sources - inner[:, None]).min(axis=1) < 1e-6).all()
    moves = np.bincount(np.abs(sources - inner[:, None]).argmin(axis=1), minlength=9)
    assert (moves > 15).all()  # 33 of each are expected


def test_projections_start_within_the_root_of_their_inputs():
    own = replace(CONFIG, dimension=200, projection_init="uniform").build(Model(NETS, T, unroll)).init(KEY)
    for name, inputs in (("embedding", E), ("feature", F)):
        for values in own[name].values():
            assert 0.9 < np.abs(values).max() * inputs**0.5 <= 1
            assert np.abs(np.mean(values)) < 0.1
