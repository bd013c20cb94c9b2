"""DreamerV3's objective: which observation is decoded from which state, and by what measure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.losses import symlog
from ne_dreamer_jax.nets.decoder import Decoder
from ne_dreamer_jax.objectives import Reconstruction
from ne_dreamer_jax.types import Rollout
from tests import tiny

pytestmark = pytest.mark.usefixtures("quick_compilation")

CONFIG = Reconstruction(blocks=1)


@pytest.fixture(scope="module")
def made():
    nets = tiny.networks()
    objective = CONFIG.build(tiny.model(nets))
    params = {"objective": tiny.fill(jax.eval_shape(objective.init, jax.random.key(0)))}
    decoder = Decoder(nets.encoder.config, nets.spec.observation, CONFIG.blocks)

    def loss(params, latent, batch):
        rollout = Rollout(batch, None, latent, None, None, None)  # nothing else may be read
        return objective.loss(params, {}, jax.random.key(0), rollout)

    return params, jax.jit(loss), decoder


def test_the_loss_is_the_squared_error_of_each_steps_own_observation(made):
    params, loss, decoder = made
    batch, latent = tiny.batch(), tiny.latent((2, 5))
    losses, metrics = loss(params, latent, batch)
    assert tuple(losses) == tuple(CONFIG.losses) == ("reconstruction",)
    decoded = decoder.apply({"params": params["objective"]}, latent)
    image = np.square(np.asarray(decoded["image"]) - np.asarray(batch.obs["image"]) / 255).sum((2, 3, 4))
    vector = np.square(np.asarray(decoded["vector"]) - np.asarray(symlog(batch.obs["vector"]))).sum(2)
    np.testing.assert_allclose(losses["reconstruction"], (image + vector).mean(), rtol=1e-5)
    np.testing.assert_allclose(metrics["reconstruction/image"], image.mean(), rtol=1e-5)
    np.testing.assert_allclose(metrics["reconstruction/vector"], vector.mean(), rtol=1e-5)


def test_an_observation_pulls_at_the_state_of_its_own_step_alone(made):
    params, loss, _ = made
    batch, latent = tiny.batch(), tiny.latent((2, 5))
    pull = jax.jit(
        jax.grad(lambda deter, batch: loss(params, latent._replace(deter=deter), batch)[0]["reconstruction"])
    )
    before = pull(latent.deter, batch)
    assert np.all(np.any(before, axis=-1))
    image = batch.obs["image"]
    changed = batch._replace(obs={**batch.obs, "image": image.at[1, 3].set(255 - image[1, 3])})
    moved = np.any(np.asarray(pull(latent.deter, changed) != before), axis=-1)
    assert np.argwhere(moved).tolist() == [[1, 3]]


def test_gradients_reach_every_parameter_and_there_is_no_target(made):
    params, loss, _ = made
    objective = CONFIG.build(tiny.model(tiny.networks()))
    gradient = jax.jit(jax.grad(lambda p: loss(p, tiny.latent((2, 5)), tiny.batch())[0]["reconstruction"]))(params)
    for path, x in jax.tree.leaves_with_path(gradient):
        assert np.any(x), jax.tree_util.keystr(path)
        assert jnp.isfinite(x).all()
    assert objective.init_target(params) == {}
