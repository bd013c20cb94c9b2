"""Transitions cut from replayed sequences: returns, discounts, frame stacks, shifts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.agents.drqv2.learner import push
from ne_dreamer_jax.agents.drqv2.transitions import crop, n_step, random_shift
from ne_dreamer_jax.types import Batch
from tests.drqv2.small import nothing

GAMMA = 0.9


def sequences(rows, stack, n, seed=0):
    """Sequences whose observation says (episode, t), with ends anywhere, some of them terminal."""
    rng = np.random.default_rng(seed)
    length = stack + n
    is_last = rng.random((rows, length)) < 0.3
    is_last[0] = False
    before = rng.random(rows) < 0.3  # whether the step before the sequence was an episode's last
    is_first = np.concatenate([before[:, None], is_last[:, :-1]], axis=1)
    is_last &= ~is_first  # an episode has at least two steps
    is_first[:, 1:] = is_last[:, :-1]
    is_terminal = is_last & (rng.random((rows, length)) < 0.5)
    episode = np.cumsum(is_first, axis=1)
    t = np.zeros((rows, length))
    for i in range(length):
        t[:, i] = np.where(is_first[:, i], 0, (t[:, i - 1] if i else rng.integers(1, 50, rows)) + 1)
    obs = np.stack([episode, t], axis=-1).astype(np.float32)
    action = rng.uniform(-1, 1, (rows, length, 2)).astype(np.float32)
    reward = np.where(is_first, 0, rng.normal(size=(rows, length))).astype(np.float32)
    index = np.arange(rows * length, dtype=np.int32).reshape(rows, length)
    batch = Batch({"x": obs}, action, action, reward, is_first, is_last, is_terminal, nothing(rows), index)
    return jax.tree.map(jnp.asarray, batch)


def by_hand(batch, row, stack, n):
    """Reward, discount, step bootstrapped from and validity, step by step."""
    at = t = stack - 1
    if batch.is_last[row, t]:
        return 0.0, 1.0, t, False
    reward, discount = 0.0, 1.0
    for _ in range(n):
        at += 1
        reward += discount * float(batch.reward[row, at])
        discount *= GAMMA * (1.0 - float(batch.is_terminal[row, at]))
        if batch.is_last[row, at]:
            break
    return reward, discount, at, True


@pytest.mark.parametrize(("stack", "n"), [(3, 3), (3, 1), (1, 4), (4, 2), (1, 1)])
def test_returns_discounts_and_stacks_are_what_walking_through_the_episode_gives(stack, n):
    batch = sequences(200, stack, n)
    data, batch = jax.device_get((jax.jit(n_step, static_argnums=(1, 2))(batch, stack, GAMMA), batch))
    seen = set()
    for row in range(200):
        reward, discount, at, valid = by_hand(batch, row, stack, n)
        assert data.valid[row] == valid
        np.testing.assert_allclose(data.reward[row], reward, rtol=1e-5, atol=1e-6)
        if valid:
            np.testing.assert_allclose(data.discount[row], discount, rtol=1e-6)
            seen.add((at - stack + 1, discount == 0.0))
        np.testing.assert_array_equal(data.action[row], batch.action[row, stack - 1])
        for frames, newest in ((data.obs["x"][row], stack - 1), (data.next_obs["x"][row], at)):
            episode, t = batch.obs["x"][row, newest]
            np.testing.assert_array_equal(frames[:, 0], episode)  # no frame of an earlier episode
            np.testing.assert_array_equal(frames[:, 1], np.maximum(t + np.arange(1 - stack, 1), 0))
    assert seen == {(m, terminal) for m in range(1, n + 1) for terminal in (False, True)}


def test_invalid_steps_have_no_share_in_a_window_without_ends():
    data = n_step(sequences(1, 3, 3), 3, GAMMA)
    assert bool(data.valid.all())
    np.testing.assert_allclose(data.discount, GAMMA**3, rtol=1e-6)


def test_acting_stacks_frames_as_learning_does():
    stack, n = 3, 3
    batch = sequences(100, stack, n, seed=1)
    first = batch.is_first.at[:, 0].set(True)  # both see no more than the sequence
    batch = batch._replace(is_first=first)
    stacked = jnp.zeros((100, stack, 2))
    history = []
    for i in range(stack + n):
        stacked = push(stacked, batch.obs["x"][:, i], batch.is_first[:, i])
        history.append(np.asarray(stacked))
    np.testing.assert_array_equal(n_step(batch, stack, GAMMA).obs["x"], history[stack - 1])


def grid_sample(image, offset, pad):
    """Bilinear sampling of the padded image at the points of a grid in [-1, 1], one pixel after the other."""
    padded = np.pad(image.astype(np.float64), ((pad, pad), (pad, pad), (0, 0)), mode="edge")
    sides = padded.shape[:2]
    out = np.zeros(image.shape)
    for i, j in np.ndindex(*image.shape[:2]):
        point = []
        for k, side, by in zip((i, j), sides, offset, strict=True):
            grid = -1 + 1 / side + k * (2 - 2 / side) / (side - 1) + by * 2 / side  # in units of half the side
            point.append(((grid + 1) * side - 1) / 2)
        y, x = point
        y0, x0 = int(np.floor(y + 1e-9)), int(np.floor(x + 1e-9))
        for dy, dx in np.ndindex(2, 2):
            weight = (1 - abs(y - y0 - dy)) * (1 - abs(x - x0 - dx))
            if weight > 1e-9:
                out[i, j] += weight * padded[y0 + dy, x0 + dx]
    return out


def test_a_crop_is_bilinear_sampling_at_whole_pixels():
    rng = np.random.default_rng(0)
    pad = 4
    images = rng.integers(0, 256, (12, 2, 9, 9, 3)).astype(np.uint8)
    offset = rng.integers(0, 2 * pad + 1, (12, 2)).astype(np.int32)
    offset[:3] = [[0, 0], [2 * pad, 0], [pad, 2 * pad]]
    got = crop(jnp.asarray(images), jnp.asarray(offset), pad)
    assert got.dtype == jnp.uint8
    for row, (y, x) in enumerate(offset):
        for frame in range(2):
            want = grid_sample(images[row, frame], (y, x), pad)
            np.testing.assert_allclose(got[row, frame], want, atol=1e-6)


def test_no_shift_is_the_identity():
    images = jnp.asarray(np.random.default_rng(0).integers(0, 256, (4, 3, 8, 8, 3)).astype(np.uint8))
    np.testing.assert_array_equal(crop(images, jnp.full((4, 2), 4, jnp.int32), 4), images)
    np.testing.assert_array_equal(random_shift(jax.random.key(0), {"image": images}, 0)["image"], images)


def test_shifts_move_whole_stacks_by_every_distance_and_leave_vectors_alone():
    count, pad, side = 400, 2, 9
    image = np.zeros((count, 3, side, side, 1), np.uint8)
    image[:, :, side // 2, side // 2] = 255
    stacked = {"image": jnp.asarray(image), "vector": jnp.ones((count, 3, 2))}
    moved = random_shift(jax.random.key(0), stacked, pad)
    np.testing.assert_array_equal(moved["vector"], stacked["vector"])
    where = np.argwhere(np.asarray(moved["image"])[..., 0] == 255)  # [count * 3] of (row, frame, y, x)
    assert len(where) == 3 * count
    y, x = where[:, 2].reshape(count, 3), where[:, 3].reshape(count, 3)
    assert (y == y[:, :1]).all()
    assert (x == x[:, :1]).all()
    by = {(int(a), int(b)) for a, b in zip(y[:, 0] - side // 2, x[:, 0] - side // 2, strict=True)}
    assert by == {(a, b) for a in range(-pad, pad + 1) for b in range(-pad, pad + 1)}
