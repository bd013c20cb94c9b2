"""The probes' promises: they are environments, and their figures are what policies with and without the ability get."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.envs import conformance, probes

EPISODES = 256

# What is seen and what was seen first -> action; [N, 3] each.
BEST = {
    "bandit": lambda seen, first: jnp.ones((EPISODES, 1)),
    "two_steps": lambda seen, first: jnp.ones((EPISODES, 1)),
    "cue": lambda seen, first: first[:, :1],
    "cue_again": lambda seen, first: first[:, :1],
    "target": lambda seen, first: seen[:, :1],
    "echo": lambda seen, first: -jnp.sign(seen[:, :1]),
}
BLIND = {
    "bandit": lambda key: jax.random.uniform(key, (EPISODES, 1), minval=-1.0),
    "two_steps": lambda key: -jnp.ones((EPISODES, 1)),
    "cue": lambda key: jnp.ones((EPISODES, 1)),
    "cue_again": lambda key: jnp.ones((EPISODES, 1)),
    "target": lambda key: jnp.zeros((EPISODES, 1)),
    "echo": lambda key: jax.random.uniform(key, (EPISODES, 1), minval=-1.0),
}


def play(probe, policy):
    """Returns of whole episodes, [N], checking where they end."""
    step = jax.jit(jax.vmap(probe.env.step))
    state, timestep = jax.jit(jax.vmap(probe.env.reset))(jax.random.split(jax.random.key(0), EPISODES))
    first, returns = timestep.obs["vector"], jnp.zeros((EPISODES,))
    for t in range(probe.length):
        action = policy(timestep.obs["vector"], first, jax.random.fold_in(jax.random.key(1), t))
        state, timestep = step(state, action)
        returns = returns + timestep.reward
        assert bool(timestep.is_last.all()) == bool(timestep.is_last.any()) == (t == probe.length - 1)
    assert bool(timestep.is_terminal.all())
    return np.asarray(returns)


@pytest.mark.parametrize("name", probes.PROBES)
def test_a_probe_is_an_environment(name):
    conformance.check(probes.PROBES[name]().env, jax.random.key(0))


@pytest.mark.parametrize("side", [8, 16])
def test_a_picture_shows_what_the_vector_says(side):
    probe = probes.target()
    picture = probes.as_picture(probe, side).env
    assert picture.spec.observation["image"].shape == (side, side, 3)
    conformance.check(picture, jax.random.key(0))
    step = probe.env.reset(jax.random.key(0))[1], picture.reset(jax.random.key(0))[1]
    colour = np.asarray(step[1].obs["image"])
    assert (colour == colour[:1, :1]).all()
    np.testing.assert_allclose(colour[0, 0] / 127.5 - 1, step[0].obs["vector"], atol=1 / 255)


@pytest.mark.parametrize("name", probes.PROBES)
def test_the_best_policy_has_the_optimum_and_one_without_the_ability_what_is_said(name):
    probe = probes.PROBES[name]()
    assert probe.env.spec == probes.SPEC
    returns = play(probe, lambda seen, first, key: BEST[name](seen, first))
    np.testing.assert_allclose(returns, probe.optimum, atol=1e-6)
    returns = play(probe, lambda seen, first, key: BLIND[name](key))
    assert returns.mean() == pytest.approx(probe.blind, abs=0.08)


@pytest.mark.parametrize("again", [False, True])
def test_the_cue_is_gone_when_it_counts(again):
    probe = probes.cue_again(delay=4) if again else probes.cue(delay=4)
    state, timestep = probe.env.reset(jax.random.key(0))
    sign = float(timestep.obs["vector"][0])
    assert abs(sign) == 1.0
    for _ in range(4):
        state, timestep = probe.env.step(state, jnp.zeros((1,)))
        assert float(timestep.obs["vector"][0]) == 0.0
    assert float(timestep.obs["vector"][1]) == 1.0
    _, timestep = probe.env.step(state, jnp.zeros((1,)))
    assert timestep.is_last
    assert float(timestep.obs["vector"][0]) == (sign if again else 0.0)
