"""A world model from inside: what it says is what training and acting use."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.nets.rssm import feature
from ne_dreamer_jax.types import ContinuousAction, EnvSpec, Latent, TimeStep
from tests import tiny

pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.fixture(scope="module", params=[tiny.VECTORS, tiny.DISCRETE], ids=["continuous", "discrete"])
def made(request):
    agent = make_agent(tiny.CONFIG, request.param)
    state = agent.init(jax.random.key(0))
    return agent, state


def test_the_posterior_along_a_batch_is_what_the_update_writes_back(made):
    agent, _ = made
    state = agent.init(jax.random.key(0))
    batch = tiny.batch(agent.spec)
    observe_key = jax.random.split(jax.random.split(state.key)[1], 3)[0]  # as in an update
    rollout = agent.posterior(state.params, observe_key, batch)
    _, latents, _ = agent.train_step(state, batch)
    np.testing.assert_allclose(rollout.latent.deter, latents.deter, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(rollout.latent.stoch.argmax(-1), latents.stoch.argmax(-1))


def test_imagination_starts_where_it_is_told_and_its_heads_judge_its_features(made):
    agent, state = made
    rollout = agent.posterior(state.params, jax.random.key(1), tiny.batch(agent.spec))
    start = Latent(rollout.latent.deter[:, 0], rollout.latent.stoch[:, 0])
    imagined = agent.imagine(state.params, jax.random.key(2), start, 4)
    assert imagined.feature.shape == (5, 2, rollout.feature.shape[-1])
    assert imagined.action.shape == (4, 2, *agent.spec.action.shape)
    assert imagined.action.dtype == agent.spec.action.dtype
    np.testing.assert_allclose(imagined.feature[0], rollout.feature[:, 0], rtol=1e-6)
    heads = agent.heads(state.params, imagined.feature)
    for name, value, seen in zip(heads._fields, heads, imagined.heads, strict=True):
        np.testing.assert_allclose(value, seen, rtol=1e-4, atol=1e-5, err_msg=name)
    assert ((heads.discount > 0) & (heads.discount < 1)).all()
    np.testing.assert_array_equal(heads.reward, jnp.zeros((5, 2)))  # a fresh head's


def test_an_open_loop_with_the_policys_actions_is_what_was_imagined(made):
    agent, state = made
    start = jax.tree.map(
        lambda x: x[:, 0], agent.posterior(state.params, jax.random.key(1), tiny.batch(agent.spec)).latent
    )
    imagined = agent.imagine(state.params, jax.random.key(2), start, 4)
    latents = agent.open_loop(state.params, jax.random.key(2), start, imagined.action)
    np.testing.assert_allclose(feature(latents), imagined.feature[1:], rtol=1e-5, atol=1e-6)
    others = agent.open_loop(state.params, jax.random.key(2), start, imagined.action[::-1])
    assert not np.allclose(others.deter, latents.deter)


def test_the_mode_of_the_heads_is_the_action_of_acting(made):
    agent, state = made
    batch = jax.tree.map(lambda x: x[:, 0], tiny.batch(agent.spec)._replace(context=None))
    timestep = TimeStep(batch.obs, batch.reward, batch.is_first, batch.is_last, batch.is_terminal)
    policy, action = agent.act(state.params, agent.init_policy(2), timestep, jax.random.key(3), mode="mode")
    feature = jnp.concatenate([policy.latent.stoch.reshape(2, -1), policy.latent.deter], -1)
    np.testing.assert_allclose(agent.heads(state.params, feature).action, action, rtol=1e-4, atol=1e-5)


def test_an_agent_without_a_world_model_says_so():
    spec = EnvSpec(tiny.VECTORS.observation, ContinuousAction(2))
    agent = make_agent(DrQv2Config(), spec)
    assert agent.inspection is None
    with pytest.raises(AttributeError, match="expected an agent with a world model, got drqv2"):
        agent.imagine(None, jax.random.key(0), None, 3)
