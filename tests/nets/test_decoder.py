"""The decoder mirrors the encoder: shapes, names and ranges of what it decodes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.nets.decoder import Decoder, spread_blocks
from ne_dreamer_jax.types import ArraySpec
from tests import tiny

pytestmark = pytest.mark.usefixtures("quick_compilation")

OBSERVATION = {
    "front": ArraySpec((8, 12, 3), jnp.uint8),
    "depth": ArraySpec((8, 12, 1), jnp.uint8),
    "speed": ArraySpec((), jnp.float32),
    "joints": ArraySpec((3,), jnp.float32),
}
ENCODER = replace(tiny.CONFIG.encoder, depth=2, multipliers=(2, 4))
PATCHES = replace(ENCODER, patch=2)


def make(observation, blocks=4, dtype=jnp.float32, encoder=ENCODER):
    decoder = Decoder(encoder, observation, blocks, dtype)
    return decoder, tiny.fill(jax.eval_shape(decoder.init, jax.random.key(0), tiny.latent((1,))))


@pytest.mark.parametrize("encoder", [ENCODER, PATCHES])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_every_observation_is_decoded_in_its_shape(dtype, encoder):
    decoder, params = make(OBSERVATION, dtype=dtype, encoder=encoder)
    decoded = jax.jit(decoder.apply)(params, tiny.latent((2, 5)))
    shapes = {name: (2, 5, *(spec.shape or (1,))) for name, spec in OBSERVATION.items()}
    assert {name: x.shape for name, x in decoded.items()} == shapes
    assert {x.dtype for x in decoded.values()} == {jnp.dtype(jnp.float32)}
    for name in ("front", "depth"):
        assert 0 < decoded[name].min() < decoded[name].max() < 1
    assert np.abs(decoded["joints"]).max() > 1  # unbounded


def test_each_patch_is_decoded_from_a_place_of_its_own():
    decoder, params = make({"front": OBSERVATION["front"]}, encoder=PATCHES)
    last = lambda module, _: module.name == "stage0"
    decoded, kept = decoder.apply(params, tiny.latent((1,)), capture_intermediates=last, mutable="intermediates")
    cells = np.asarray(kept["intermediates"]["stage0"]["__call__"][0])[0]
    assert cells.shape == (4, 6, 2 * 2 * 3)
    for row, column in np.ndindex(8, 12):
        cell = cells[row // 2, column // 2].reshape(2, 2, 3)
        pixel = 1 / (1 + np.exp(-cell[row % 2, column % 2]))
        np.testing.assert_allclose(decoded["front"][0, row, column], pixel, rtol=1e-5)


def test_a_latent_is_decoded_by_itself():
    decoder, params = make(OBSERVATION)
    latent = tiny.latent((3, 4))
    decode = jax.jit(decoder.apply)
    whole = decode(params, latent)
    one = decode(params, jax.tree.map(lambda x: x[1, 2], latent))
    for name, x in one.items():
        np.testing.assert_allclose(x, whole[name][1, 2], rtol=1e-4, atol=1e-5)


def test_what_is_not_observed_has_no_parameters():
    _, images = make({"front": OBSERVATION["front"]})
    _, vectors = make({"joints": OBSERVATION["joints"]})
    assert not {"mlp", "vectors"} & set(images["params"])
    assert set(vectors["params"]) == {"mlp", "vectors"}


def test_each_block_fills_channels_of_its_own():
    block = np.arange(3, dtype=np.float32)[None, :, None]
    place = np.arange(2 * 5, dtype=np.float32).repeat(4)[None, None]  # four channels of a pixel lie together
    maps = spread_blocks(jnp.asarray(np.broadcast_to(100 * block + place, (1, 3, 40))), 2, 5)
    want = 100 * np.arange(3).repeat(4) + np.arange(10).reshape(2, 5, 1)
    np.testing.assert_array_equal(maps[0], want)


def test_blocks_that_do_not_divide_the_sizes_are_refused():
    with pytest.raises(
        ValueError, match=r"objective.blocks: expected a divisor of rssm.deter 32 .* 8 channels .* got 3"
    ):
        make({"front": OBSERVATION["front"]}, blocks=3)
