"""Measures of what an agent knows, on episodes that were played: linear probes, open loops, the critic, the policy.

Steps are ``[steps, M, ...]``: an action is taken from the observation of its step, a reward received on arrival there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.loop.play import Steps
from ne_dreamer_jax.losses import lambda_returns
from ne_dreamer_jax.nets.rssm import feature
from ne_dreamer_jax.types import Array, Latent

RIDGE = 0.01
"""Of a probe, in shares of a standardised feature's sum of squares."""
SATURATED = 0.95
"""Beyond this a component of the policy's mode counts as at the end of tanh, whose slope is below a tenth there."""
STARTS = 512
"""Open loops, at most."""
IMAGINED = 256
"""States from which returns are imagined, at most."""
BOOTSTRAPPED = 0.3
"""A return counts as one that came where the critic's own value, at a time limit, has at most this weight in it."""


def halves(steps: Steps) -> tuple[Steps, Steps]:
    """The episodes [steps, M, ...] with even numbers, and those with odd ones."""
    half = lambda first: jax.tree.map(lambda x: np.asarray(x)[:, first::2], steps)
    return half(0), half(1)


def features(steps: Steps) -> np.ndarray:
    """The models' features [N, F] of all steps that count."""
    return np.asarray(feature(steps.latent))[steps.counts]


def side_by_side(obs: Mapping[str, Any], vectors: Sequence[str]) -> tuple[list[str], np.ndarray]:
    """Names of the components of these ``vectors`` or numbers, and all of them in one array [steps, M, n]."""
    names, columns = [], []
    for name in vectors:
        x = np.asarray(obs[name])
        flat = x.reshape(*x.shape[:2], -1)
        names += [name] if x.ndim == 2 else [f"{name}[{i}]" for i in range(flat.shape[-1])]
        columns.append(flat)
    return names, np.concatenate(columns, axis=-1) if columns else np.zeros((0, 0, 0), np.float32)


class LinearProbe(NamedTuple):
    """Ridge regression on standardised features, each kept within what it was fitted to."""

    mean: np.ndarray  # [F]
    deviation: np.ndarray  # [F]
    low: np.ndarray  # [F], of the standardised features
    high: np.ndarray  # [F]
    weights: np.ndarray  # [F + 1, n], the last is the intercept

    @classmethod
    def fit(cls, x: np.ndarray, y: np.ndarray) -> LinearProbe:
        """From features ``x`` [N, F] to targets ``y`` [N, n]."""
        x, y = x.astype(np.float64), y.astype(np.float64)
        mean, deviation = x.mean(0), x.std(0) + 1e-6
        standard = (x - mean) / deviation
        inputs = np.c_[standard, np.ones(len(x))]
        penalty = RIDGE * len(x) * np.eye(inputs.shape[1])
        penalty[-1, -1] = 0.0
        weights = np.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ y)
        return cls(mean, deviation, standard.min(0), standard.max(0), weights)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Targets [..., n] for features [..., F]."""
        # A unit that hardly varied where it was fitted would count for hundreds of deviations elsewhere.
        inputs = np.clip((x - self.mean) / self.deviation, self.low, self.high)
        return inputs @ self.weights[:-1] + self.weights[-1]

    def explained(self, x: np.ndarray, y: np.ndarray) -> list[float]:
        """`explained` of ``y`` [N, n] by features [N, F]."""
        return explained(self(x), y)


def explained(predicted: np.ndarray, y: np.ndarray) -> list[float]:
    """The share of the variance of each component of ``y`` [N, n] that is predicted, R^2; 0 where it is constant."""
    y, predicted = np.asarray(y, np.float64), np.asarray(predicted, np.float64)
    variance, unexplained = y.var(0), np.square(y - predicted).mean(0)
    least = 1e-12 * np.maximum(np.square(y).mean(0), 1e-12)  # below it is the rounding of float32
    return [float(x) for x in np.where(variance > least, 1 - unexplained / np.maximum(variance, least), 0.0)]


class Ahead(NamedTuple):
    """The shares of the variance of what came that was predicted some steps before."""

    known: list[float]  # of each component of the vectors, by the probe; empty without one
    reward: float  # by the model's own head


def open_loops(
    agent: Agent, params: Any, key: Array, steps: Steps, probe: LinearProbe | None, truth: np.ndarray, horizon: int
) -> dict[int, Ahead]:
    """What open loops from states of these episodes say of what came, by steps ahead: 1, 2, 4, ... and the horizon.

    Args:
      probe: fitted to features and to vectors as in ``truth`` [steps, M, n]; none: the rewards alone are told.

    Returns:
      Nothing where no episode goes on for so long.
    """
    start_key, key = jax.random.split(key)
    t, m = starts(start_key, steps, horizon)
    if not len(t):
        return {}
    ahead = np.arange(horizon)[:, None]
    latents = agent.open_loop(
        params, key, jax.tree.map(lambda x: jnp.asarray(x[t, m]), steps.latent), jnp.asarray(steps.action[t + ahead, m])
    )
    predicted = feature(latents)  # of the steps t + 1, t + 2, ...
    reward, states = np.asarray(agent.heads(params, predicted).reward), np.asarray(predicted)
    return {
        h: Ahead(
            [] if probe is None else probe.explained(states[h - 1], truth[t + h, m]),
            explained(reward[h - 1][:, None], steps.reward[t + h, m][:, None])[0],
        )
        for h in sorted({2**i for i in range(horizon.bit_length())} | {horizon})
    }


def starts(key: Array, steps: Steps, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """Steps and episodes, [n] each, from where so many steps of the same episode follow; `STARTS` of them at most."""
    follows = np.zeros_like(steps.counts)
    if len(follows) > horizon:
        follows[: len(follows) - horizon] = steps.counts[horizon:]
    t, m = np.nonzero(follows)
    chosen = np.asarray(jax.random.permutation(key, len(t)))[:STARTS]
    return t[chosen], m[chosen]


def critic(agent: Agent, params: Any, key: Array, steps: Steps) -> dict[str, float]:
    """The critic's values beside the discounted returns that came, and beside those that the model expects: means.

    Where the ``value`` is near what is ``imagined`` and above the ``return`` that came, it is the model that promises
    too much. ``correlation`` is that of values and returns.

    All are of the states far enough from a time limit that what came does not hang on the critic's value there
    (`BOOTSTRAPPED`), ``imagined`` of `IMAGINED` of them: ``states`` says how many there are, and where there is none,
    no more is told. Critic and imagination are of the policy's samples.
    """
    value = np.asarray(agent.heads(params, feature(steps.latent)).value)
    discount = agent.config.behavior.discount
    came, bootstrapped = returns_that_came(steps, value, discount)
    here = steps.counts & ~last_steps(steps) & (bootstrapped <= BOOTSTRAPPED)
    t, m = np.nonzero(here)
    if not len(t):
        return {"states": 0}
    value, came = value[t, m], came[t, m]
    varies = min(value.std(), came.std()) > 0
    choice_key, key = jax.random.split(key)
    chosen = np.asarray(jax.random.permutation(choice_key, len(t)))[:IMAGINED]
    latent = jax.tree.map(lambda x: jnp.asarray(x[t[chosen], m[chosen]]), steps.latent)
    return {
        "states": len(t),
        "value": float(value.mean()),
        "imagined": float(imagined_returns(agent, params, key, latent, discount).mean()),
        "return": float(came.mean()),
        "correlation": float(np.corrcoef(value, came)[0, 1]) if varies else 0.0,
    }


def imagined_returns(agent: Agent, params: Any, key: Array, latent: Latent, discount: float) -> np.ndarray:
    """Discounted sums [M] of the rewards that the model expects under the policy from latents [M, ...].

    They are imagined for so long that the critic's value at the end counts for `BOOTSTRAPPED` at most.
    """
    horizon = max(1, math.ceil(math.log(BOOTSTRAPPED) / math.log(discount))) if discount > 0 else 1
    heads = agent.imagine(params, key, latent, horizon).heads
    along = lambda x: jnp.asarray(x).T  # [M, H + 1]
    return np.asarray(lambda_returns(along(heads.reward), along(heads.value), along(heads.discount), 1.0))[:, 0]


def last_steps(steps: Steps) -> np.ndarray:
    """Where episodes end, bool [steps, M]."""
    goes_on = np.concatenate([steps.counts[1:], np.zeros_like(steps.counts[:1])])
    return np.asarray(steps.counts & ~goes_on)


def returns_that_came(steps: Steps, value: np.ndarray, discount: float) -> tuple[np.ndarray, np.ndarray]:
    """Discounted sums [steps, M] of the rewards after each step, with ``value`` for what a time limit cut off; and the
    weight [steps, M] that this value has in them."""
    last, came, weight = last_steps(steps), np.zeros_like(value), np.zeros_like(value)
    for t in reversed(range(len(value))):
        more = t + 1 < len(value)
        after = steps.reward[t + 1] + discount * came[t + 1] if more else 0.0
        came[t] = np.where(last[t], np.where(steps.is_terminal[t], 0.0, value[t]), after)
        weight[t] = np.where(last[t], ~steps.is_terminal[t], discount * weight[t + 1] if more else 0.0)
    return came, weight


def saturated(mode: np.ndarray) -> list[float]:
    """The share of states in which each component of the policy's mode [N, A] is beyond `SATURATED`."""
    return [float(x) for x in (np.abs(mode) > SATURATED).mean(0)]
