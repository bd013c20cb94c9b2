"""The training loop: collecting, learning and evaluating, composed by `make` into one compiled program."""

from ne_dreamer_jax.loop.budget import Budget
from ne_dreamer_jax.loop.config import LoopConfig
from ne_dreamer_jax.loop.make import Loop, make, over_seeds
from ne_dreamer_jax.loop.offline import train_offline
from ne_dreamer_jax.loop.play import Evaluation, Steps, make_play, random_action
from ne_dreamer_jax.loop.state import Counters, Episodes, Finished, LoopState, Report

__all__ = [
    "Budget",
    "Counters",
    "Episodes",
    "Evaluation",
    "Finished",
    "Loop",
    "LoopConfig",
    "LoopState",
    "Report",
    "Steps",
    "make",
    "make_play",
    "over_seeds",
    "random_action",
    "train_offline",
]
