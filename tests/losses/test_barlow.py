"""Barlow Twins and the next-embedding loss against float64 numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.losses import barlow_twins, next_embedding_loss

LAMBDA = 5e-4


def oracle(prediction, target, redundancy=LAMBDA):
    """The paper's equation, in float64, by np.corrcoef."""
    size = prediction.shape[-1]
    joint = np.concatenate([prediction.reshape(-1, size), target.reshape(-1, size)], 1).astype(np.float64)
    c = np.corrcoef(joint, rowvar=False)[:size, size:]
    off = c[~np.eye(size, dtype=bool)]
    return ((1 - np.diag(c)) ** 2).sum() + redundancy * (off**2).sum(), np.diag(c).mean(), np.sqrt((off**2).mean())


def pair(seed, shape, noise=0.7):
    rng = np.random.default_rng(seed)
    target = rng.normal(size=shape).astype(np.float32) @ rng.normal(size=(shape[-1], shape[-1])).astype(np.float32)
    return (target + noise * rng.normal(size=shape)).astype(np.float32) * 3 + 5, target


@pytest.mark.parametrize("redundancy", [0.0, LAMBDA, 0.5])
def test_barlow_twins_equals_the_equation(redundancy):
    prediction, target = pair(0, (6, 7, 12))
    loss, metrics = barlow_twins(jnp.asarray(prediction), jnp.asarray(target), redundancy=redundancy)
    want, diagonal, off_diagonal = oracle(prediction, target, redundancy)
    np.testing.assert_allclose(loss, want, rtol=1e-4)
    np.testing.assert_allclose(metrics["diagonal"], diagonal, rtol=1e-5)
    np.testing.assert_allclose(metrics["off_diagonal"], off_diagonal, rtol=1e-4)
    assert metrics["pairs"] == 42
    assert loss.dtype == jnp.float32


def test_masked_is_the_subset_and_what_is_masked_does_not_matter():
    prediction, target = pair(1, (5, 8, 6))
    mask = np.random.default_rng(2).random((5, 8)) < 0.6
    spoilt = np.where(mask[..., None], prediction, np.nan).astype(np.float32)

    def value_and_grad(p, t, m):
        return jax.value_and_grad(lambda p, t: barlow_twins(p, t, m)[0], (0, 1))(jnp.asarray(p), jnp.asarray(t))

    loss, (dp, dt) = value_and_grad(spoilt, np.where(mask[..., None], target, np.inf), jnp.asarray(mask))
    subset, (dp_subset, dt_subset) = value_and_grad(prediction[mask], target[mask], None)
    np.testing.assert_allclose(loss, subset, rtol=1e-5)
    np.testing.assert_allclose(loss, oracle(prediction[mask], target[mask])[0], rtol=1e-4)
    for full, part in ((dp, dp_subset), (dt, dt_subset)):
        np.testing.assert_allclose(np.asarray(full)[mask], part, rtol=1e-4, atol=1e-6)
        assert not np.asarray(full)[~mask].any()


def test_gradient_equals_finite_differences():
    prediction, target = pair(3, (4, 6, 5))
    grad = jax.grad(lambda p: barlow_twins(p, jnp.asarray(target), redundancy=0.3)[0])(jnp.asarray(prediction))
    rng = np.random.default_rng(4)
    for _ in range(4):
        direction, h = rng.normal(size=prediction.shape), 1e-5
        ahead, behind = (oracle(prediction + s * h * direction, target, 0.3)[0] for s in (1, -1))
        np.testing.assert_allclose(
            (np.asarray(grad) * direction).sum(), (ahead - behind) / (2 * h), rtol=2e-3, atol=1e-4
        )


@pytest.mark.parametrize("pairs", [0, 1])
def test_empty_set_is_zero_and_tiny_sets_are_finite(pairs):
    prediction, target = map(jnp.asarray, pair(5, (9, 4)))
    mask = jnp.arange(9) < pairs
    (loss, metrics), grads = jax.value_and_grad(lambda p, t: barlow_twins(p, t, mask), argnums=(0, 1), has_aux=True)(
        prediction, target
    )
    assert loss == (0 if pairs == 0 else 4)  # one pair has no variance, and so no correlation
    assert not np.asarray(grads).any()
    assert all(value == (pairs if name == "pairs" else 0) for name, value in metrics.items())


def test_constant_dimension_correlates_with_nothing():
    prediction, target = pair(6, (50, 4))
    prediction[:, 2] = 1234.567
    target[:, 1] = -0.1
    loss, grads = jax.value_and_grad(lambda p, t: barlow_twins(p, t)[0], argnums=(0, 1))(
        jnp.asarray(prediction), jnp.asarray(target)
    )
    assert np.isfinite(loss)
    assert np.isfinite(np.asarray(grads)).all()
    rest = [0, 3]
    c = np.corrcoef(prediction[:, rest].T, target[:, rest].T)[:2, 2:]
    assert float(barlow_twins(jnp.asarray(prediction), jnp.asarray(target), redundancy=0.0)[0]) == pytest.approx(
        2 + ((1 - np.diag(c)) ** 2).sum(), rel=1e-3
    )


def test_unrelated_sets_give_about_the_embedding_size_and_equal_sets_about_nothing():
    a, b = (jax.random.normal(jax.random.key(i), (4000, 32)) for i in range(2))
    assert float(barlow_twins(a, b)[0]) == pytest.approx(32, rel=0.05)
    assert float(barlow_twins(a, 7.0 * a - 3.0)[0]) == pytest.approx(0, abs=1e-3)


def test_half_precision_inputs_are_computed_in_float32():
    prediction, target = (jnp.asarray(x).astype(jnp.bfloat16) for x in pair(7, (64, 8)))
    loss, metrics = barlow_twins(prediction, target)
    assert loss.dtype == metrics["diagonal"].dtype == jnp.float32
    np.testing.assert_allclose(loss, oracle(np.asarray(prediction), np.asarray(target))[0], rtol=1e-4)


def test_one_dimension():
    a = jnp.asarray([[1.0], [2.0], [4.0]])
    loss, metrics = barlow_twins(a, -a)
    assert float(loss) == pytest.approx(4)
    assert metrics["off_diagonal"] == 0


def brute_force_pairs(is_first, shift):
    """(b, t) such that no step of t+1 ... t+shift begins an episode."""
    batch, length = is_first.shape
    return [(b, t) for b in range(batch) for t in range(length - shift) if not is_first[b, t + 1 : t + shift + 1].any()]


@pytest.mark.parametrize("shift", [0, 1, 2, 5])
def test_next_embedding_takes_the_pairs_within_an_episode(shift):
    predicted, embedding = pair(8, (6, 12, 4))
    is_first = np.random.default_rng(9).random((6, 12)) < 0.2
    is_first[:2] = False
    where = brute_force_pairs(is_first, shift)
    assert 4 < len(where) <= 6 * (12 - shift)
    loss, metrics = next_embedding_loss(
        jnp.asarray(predicted), jnp.asarray(embedding), jnp.asarray(is_first), shift=shift
    )
    want = oracle(np.stack([predicted[b, t] for b, t in where]), np.stack([embedding[b, t + shift] for b, t in where]))[
        0
    ]
    np.testing.assert_allclose(loss, want, rtol=1e-4)
    assert metrics["pairs"] == len(where)
    everything = next_embedding_loss(
        jnp.asarray(predicted), jnp.asarray(embedding), jnp.asarray(is_first), shift=shift, masked=False
    )[0]
    np.testing.assert_allclose(everything, oracle(predicted[:, : 12 - shift], embedding[:, shift:])[0], rtol=1e-4)


def test_first_step_of_the_slice_may_be_first():
    """is_first[:, 0] says how t = 0 was reached, and takes no pair away."""
    predicted, embedding = map(jnp.asarray, pair(10, (3, 5, 4)))
    is_first = jnp.zeros((3, 5), bool).at[:, 0].set(True)
    assert next_embedding_loss(predicted, embedding, is_first)[1]["pairs"] == 12


def test_gradients_reach_the_prediction_alone():
    predicted, embedding = map(jnp.asarray, pair(11, (3, 6, 4)))
    is_first = jnp.zeros((3, 6), bool).at[1, 3].set(True)
    to_predicted, to_embedding = jax.grad(lambda p, e: next_embedding_loss(p, e, is_first)[0], argnums=(0, 1))(
        predicted, embedding
    )
    assert not np.asarray(to_embedding).any()
    reached = np.asarray(to_predicted).any(-1)
    expected = np.ones((3, 6), bool)
    expected[:, -1] = expected[1, 2] = False
    np.testing.assert_array_equal(reached, expected)


def test_no_extra_matrix_is_kept_for_the_off_diagonal():
    """The loss needs C and nothing else of its size."""
    size = 512
    x = jax.ShapeDtypeStruct((32, size), jnp.float32)
    memory = jax.jit(lambda p, t: barlow_twins(p, t)[0]).lower(x, x).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 1.5 * 4 * size * size


@pytest.mark.parametrize(
    ("shapes", "options", "message"),
    [
        (((2, 5, 4), (2, 5, 3), (2, 5)), {}, "embedding \\[B, T, E\\]"),
        (((2, 5, 4), (2, 5, 4), (5, 2)), {}, "is_first"),
        (((2, 5, 4), (2, 5, 4), (2, 5)), {"shift": 5}, "shift < T = 5"),
        (((2, 5, 4), (2, 5, 4), (2, 5)), {"shift": -1}, "shift"),
    ],
)
def test_wrong_shapes_are_refused(shapes, options, message):
    predicted, embedding, is_first = shapes
    with pytest.raises(ValueError, match=message):
        next_embedding_loss(jnp.zeros(predicted), jnp.zeros(embedding), jnp.zeros(is_first, bool), **options)


def test_wrong_mask_is_refused():
    with pytest.raises(ValueError, match="mask of shape"):
        barlow_twins(jnp.zeros((4, 3)), jnp.zeros((4, 3)), jnp.ones((4, 1), bool))


def test_the_samples_deviation_is_what_the_released_code_divides_by():
    """Bessel's N - 1 in the deviations, N in the correlation: equal sets correlate by 1 - 1/N."""
    rng = np.random.default_rng(8)
    p, q = rng.normal(size=(2, 6, 3))
    by_sample = lambda x: (x - x.mean(0)) / (x.std(0, ddof=1) + 1e-8)
    correlation = by_sample(p).T @ by_sample(q) / 6
    off = ~np.eye(3, dtype=bool)
    want = ((1 - np.diag(correlation)) ** 2).sum() + 0.1 * (correlation[off] ** 2).sum()
    p, q = (jnp.asarray(x, jnp.float32) for x in (p, q))
    loss, _ = barlow_twins(p, q, redundancy=0.1, sample_deviation=True)
    np.testing.assert_allclose(loss, want, rtol=1e-5)
    _, metrics = barlow_twins(p, p, sample_deviation=True)
    np.testing.assert_allclose(metrics["diagonal"], 1 - 1 / 6, rtol=1e-5)


def test_a_constant_dimension_gives_finite_numbers_by_the_samples_deviation_too():
    p, q = jnp.asarray(np.random.default_rng(9).normal(size=(2, 5, 3)), jnp.float32)
    p = p.at[:, 1].set(2.0)
    loss, grad = jax.value_and_grad(lambda x: barlow_twins(x, q, sample_deviation=True)[0])(p)
    assert np.isfinite(loss)
    assert np.isfinite(grad).all()
    assert np.abs(grad[:, [0, 2]]).max() < 10
