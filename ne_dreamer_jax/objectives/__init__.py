"""Representation objectives: one file each, one interface (`base`)."""

from ne_dreamer_jax.objectives.base import Model, Objective, ObjectiveConfig
from ne_dreamer_jax.objectives.dreamerpro import DreamerPro
from ne_dreamer_jax.objectives.next_embedding import NextEmbedding
from ne_dreamer_jax.objectives.none import NoObjective
from ne_dreamer_jax.objectives.reconstruction import Reconstruction
from ne_dreamer_jax.objectives.same_step import SameStep

AnyObjective = NextEmbedding | SameStep | DreamerPro | Reconstruction | NoObjective
"""The settings that a configuration may choose from, as a union of types: what is stored and parsed goes by it."""

__all__ = [
    "AnyObjective",
    "DreamerPro",
    "Model",
    "NextEmbedding",
    "NoObjective",
    "Objective",
    "ObjectiveConfig",
    "Reconstruction",
    "SameStep",
]
