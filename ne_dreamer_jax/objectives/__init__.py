"""Representation objectives: one file each, one interface (`base`)."""

from ne_dreamer_jax.objectives.base import Objective, ObjectiveConfig, Sizes
from ne_dreamer_jax.objectives.next_embedding import NextEmbedding

AnyObjective = NextEmbedding
"""The settings that a configuration may choose from, as a union of types: what is stored and parsed goes by it."""

__all__ = ["AnyObjective", "NextEmbedding", "Objective", "ObjectiveConfig", "Sizes"]
