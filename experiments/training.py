"""Building and training a run, under the name that scripts of a checkout have for it."""

from ne_dreamer_jax.runs.run import Run, build
from ne_dreamer_jax.runs.training import evaluate, train

__all__ = ["Run", "build", "evaluate", "train"]
