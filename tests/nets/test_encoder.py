"""Which observations are encoded how."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.nets import conv
from ne_dreamer_jax.nets.encoder import Encoder, EncoderConfig, embedding_size, split_observation
from ne_dreamer_jax.types import ArraySpec
from tests import tiny

CONFIG = EncoderConfig(depth=1, multipliers=(2, 3), kernel=3, layers=1, units=8)
PATCHES = replace(CONFIG, patch=4)
OBS = {
    "wide": ArraySpec((16, 8, 3), jnp.uint8),
    "depth": ArraySpec((16, 8, 1), jnp.uint8),
    "touch": ArraySpec((), jnp.float32),
    "speed": ArraySpec((2,), jnp.float32),
}


def observations(observation, lead, seed=0):
    rng = np.random.default_rng(seed)
    return {
        name: jnp.asarray(rng.integers(0, 256, (*lead, *s.shape)).astype(s.dtype))
        if s.dtype == jnp.uint8
        else jnp.asarray(rng.normal(0, 9, (*lead, *s.shape)).astype(np.float32))
        for name, s in observation.items()
    }


def test_observations_route_by_shape_and_dtype():
    assert split_observation(OBS) == (["depth", "wide"], ["speed", "touch"])


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (ArraySpec((8, 8, 3), jnp.float32), "expected a uint8 image .* got float32 .8, 8, 3."),
        (ArraySpec((8, 8), jnp.uint8), "got uint8 .8, 8."),
        (ArraySpec((4,), jnp.int32), "or a float32 vector .* got int32 .4."),
    ],
)
def test_what_is_neither_image_nor_vector_is_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        split_observation({"odd": spec})


def test_no_observation_is_refused():
    with pytest.raises(ValueError, match="at least one observation"):
        split_observation({})


@pytest.mark.parametrize(
    ("config", "shapes", "message"),
    [
        (CONFIG, [(10, 8, 3)], r"multiples of 4 = 2\*\*2, got .*change encoder.multipliers or encoder.patch"),
        (PATCHES, [(8, 12, 3)], r"multiples of 8 = 4 \* 2\*\*1, got"),
        (CONFIG, [(8, 8, 3), (16, 16, 3)], r"one common height and width, got .*Resize them in the environment\.$"),
    ],
)
def test_images_that_do_not_halve_or_agree_are_refused(config, shapes, message):
    with pytest.raises(ValueError, match=message):
        embedding_size(config, {f"image{i}": ArraySpec(s, jnp.uint8) for i, s in enumerate(shapes)})


@pytest.mark.parametrize("config", [CONFIG, PATCHES, replace(PATCHES, multipliers=(2,))])
@pytest.mark.parametrize("names", [["wide", "depth", "touch", "speed"], ["wide"], ["touch"], ["speed", "touch"]])
def test_the_embedding_has_the_size_that_is_announced(names, config):
    observation = {name: OBS[name] for name in names}
    encoder = Encoder(config, observation)
    obs = observations(observation, (2, 3))
    got = jax.eval_shape(lambda: encoder.init_with_output(jax.random.key(0), obs)[0])
    assert got.shape == (2, 3, embedding_size(config, observation))
    assert got.dtype == jnp.float32


@pytest.mark.usefixtures("quick_compilation")
@pytest.mark.parametrize("config", [CONFIG, PATCHES])
def test_every_row_and_every_observation_counts_and_leading_axes_do_not(config):
    encoder = Encoder(config, OBS)
    obs = observations(OBS, (2, 3))
    params = tiny.fill(jax.eval_shape(encoder.init, jax.random.key(0), obs))
    encode = jax.jit(encoder.apply)
    got = np.asarray(encode(params, obs))
    flat = {name: x.reshape(6, *x.shape[2:]) for name, x in obs.items()}
    np.testing.assert_allclose(np.asarray(encode(params, flat)).reshape(got.shape), got, atol=1e-6)
    for name in OBS:
        other = np.asarray(encode(params, {**obs, name: obs[name].at[1, 2].set(7)}))
        changed = np.any(other != got, axis=-1)
        assert changed[1, 2]
        assert changed.sum() == 1


@pytest.mark.usefixtures("quick_compilation")
@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float32, 1e-5), (jnp.bfloat16, 0.1)])
def test_patches_come_before_the_convolutions(dtype, tolerance):
    """Embedding and gradient, with the kernel that a CPU has a lowering for, beside XLA's own convolutions."""
    observation = {"wide": OBS["wide"]}
    encoder = Encoder(replace(PATCHES, kernel=5), observation, dtype)
    obs = observations(observation, (6,))
    params = tiny.fill(jax.eval_shape(encoder.init, jax.random.key(0), obs))["params"]

    def reference(params):
        stage = lambda i: conv.Stage(*(params[f"stage{i}_{part}"] for part in ("kernel", "bias", "scale")))
        x = conv.embed_patches(obs["wide"], stage(0))
        return conv.lax_encode_images(x, [stage(1)]).reshape(6, -1)

    encode = lambda params: encoder.apply({"params": params}, obs)
    for function in (lambda f: f, lambda f: jax.grad(lambda params: jnp.sum(jnp.sin(f(params))))):
        got, wanted = (jax.jit(function(f))(params) for f in (encode, reference))
        close = lambda a, b: np.testing.assert_allclose(a, b, atol=tolerance * np.abs(b).max())
        jax.tree.map(close, got, wanted)


def test_vectors_pass_a_symlog():
    observation = {"speed": OBS["speed"]}
    encoder = Encoder(EncoderConfig(layers=1, units=4), observation)
    x = np.asarray([[1e6, -3.0]], np.float32)
    params = tiny.fill(jax.eval_shape(encoder.init, jax.random.key(0), {"speed": x}))["params"]
    y = np.sign(x) * np.log1p(np.abs(x.astype(np.float64)))
    block = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params["mlp"]["block0"])
    y = y @ block["linear"]["kernel"] + block["linear"]["bias"]
    y = y / np.sqrt(np.mean(y**2, -1, keepdims=True) + 1e-4) * block["norm"]["scale"]
    got = encoder.apply({"params": params}, {"speed": jnp.asarray(x)})
    np.testing.assert_allclose(got, y / (1 + np.exp(-y)), rtol=1e-4, atol=1e-5)
