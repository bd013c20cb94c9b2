"""What a run's agent knows, and what holds it back: its latents, its model's predictions, its critic and its policy.

Four questions about the states that its own policy visits, each answered on episodes that no fit has seen:

- Is what matters in the latent? What the environment knows of itself as vectors is regressed on the features; and a
  decoder, made after training and on frozen latents, draws the images (NE-Dreamer, "Representation diagnostics").
- Does the model know what follows? The same regression on latents of an open loop under the actions that were taken.
- Does the critic know what states are worth? Its values beside the discounted returns that came.
- Can the policy still learn? Where its mean is at an end of tanh, next to no gradient reaches the actor.

Shares are of the variance in the episodes that are told about: where little varies, as in a body that stands still,
they are low or below zero whatever the latent holds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.agents.base import Agent, Mode
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.envs.vector import as_vector
from ne_dreamer_jax.loop.play import Steps, make_play
from ne_dreamer_jax.nets.rssm import feature
from ne_dreamer_jax.runs import decoding, evaluation, pictures, plots, run_directory
from ne_dreamer_jax.runs.run_directory import RunDirectory
from ne_dreamer_jax.types import Array, ContinuousAction, Latent

RIDGE = 0.01
"""Of the regression, in shares of a standardised feature's sum of squares."""
SATURATED = 0.95
"""Beyond this a component of the policy's mode counts as at the end of tanh, whose slope is below a tenth there."""
STARTS = 512
"""Open loops, at most."""
COLUMNS = 10  # of a picture


def diagnose(
    run: str | Path,
    env: Any = None,
    *,
    episodes: int = 16,
    horizon: int = 15,
    decoder_updates: int = 1_000,
    prefer: Literal["best", "newest"] = "newest",
    actions: Mode = "mode",
    seed: int = 0,
    echo: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Plays episodes with a run's policy and says what its agent knows, as lines, `diagnosis.json` and `decoded.png`.

    Args:
      run: the run's directory, where both files are written.
      env: the environment, for a run that was trained on one given in code.
      episodes: half of them are for the regression and the decoder, the others for what is told.
      horizon: steps H of an open loop.
      decoder_updates: of the decoder, 64 frames each; 0 for none.
      prefer: the newest checkpoint, or that with the best evaluation.
      actions: the policy's mode, or samples, with which more varies where the task is solved.
      seed: of the episodes, the open loops and the decoder.

    Raises:
      ValueError: an agent without a world model; fewer than two episodes; an environment as of `evaluation.load`.
      RefusedError, FileNotFoundError, DamagedError: as of `evaluation.load`.
    """
    if episodes < 2:
        raise ValueError(f"episodes: expected two or more, to fit on some and to look at others, got {episodes}")
    loaded = evaluation.load(run, env, prefer)
    agent, params = loaded.agent, loaded.state.params
    if agent.inspection is None:
        raise ValueError(f"{run}: expected a run of an agent with a world model, got {agent.config.method}")
    play_key, loop_key, decoder_key, draw_key = jax.random.split(jax.random.key(seed), 4)
    loaded = evaluation.in_env(loaded, env_configs.with_all(loaded.config.env))
    steps, returns = _play(loaded, play_key, episodes, actions)
    told: dict[str, Any] = {"updates": int(loaded.state.update), "episodes": episodes, "actions": actions}
    told["return"] = float(np.mean(returns))
    echo(f"{episodes} episodes after {told['updates']:,} updates: return {told['return']:.1f}")

    fit, held_out = halves(steps)
    features = lambda part: np.asarray(feature(part.latent))[part.counts]
    names, truth = vectors(fit.obs)
    if names:
        regression = Regression.fit(features(fit), truth[fit.counts])
        known = regression.explained(features(held_out), vectors(held_out.obs)[1][held_out.counts])
        told["known"] = dict(zip(names, known, strict=True))
        echo("Known by the latent: " + shares(told["known"]))
        told["open_loop"] = predicted = open_loop(agent, params, loop_key, held_out, regression, horizon)
        for steps_ahead, each in predicted.items():
            share = shares(dict(zip([*names, "reward"], [*each["known"], each["reward"]], strict=True)))
            echo(f"Predicted {steps_ahead} steps ahead: {share}")
    told["critic"] = critic(agent, params, held_out)
    echo(
        "Critic: mean value {value:.3g}, mean return that came {return:.3g}, correlation {correlation:.2f}".format(
            **told["critic"]
        )
    )
    if isinstance(agent.spec.action, ContinuousAction):
        told["saturated"] = saturated(np.asarray(agent.heads(params, features(held_out)).action))
        echo(f"Policy: at an end of tanh in a share of steps, by component: {_round(told['saturated'])}")
    files = RunDirectory(Path(run))
    if decoder_updates and images(held_out.obs):
        name = images(held_out.obs)[0]
        decoded = decoding.post_hoc_decoder(agent, decoder_key, fit, held_out, name, decoder_updates)
        told["decoded"] = decoded.explained
        echo(f"Decoded from frozen latents: {decoded.explained:.2f} of the variance of unseen frames' pixels")
        strips = filmstrips(agent, params, draw_key, held_out, name, decoded.draw, horizon)
        pictures.attempt(lambda: plots.filmstrips(*strips, files.decoded), files.decoded, echo)
    run_directory.write_diagnosis(files, told)
    return told


def _play(loaded: evaluation.Loaded, key: Array, episodes: int, actions: Mode) -> tuple[Steps, np.ndarray]:
    env = as_vector(loaded.env)
    try:
        play = make_play(env, loaded.agent, loaded.config.loop.eval_max_steps, mode=actions)
        played = play(loaded.state.params, key, episodes, steps=True)
    finally:
        if env.host is not None:
            env.host.close()
    return played.steps, np.asarray(played.returns)


def halves(steps: Steps) -> tuple[Steps, Steps]:
    """The episodes [steps, M, ...] with even numbers, and those with odd ones."""
    half = lambda first: jax.tree.map(lambda x: np.asarray(x)[:, first::2], steps)
    return half(0), half(1)


def vectors(obs: Mapping[str, Any]) -> tuple[list[str], np.ndarray]:
    """Names of the components of all vectors and numbers of an observation, and them side by side [steps, M, n]."""
    names, columns = [], []
    for name, x in sorted(obs.items()):
        if np.issubdtype(np.asarray(x).dtype, np.floating) and np.ndim(x) <= 3:
            x = np.reshape(x, (*np.shape(x)[:2], -1))
            names += [name] if np.ndim(obs[name]) == 2 else [f"{name}[{i}]" for i in range(x.shape[-1])]
            columns.append(x)
    return names, np.concatenate(columns, axis=-1) if columns else np.zeros((0, 0, 0), np.float32)


def images(obs: Mapping[str, Any]) -> list[str]:
    """Names of the images, uint8 [steps, M, H, W, C]."""
    return sorted(name for name, x in obs.items() if x.dtype == np.uint8 and x.ndim == 5)


class Regression(NamedTuple):
    """Ridge regression on standardised features."""

    mean: np.ndarray  # [F]
    deviation: np.ndarray  # [F]
    weights: np.ndarray  # [F + 1, n], the last is the intercept

    @classmethod
    def fit(cls, x: np.ndarray, y: np.ndarray) -> Regression:
        """From features ``x`` [N, F] to targets ``y`` [N, n]."""
        mean, deviation = x.mean(0), x.std(0) + 1e-6
        inputs = np.c_[(x - mean) / deviation, np.ones(len(x))].astype(np.float64)
        penalty = RIDGE * len(x) * np.eye(inputs.shape[1])
        penalty[-1, -1] = 0.0
        return cls(mean, deviation, np.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ y))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Targets [..., n] for features [..., F]."""
        return (x - self.mean) / self.deviation @ self.weights[:-1] + self.weights[-1]

    def explained(self, x: np.ndarray, y: np.ndarray) -> list[float]:
        """`explained` of ``y`` [N, n] by features [N, F]."""
        return explained(self(x), y)


def explained(predicted: np.ndarray, y: np.ndarray) -> list[float]:
    """The share of the variance of each component of ``y`` [N, n] that is predicted, R^2; 0 where there is none."""
    variance = y.var(0)
    unexplained = np.square(y - predicted).mean(0)
    return [float(x) for x in np.where(variance > 1e-12, 1 - unexplained / np.maximum(variance, 1e-12), 0.0)]


def open_loop(
    agent: Agent, params: Any, key: Array, steps: Steps, regression: Regression, horizon: int
) -> dict[int, dict[str, Any]]:
    """What open loops from states of these episodes say of what came, by steps ahead: 1, 2, 4, ... and the horizon.

    ``known`` is the share of each vector's variance that the regression on predicted latents explains, ``reward`` that
    of the model's own predictions of rewards.
    """
    start_key, key = jax.random.split(key)
    t, m = starts(start_key, steps, horizon)
    if not len(t):
        return {}
    ahead = np.arange(horizon)[:, None]
    latents = agent.open_loop(
        params, key, jax.tree.map(lambda x: jnp.asarray(x[t, m]), steps.latent), jnp.asarray(steps.action[t + ahead, m])
    )
    states = np.asarray(feature(latents))
    reward = np.asarray(agent.heads(params, feature(latents)).reward)
    truth = vectors(steps.obs)[1]
    told = {}
    for h in sorted({2**i for i in range(horizon.bit_length())} | {horizon}):
        came = truth[t + h, m]
        told[h] = {
            "known": regression.explained(states[h - 1], came),
            "reward": explained(reward[h - 1][:, None], steps.reward[t + h, m][:, None])[0],
        }
    return told


def starts(key: Array, steps: Steps, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """Steps and episodes, [n] each, from where so many steps of the same episode follow; `STARTS` of them at most."""
    follows = np.zeros_like(steps.counts)
    if len(follows) > horizon:
        follows[: len(follows) - horizon] = steps.counts[horizon:]
    t, m = np.nonzero(follows)
    chosen = np.asarray(jax.random.permutation(key, len(t)))[:STARTS]
    return t[chosen], m[chosen]


def critic(agent: Agent, params: Any, steps: Steps) -> dict[str, float]:
    """The critic's values beside the discounted returns that came: means, and their correlation over all states."""
    value = np.asarray(agent.heads(params, feature(steps.latent)).value)
    came = returns_that_came(steps, value, agent.config.behavior.discount)
    here = steps.counts & ~last_steps(steps)
    value, came = value[here], came[here]
    varies = min(value.std(), came.std()) > 0
    correlation = float(np.corrcoef(value, came)[0, 1]) if varies else 0.0
    return {"value": float(value.mean()), "return": float(came.mean()), "correlation": correlation}


def last_steps(steps: Steps) -> np.ndarray:
    """Where episodes end, bool [steps, M]."""
    goes_on = np.concatenate([steps.counts[1:], np.zeros_like(steps.counts[:1])])
    return np.asarray(steps.counts & ~goes_on)


def returns_that_came(steps: Steps, value: np.ndarray, discount: float) -> np.ndarray:
    """Discounted sums [steps, M] of the rewards after each step, with ``value`` for what a time limit cut off."""
    last, came = last_steps(steps), np.zeros_like(value)
    for t in reversed(range(len(value))):
        after = steps.reward[t + 1] + discount * came[t + 1] if t + 1 < len(value) else 0.0
        came[t] = np.where(last[t], np.where(steps.is_terminal[t], 0.0, value[t]), after)
    return came


def saturated(mode: np.ndarray) -> list[float]:
    """The share of states in which each component of the policy's mode [N, A] is beyond `SATURATED`."""
    return [float(x) for x in (np.abs(mode) > SATURATED).mean(0)]


def filmstrips(
    agent: Agent,
    params: Any,
    key: Array,
    steps: Steps,
    name: str,
    draw: Callable[[Latent], np.ndarray],
    horizon: int,
) -> tuple[dict[str, np.ndarray], list[list[str]]]:
    """Rows and columns of `plots.filmstrips`: the first episode as it was seen and decoded, then an open loop of it.

    ``name`` is the image's, ``draw`` decodes latents [n, ...].
    """
    one = jax.tree.map(lambda x: x[:, 0], steps)
    length = int(one.counts.sum())
    some = np.linspace(0, length - 1, min(COLUMNS, length)).round().astype(int)
    at = lambda latent, rows: jax.tree.map(lambda x: x[rows], latent)
    rows = {"seen": one.obs[name][some], "decoded": draw(at(one.latent, some))}
    columns = [[f"step {t}" for t in some]] * 2
    if length > horizon:
        first = (length - horizon) // 2
        ahead = np.linspace(0, horizon, min(COLUMNS, horizon + 1)).round().astype(int)
        start = jax.tree.map(lambda x: jnp.asarray(x[first : first + 1]), one.latent)
        latents = agent.open_loop(params, key, start, jnp.asarray(one.action[first : first + horizon, None]))
        path = jax.tree.map(
            lambda before, after: np.concatenate([before[first][None], after[:, 0]]), one.latent, latents
        )
        rows |= {"seen ": one.obs[name][first + ahead], "predicted": draw(at(path, ahead))}
        columns += [[f"{first} + {h}" for h in ahead]] * 2
    return rows, columns


def shares(known: Mapping[str, float], most: int = 12) -> str:
    """Components and their shares in words; where there are many, the quartiles instead."""
    if len(known) <= most:
        return ", ".join(f"{name} {share:.2f}" for name, share in known.items())
    low, middle, high = np.percentile(list(known.values()), (25, 50, 75))
    text = f"quartiles of {len(known)} components {low:.2f} {middle:.2f} {high:.2f}"
    return text + (f", reward {known['reward']:.2f}" if "reward" in known else "")


def _round(values: list[float]) -> str:
    return " ".join(f"{x:.2f}" for x in values)
