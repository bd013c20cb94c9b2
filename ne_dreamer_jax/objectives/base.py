"""What a representation objective is: the part of the world-model loss that shapes the latent states.

An objective is chosen by the type of a frozen dataclass in the config, whose ``build`` gives the functions below.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

from ne_dreamer_jax.nets.networks import Networks
from ne_dreamer_jax.types import Array, Batch, Metrics, Params, Rollout


class Model(NamedTuple):
    """The world model that an objective is built for, and what it may use of it."""

    nets: Networks
    length: int  # T
    unroll: Callable[[Params, Array, Batch], Rollout]
    """(params, key, batch) -> encodes a batch and unrolls the posterior along it; images may be float32, as the
    encoder's stages take them. For objectives that look at other views of the observations."""
    microbatches: int = 1
    """Parts in which sequences go through an objective's own large networks; see `nets.microbatches`."""


class Objective(NamedTuple):
    """Pure functions; ``params`` is all of the agent's parameters, the objective's own under ``"objective"``."""

    init: Callable[[Array], Params]
    """key -> the objective's own trained parameters."""
    init_target: Callable[[Params], Params]
    """params -> parameters that no gradient trains, such as a teacher's."""
    loss: Callable[[Params, Params, Array, Rollout], tuple[dict[str, Array], Metrics]]
    """(params, target_params, key, rollout) -> named losses (float32 scalars) and metrics."""
    after_update: Callable[[Params, Params, Array], Params]
    """(params, target_params, update) -> the new target_params."""


class ObjectiveConfig(Protocol):
    """A frozen dataclass with an objective's settings."""

    @property
    def losses(self) -> Mapping[str, float]:
        """The losses that `build`'s objective returns, each with the weight that the method's authors give it."""
        ...

    def build(self, model: Model) -> Objective:
        """The objective's functions."""
        ...


def no_target(params: Params) -> Params:
    """``init_target`` of an objective without target parameters."""
    return {}


def keep_target(params: Params, target: Params, update: Array) -> Params:
    """``after_update`` of an objective whose target parameters do not change."""
    return target
