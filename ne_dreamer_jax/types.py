"""The data that moves between the parts. Read this file first.

Letters for shapes: B sequences in a batch, T steps in a sequence, N environments stepped together, H imagination
horizon, D deterministic state size, S latents, K classes per latent, F = D + S*K feature size, E embedding size,
A action size.

Time convention: the transition at t holds ``obs[t]``, the ``action[t]`` taken FROM it and the ``reward[t]`` received
ON ARRIVAL at it. The RSSM at t is fed ``prev_action[t] = action[t-1]`` (zero where ``is_first``); the next-embedding
predictor is fed ``action[t]``. They are two fields so that they can't be mixed up.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

Array = jax.Array
Params = Any  # a pytree of float32 arrays
Metrics = dict[str, Array]  # scalars, float32


class ArraySpec(NamedTuple):
    """Shape and dtype of one array, without batch axes."""

    shape: tuple[int, ...]
    dtype: Any


class ContinuousAction(NamedTuple):
    """Actions are float32 ``[size]`` with every component in [-1, 1]; an environment maps them to its own bounds."""

    size: int

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one action as the environment takes it."""
        return (self.size,)

    @property
    def dtype(self) -> Any:
        """Dtype of an action."""
        return jnp.float32


class DiscreteAction(NamedTuple):
    """Actions are int32 scalars in {0, ..., size - 1}."""

    size: int

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one action as the environment takes it."""
        return ()

    @property
    def dtype(self) -> Any:
        """Dtype of an action."""
        return jnp.int32


ActionSpec = ContinuousAction | DiscreteAction


class EnvSpec(NamedTuple):
    """What an agent needs to know of an environment.

    ``observation``: name -> shape and dtype. uint8 arrays of rank 3 (height, width, channels) are images and go to
    the convolutional encoder; float32 arrays of rank 0 or 1 are vectors and go to the multilayer perceptron.
    """

    observation: Mapping[str, ArraySpec]
    action: ActionSpec


def images_of(spec: EnvSpec) -> dict[str, ArraySpec]:
    """The observations that are images, by their spec: uint8 [H, W, C]."""
    return {name: s for name, s in spec.observation.items() if s.dtype == jnp.uint8 and len(s.shape) == 3}


class TimeStep(NamedTuple):
    """What an environment returns. All fields may carry leading batch axes."""

    obs: Mapping[str, Array]  # as EnvSpec.observation
    reward: Array  # float32 [], received on arrival at obs
    is_first: Array  # bool [], obs is the first of an episode
    is_last: Array  # bool [], obs is the last of an episode (terminal, or cut by a time limit)
    is_terminal: Array  # bool [], the episode ended in a state of value zero; implies is_last


class Latent(NamedTuple):
    """State of the RSSM, eq. for h_t and z_t."""

    deter: Array  # float32 [..., D]
    stoch: Array  # float32 [..., S, K], one-hot over K


class PolicyState(NamedTuple):
    """What acting carries from one step to the next, for N environments."""

    latent: Latent  # [N, ...], posterior at the last observation acted upon
    prev_action: Array  # [N, *action.shape], the action taken from that observation


class Transition(NamedTuple):
    """One step of N environments as it goes into replay (see the time convention above)."""

    obs: Mapping[str, Array]  # [N, ...]
    action: Array  # [N, *action.shape], taken from obs; within the bounds, but for ``heads.clip_actions=False``
    reward: Array  # float32 [N]
    is_first: Array  # bool [N]
    is_last: Array  # bool [N]
    is_terminal: Array  # bool [N]
    latent: Latent  # [N, ...], the posterior at obs when it was acted upon


class Batch(NamedTuple):
    """B sequences of T steps out of replay, with the step before each as context."""

    obs: Mapping[str, Array]  # [B, T, ...]
    action: Array  # [B, T, *action.shape], taken from obs
    prev_action: Array  # [B, T, *action.shape], taken one step before obs; ignored where is_first
    reward: Array  # float32 [B, T]
    is_first: Array  # bool [B, T]
    is_last: Array  # bool [B, T]
    is_terminal: Array  # bool [B, T]
    context: Latent  # [B, ...], the replayed latent one step before obs[:, 0]; ignored where is_first[:, 0]
    index: Array  # type: ignore[assignment]  # int32 [B, T], where the steps lie in replay (hides tuple.index)


class Rollout(NamedTuple):
    """The world model's posterior along a batch: what a representation objective is computed from."""

    batch: Batch
    embedding: Array  # float32 [B, T, E], the encoder's output for obs
    latent: Latent  # [B, T, ...], sampled posterior
    feature: Array  # float32 [B, T, F], concat(flat stoch, deter)
    action: Array  # float32 [B, T, A], batch.action as the models see it (clipped, or one-hot)
    prev_action: Array  # float32 [B, T, A], batch.prev_action likewise, zero where is_first


class ReturnScale(NamedTuple):
    """Moving 5th and 95th percentiles of imagined returns."""

    low: Array  # float32 []
    high: Array  # float32 []


class TrainState(NamedTuple):
    """Everything a train step changes."""

    params: Params  # trained by gradients: encoder, rssm, reward, continue, actor, critic, objective
    slow_critic: Params  # exponential moving average of params["critic"]
    target: Params  # the objective's own non-gradient parameters (empty for most objectives)
    optimizer: Any  # optax state
    return_scale: ReturnScale
    key: Array  # typed key []
    update: Array  # int32 [], updates done
