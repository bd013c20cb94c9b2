"""Environments in the styles of other libraries, small enough that all of what they do is known.

A walker starts at 0 and is moved by its action; at ``GOAL`` or beyond, an episode is over by itself; after ``LIMIT``
steps it is cut. Like the libraries, they mix dtypes, and begin with Python numbers.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

GOAL, LIMIT = 3, 5


def dataclass(kind: Any) -> Any:
    """A dataclass that is a pytree, with ``replace``, as flax's and chex's are."""
    kind = dataclasses.dataclass(frozen=True)(kind)
    kind.replace = dataclasses.replace
    names = [field.name for field in dataclasses.fields(kind)]
    return jax.tree_util.register_dataclass(kind, data_fields=names, meta_fields=[])


@dataclass
class Walk:
    """State of the gymnax-style walker."""

    place: Any
    time: Any
    seen: Any  # a number out of the last key


@dataclass
class Params:
    """Its parameters."""

    max_steps_in_episode: int = LIMIT
    stride: float = 1.0


@dataclass
class NoLimit:
    """Parameters without a time limit."""

    stride: float = 1.0


class Space(NamedTuple):
    """A box."""

    low: Any
    high: Any
    shape: tuple[int, ...]
    dtype: Any


class Choice(NamedTuple):
    """A discrete space."""

    n: int


class Gymnax:
    """Its action is the size of the step, 0 or 1 (or, where ``continuous``, in [-1, 3])."""

    def __init__(self, continuous: bool = False) -> None:
        self.continuous = continuous

    default_params = Params()

    def reset_env(self, key: Any, params: Any) -> Any:
        state = Walk(0, 0, jax.random.uniform(key))
        return self.get_obs(state), state

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
        size = action[0] if self.continuous else action
        state = Walk(state.place + size * params.stride, state.time + 1, jax.random.uniform(key))
        return self.get_obs(state), state, state.place * jnp.int32(2), self.is_terminal(state, params), {}

    def step(self, *args: Any) -> Any:
        raise AssertionError("the auto-resetting step loses the last observation")

    reset = step

    def get_obs(self, state: Any) -> Any:
        return jnp.stack([state.place * 1.0, state.time * 1.0, state.seen])

    def is_terminal(self, state: Any, params: Any) -> Any:
        return (state.place >= GOAL) | (state.time >= params.max_steps_in_episode)

    def action_space(self, params: Any) -> Any:
        return Space(jnp.float32(-1.0), jnp.array([3.0]), (1,), jnp.float32) if self.continuous else Choice(2)

    def observation_space(self, params: Any) -> Any:
        return Space(-jnp.inf, jnp.inf, (3,), jnp.float32)


class Gymnax1(Gymnax):
    """As of gymnax 1.0: a time limit is no end by itself."""

    def is_terminal(self, state: Any, params: Any) -> Any:
        return state.place >= GOAL

    def is_truncated(self, state: Any, params: Any) -> Any:
        return state.time >= params.max_steps_in_episode


class Informing(Gymnax):
    """It tells of the time limit, which it keeps to itself, in its info, and calls every end terminated."""

    default_params = NoLimit()

    def is_terminal(self, state: Any, params: Any) -> Any:
        return (state.place >= GOAL) | (state.time >= LIMIT)

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
        obs, state, reward, done, _ = super().step_env(key, state, action, params)
        return obs, state, reward, done, {"terminated": done, "truncated": state.time >= LIMIT}


class Endless(Gymnax):
    """No time limit that anything tells of."""

    default_params = NoLimit()

    def is_terminal(self, state: Any, params: Any) -> Any:
        return state.place >= GOAL


@dataclass
class BraxState:
    """State of the Brax-style walker."""

    place: Any
    obs: Any
    reward: Any
    done: Any
    metrics: Any
    info: Any


class Brax:
    """Its action, in [-1, 1], is the size of the step."""

    action_size = 1

    def reset(self, rng: Any) -> Any:
        place = jax.random.uniform(rng, maxval=0.5)
        return BraxState(place, self.see(place), jnp.zeros(()), jnp.zeros(()), {"place": place}, {"rng": rng})

    def step(self, state: Any, action: Any) -> Any:
        place = state.place + action[0]
        done = jnp.where(place >= GOAL, 1.0, 0.0)
        return state.replace(place=place, obs=self.see(place), reward=1.0 * place, done=done, metrics={"place": place})

    def see(self, place: Any) -> Any:
        return {"position": place[None], "double": jnp.stack([place, place]) * 2}


class GridTimeStep(NamedTuple):
    """A ``dm_env``-like time step."""

    state: Any
    step_type: Any
    reward: Any
    discount: Any
    observation: Any


class Grid:
    """XLand-MiniGrid's style: a walker on a line, of which it sees [2, 2] fields."""

    def num_actions(self, params: Any) -> int:
        return 2

    def reset(self, params: Any, key: Any) -> Any:
        state = {"key": key, "place": jax.random.randint(key, (), 0, 2), "time": 0}
        return GridTimeStep(state, jnp.uint8(0), jnp.asarray(0.0), jnp.asarray(1.0), self.see(state))

    def step(self, params: Any, timestep: Any, action: Any) -> Any:
        old = timestep.state
        state = {**old, "place": old["place"] + action.astype(jnp.uint8), "time": old["time"] + 1}
        terminated = state["place"] >= GOAL
        last = terminated | (state["time"] == params.max_steps_in_episode)
        discount = jnp.where(terminated, 0.0, 1.0)
        kind = jnp.where(last, 2, 1).astype(jnp.uint8)
        return GridTimeStep(state, kind, jnp.where(terminated, 1.0, 0.0), discount, self.see(state))

    def see(self, state: Any) -> Any:
        symbols = jnp.zeros((2, 2, 2), jnp.uint8)
        return symbols.at[0, 0, 0].set(state["place"].astype(jnp.uint8)).at[1, 1, 1].set(2)
