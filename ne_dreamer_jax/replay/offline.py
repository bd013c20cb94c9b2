"""Episodes that somebody recorded, in replay: to learn from them without an environment."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.replay import ring
from ne_dreamer_jax.replay.ring import Replay
from ne_dreamer_jax.types import ContinuousAction, EnvSpec, Latent, Transition


class Episode(NamedTuple):
    """One episode of L steps as most data sets have it, in numpy arrays.

    Attributes:
      obs: name -> ``[L + 1, ...]``, of the environment's specification; the last is what the last action led to.
      action: ``[L, ...]``, action[t] is taken from obs[t]; continuous ones in [-1, 1].
      reward: ``[L]``, reward[t] is received for action[t], on arrival at obs[t + 1] (gym's convention).
      is_terminal: whether the episode ended in a state of value zero, not by a time limit or by the end of the data.
    """

    obs: Mapping[str, Any]
    action: Any
    reward: Any
    is_terminal: bool


def from_episodes(
    episodes: Iterable[Episode], spec: EnvSpec, latent_sizes: tuple[int, int, int], latent_dtype: Any = jnp.float32
) -> Replay:
    """A full ring that holds these episodes, one after another, as if one environment had played them.

    Rewards move to the step that they lead to, as `types` has it; the last step of an episode gets an action of zeros,
    which nothing uses; latents are zero until updates write them back (``replay.write_latents``).

    Args:
      episodes: read once.
      spec: of the environment that they come from.
      latent_sizes: ``config.agent.latent_sizes``.
      latent_dtype: in which the latents' deterministic part is stored.

    Raises:
      ValueError: a field does not fit the specification (which episode and field, expected and got), there are fewer
        than two steps, or memory can't hold them.
    """
    if isinstance(episodes, Episode):
        raise ValueError("expected an iterable of episodes, got one; put it into a list")
    rows = [_rows(number, episode, spec) for number, episode in enumerate(episodes)]
    if not rows:
        raise ValueError("expected at least one episode, got none")
    data = jax.tree.map(lambda *parts: np.concatenate(parts)[:, None], *rows)  # [C, 1, ...]
    deter, stoch, classes = latent_sizes
    latent = Latent(np.zeros((1, deter), np.float32), np.zeros((1, stoch, classes), np.float32))  # type: ignore[arg-type]
    example = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), data)._replace(
        latent=jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), latent)
    )
    return ring.full(example, data, latent_dtype)


def _rows(number: int, episode: Episode, spec: EnvSpec) -> Transition:
    """An episode's L + 1 steps, [L + 1, ...], without latents."""
    if not isinstance(episode, Episode):
        raise ValueError(f"episode {number}: expected replay.Episode, got {type(episode).__name__}")
    try:
        terminal = np.asarray(episode.is_terminal)
    except ValueError as error:
        raise ValueError(f"episode {number}, is_terminal: expected one bool for the whole episode: {error}") from error
    is_bool = terminal.shape == () and terminal.dtype.kind in "biuf" and terminal in (0, 1)  # as data sets have them
    if not is_bool:
        raise ValueError(
            f"episode {number}, is_terminal: expected one bool for the whole episode, got "
            + (f"{terminal}" if terminal.shape == () else f"the shape {list(terminal.shape)}")
        )
    reward = np.asarray(episode.reward)
    length = len(reward) if reward.ndim == 1 else -1
    _expect(number, "reward", reward, (length if length > 0 else "L",), np.float32)
    _expect(number, "action", np.asarray(episode.action), (length, *spec.action.shape), spec.action.dtype)
    if set(episode.obs) != set(spec.observation):
        raise ValueError(
            f"episode {number}: expected observations named {sorted(spec.observation)}, got {sorted(episode.obs)}"
        )
    obs = {}
    for name, s in spec.observation.items():
        obs[name] = _expect(number, f"obs[{name!r}]", np.asarray(episode.obs[name]), (length + 1, *s.shape), s.dtype)
    if not isinstance(spec.action, ContinuousAction):
        _expect_range(number, np.asarray(episode.action), spec)  # before the cast, in which large numbers wrap round
    action = np.asarray(episode.action, spec.action.dtype)
    _expect_range(number, action, spec)  # after it, which rounds to 1 what is above it by an error of arithmetic
    steps = np.arange(length + 1)
    flags = {"is_first": steps == 0, "is_last": steps == length, "is_terminal": (steps == length) & bool(terminal)}
    return Transition(
        obs=obs,  # type: ignore[arg-type]
        action=np.concatenate([action, np.zeros_like(action[:1])]),  # type: ignore[arg-type]
        reward=np.concatenate([[0.0], reward]).astype(np.float32),  # type: ignore[arg-type]
        latent=(),  # type: ignore[arg-type]
        **flags,
    )


def _expect(number: int, name: str, value: np.ndarray, shape: tuple[Any, ...], dtype: Any) -> np.ndarray:
    """The value in this dtype, if it has the shape and converts to the dtype without loss of kind."""
    wanted = np.dtype(dtype)
    fits = value.dtype == wanted if wanted == np.uint8 else np.can_cast(value.dtype, wanted, "same_kind")
    if value.shape != shape or not fits:
        raise ValueError(
            f"episode {number}, {name}: expected {wanted.name}{list(shape)}, got {value.dtype.name}{list(value.shape)}"
        )
    value = value.astype(wanted)
    if wanted.kind == "f" and not np.isfinite(value).all():
        raise ValueError(f"episode {number}, {name}: expected finite numbers, got {value[~np.isfinite(value)][0]}")
    return value


def _expect_range(number: int, action: np.ndarray, spec: EnvSpec) -> None:
    """Raises ValueError for actions that the environment does not take."""
    low, high = (-1, 1) if isinstance(spec.action, ContinuousAction) else (0, spec.action.size - 1)
    if action.size and (action.min() < low or action.max() > high):
        raise ValueError(
            f"episode {number}, action: expected values from {low} to {high}, got {action.min()} to {action.max()}"
        )
