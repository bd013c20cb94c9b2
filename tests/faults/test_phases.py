"""A run that is saved in any phase, and goes on in a loop made anew, comes to the bits of one that never stopped."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax import loop as loops
from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.dreamer.agent import BASE_LOSS_SCALES
from ne_dreamer_jax.envs import probes
from ne_dreamer_jax.runs import checkpoint
from ne_dreamer_jax.settings import names
from tests import tiny
from tests.drqv2 import small
from tests.experiments import toy

pytestmark = pytest.mark.usefixtures("quick_compilation")

ENVS = {
    "cue": lambda: probes.cue(delay=2).env,
    "picture": lambda: probes.as_picture(probes.cue(delay=2), side=16).env,
}
METHODS = [name for name in names.METHODS if "/" not in name]
PHASES = {
    "prefill": 3,
    "the step before the first update": 10,
    "between collecting and an update": 13,
    "updates": 18,
    "the last row of the ring": 24,
    "past its end": 25,
    "past its end again": 49,
}
"""Name -> vector steps done. The ring has 24 rows, and an update comes with every second step after the tenth."""
TOTAL = 52


def agent_of(method):
    """The smallest agent of a method."""
    if method == names.DRQV2:
        return replace(small.CONFIG, batch_size=4, frame_stack=2, n_step=1)
    objective = tiny.OBJECTIVES[method]
    return replace(toy.config().agent, objective=objective, loss_scales={**BASE_LOSS_SCALES, **objective.losses})


def make(method, env):
    """A loop whose ring wraps twice."""
    config = toy.config().loop
    agent = make_agent(agent_of(method), ENVS[env]().spec)
    ratio = agent.config.batch_size * agent.config.batch_length / 4  # an update every second step of two environments
    config = replace(config, env_steps=2 * TOTAL, capacity=48, prefill=20, replay_ratio=ratio, eval_max_steps=20)
    return loops.make(config, ENVS[env](), agent, action_repeat=1)


def bits(state):
    plain = lambda x: jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return {jax.tree_util.keystr(path): np.asarray(plain(x)).tobytes() for path, x in jax.tree.leaves_with_path(state)}


def saved_and_loaded(loop, state, directory):
    """As a process that stops and one that goes on do it."""
    nothing = ()
    step = int(state.counters.vector_step)
    checkpoint.save(directory, step, {"agent": state.train, "loop": state._replace(train=nothing)})
    shapes = loop.state_shapes()
    items = checkpoint.restore(directory, {"agent": shapes.train, "loop": shapes._replace(train=nothing)}).items
    return items["loop"]._replace(train=items["agent"])


def check(method, env, directory):
    loop, steps = make(method, env), lambda n: jnp.asarray(n, jnp.int32)
    key, stops = jax.random.key(0), [0, *PHASES.values(), TOTAL]
    chunk = loop.chunk.lower(loop.init(key), steps(1)).compile()  # once, wherever the arrays come from
    straight, _ = chunk(loop.init(key), steps(TOTAL))
    assert int(straight.train.update) == loop.budget.updates == (TOTAL - 10) // 2
    wanted = bits(straight)
    stopped = loop.init(key)
    for before, after in pairwise(stops):
        stopped, _ = chunk(stopped, steps(after - before))
        if after == PHASES["updates"] and method == "ne_dreamer":
            loop.evaluate(stopped.train.params, jax.random.key(1))
        stopped = saved_and_loaded(loop, stopped, directory)
        if after == PHASES["between collecting and an update"]:
            assert int(stopped.counters.credit) > 0
            stopped = saved_and_loaded(loop, stopped, directory)  # right after a save
    got = bits(stopped)
    assert got.keys() == wanted.keys()
    assert [name for name in got if got[name] != wanted[name]] == []


@pytest.mark.strict
@pytest.mark.parametrize(
    ("method", "env"),
    [
        pytest.param(method, env, marks=() if (method, env) == ("drqv2", "cue") else pytest.mark.slow)
        for method in METHODS
        for env in ENVS
        if (method, env) != ("dreamerpro", "cue")  # which needs images
    ],
)
def test_every_phase(method, env, tmp_path):
    check(method, env, tmp_path)
