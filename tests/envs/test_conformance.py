"""Findings: each broken promise is named, with its place, what was expected and what was got. And nothing else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.envs import base, conformance
from ne_dreamer_jax.types import ArraySpec, ContinuousAction, DiscreteAction, EnvSpec

pytestmark = pytest.mark.usefixtures("quick_compilation")

SPEC = EnvSpec({"image": ArraySpec((4, 4, 1), jnp.uint8), "speed": ArraySpec((2,), jnp.float32)}, ContinuousAction(1))


def make(core_spec=SPEC, **changes):
    """A walk by the action that ends after 4 steps, with fields of its environment replaced."""

    def reset(key):
        return {"place": jax.random.uniform(key), "time": jnp.zeros((), jnp.int32)}

    def step(state, action):
        state = {"place": state["place"] + action.reshape(-1)[0].astype(jnp.float32), "time": state["time"] + 1}
        last = state["time"] >= 4
        return state, base.Progress(state["place"], last, last, jnp.ones((), bool))

    def observe(state):
        image = jnp.full((4, 4, 1), state["time"].astype(jnp.uint8))
        return {"image": image, "speed": jnp.stack([state["place"]] * 2)}

    env = base.from_core(base.Core(core_spec, reset, base.restart_or_step(reset, step), observe))
    return env._replace(**{name: change(env) for name, change in changes.items()})


def find(env):
    found = conformance.findings(env, jax.random.key(0), beginning_steps=6, echo=lambda line: None)
    return [str(finding) for finding in found]


def seeing(change):
    """The environment's step with another time step."""
    return lambda env: lambda state, action: (lambda pair: (pair[0], change(pair[1])))(env.step(state, action))


def of(obs, **changes):
    return {**obs, **changes}


@pytest.mark.parametrize("action", [ContinuousAction(1), DiscreteAction(3)])
def test_there_is_nothing_to_find_where_nothing_is_wrong(action):
    assert find(make(SPEC._replace(action=action))) == []


CASES = {
    "a dtype": (
        {"step": seeing(lambda t: t._replace(obs=of(t.obs, image=t.obs["image"].astype(jnp.float32))))},
        ["step: obs['image']: dtype: expected uint8, got float32"],
    ),
    "a shape": (
        {"step": seeing(lambda t: t._replace(obs=of(t.obs, speed=t.obs["speed"][:1])))},
        ["step: obs['speed']: shape: expected [2], got [1]"],
    ),
    "a missing key": (
        {"step": seeing(lambda t: t._replace(obs={"speed": t.obs["speed"]}))},
        ["step: obs: key: expected names ['image', 'speed'], got ['speed']"],
    ),
    "a key too many": (
        {"observe": lambda env: lambda state: of(env.observe(state), extra=jnp.zeros(()))},
        ["observe: obs: key: expected names ['image', 'speed'], got ['extra', 'image', 'speed']"],
    ),
    "a reward": (
        {"step": seeing(lambda t: t._replace(reward=t.reward.astype(jnp.float16)))},
        ["step: reward: dtype: expected float32, got float16"],
    ),
    "several at once": (
        {"step": seeing(lambda t: t._replace(reward=t.reward[None], is_last=t.is_last.astype(jnp.int32)))},
        ["step: reward: shape: expected [], got [1]", "step: is_last: dtype: expected bool, got int32"],
    ),
    "a spec": (
        {"spec": lambda env: SPEC._replace(observation=of(SPEC.observation, speed=ArraySpec((2,), jnp.float16)))},
        ["spec.observation['speed']: dtype: expected uint8[height,width,channels] or float32[size] or float32[]"],
    ),
    "a state's dtype": (
        {
            "step": lambda env: (
                lambda s, a: (lambda p: (p[0]._replace(faults=p[0].faults.astype(jnp.float32)), p[1]))(env.step(s, a))
            )
        },
        ["step: state.faults: dtype: expected int32, got float32"],
    ),
    "a state's fields": (
        {"prepare": lambda env: lambda key: env.prepare(key)._replace(core={})},
        ["prepare: state: key: expected the fields of reset's, got without [\".core['place']\", \".core['time']\"]"],
    ),
    "an error": (
        {"step": lambda env: lambda state, action: env.step(state, action[:0])},
        ["reset or step: error: expected functions that can be traced, got ValueError: action: expected float32[1]"],
    ),
    "no number": (
        {"step": seeing(lambda t: t._replace(reward=jnp.where(t.is_first, 0.0, jnp.nan)))},
        ["reward: bound: expected finite numbers, got nan at step 1"],
    ),
    "a reward at reset": (
        {"step": seeing(lambda t: t._replace(reward=t.reward + 1.0))},
        ["reward: bound: expected 0 where an episode starts"],
    ),
    "a terminal flag": (
        {"step": seeing(lambda t: t._replace(is_terminal=~t.is_last))},
        ["is_terminal: flag: expected is_last wherever it is set, got it alone at step 1"],
    ),
    "a first flag": (
        {"step": seeing(lambda t: t._replace(is_first=~t.is_first))},
        ["is_first: flag: expected True right after is_last and nowhere else, got [ True  True] at step 1"],
    ),
    "an observation": (
        {"observe": lambda env: lambda state: of(env.observe(state), speed=env.observe(state)["speed"] + 1.0)},
        ["observe['speed']: determinism: expected the same bits: observe of the returned state, got 4 of 4 numbers"],
    ),
    "a beginning": (
        {"prepare": lambda env: lambda key: env.prepare(key)._replace(key=jax.random.fold_in(key, 1))},
        ["prepare and step.obs['speed']: determinism: expected the same bits: an episode begun by prepare and step"],
    ),
    "an old key": (
        {"step": lambda env: lambda s, a: (lambda p: (p[0]._replace(key=s.key), p[1]))(env.step(s, a))},
        ["state.key: determinism: expected a restart to move on to a new key, got the key of the episode before"],
    ),
    "an action's bound": (
        {
            "step": lambda env: (
                lambda s, a: (
                    lambda p: (p[0], p[1]._replace(reward=jnp.where(p[1].is_first, 0.0, p[1].reward + a[0])))
                )(env.step(s, a))
            )
        },
        ["action: bound: expected an action out of bounds to act as the bound, got another state or time step"],
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_named(case):
    changes, expected = CASES[case]
    found = find(make(**changes))
    for start in expected:
        assert any(finding.startswith(start) for finding in found), found
    with pytest.raises(AssertionError) as caught:
        conformance.check(make(**changes), jax.random.key(0), beginning_steps=6, echo=lambda line: None)
    assert str(caught.value) == "\n".join(found)


def test_randomness_of_ones_own_is_found():
    """Numbers from outside of the state differ between two calls with the same arguments."""
    calls = []

    def noise():
        calls.append(0)
        return np.float32(len(calls))

    def noisy_step(env):
        def noisy(state, action):
            state, timestep = env.step(state, action)
            shape = jax.ShapeDtypeStruct((), jnp.float32)
            drawn = jax.pure_callback(noise, shape, vmap_method="sequential")
            return state, timestep._replace(obs=of(timestep.obs, speed=timestep.obs["speed"] + drawn))

        return noisy

    found = find(make(step=noisy_step))
    assert any(
        line.startswith("step[1].obs['speed']: determinism: expected the same bits: step with") for line in found
    )
