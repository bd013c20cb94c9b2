"""`ne_dreamer_jax.runs.training`, under the name that scripts of a checkout have for it."""

from ne_dreamer_jax.runs.training import Run, build, evaluate, train

__all__ = ["Run", "build", "evaluate", "train"]
