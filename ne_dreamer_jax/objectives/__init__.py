"""Representation objectives: one file each, one interface (`base`)."""

from ne_dreamer_jax.objectives.base import Objective, ObjectiveConfig, Sizes
from ne_dreamer_jax.objectives.next_embedding import NextEmbedding

__all__ = ["NextEmbedding", "Objective", "ObjectiveConfig", "Sizes"]
