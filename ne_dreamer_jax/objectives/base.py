"""What a representation objective is: the part of the world-model loss that shapes the latent states.

An objective is chosen by the type of a frozen dataclass in the config, whose ``build`` gives the functions below.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from ne_dreamer_jax.types import Array, EnvSpec, Metrics, Params, Rollout


class Sizes(NamedTuple):
    """What an objective's own networks are built for."""

    spec: EnvSpec
    feature: int  # F
    embedding: int  # E
    length: int  # T
    dtype: Any  # of the matrix products


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
    def losses(self) -> tuple[str, ...]:
        """Names of the losses that `build`'s objective returns."""
        ...

    def build(self, sizes: Sizes) -> Objective:
        """The objective's functions."""
        ...


def no_target(params: Params) -> Params:
    """``init_target`` of an objective without target parameters."""
    return {}


def keep_target(params: Params, target: Params, update: Array) -> Params:
    """``after_update`` of an objective whose target parameters do not change."""
    return target
