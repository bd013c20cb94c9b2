"""Losses of NE-Dreamer and DreamerV3 as pure functions of arrays, for use here and in other JAX projects.

Nothing but ``jax`` is imported, and nothing of the rest of this package. Every function computes in float32 whatever
the dtype of its inputs, and works under ``jit``, ``grad``, ``vmap`` and sharded inputs. Functions that return one
value a step (KL, two-hot, actor, critic) leave the mean to the caller; `barlow_twins` and `next_embedding_loss` are
statistics of the whole batch and return a scalar.
"""

from .actor_critic import critic_loss, dynamics_loss, reinforce_loss
from .alignment import cosine_alignment, vicreg
from .barlow import barlow_twins, next_embedding_loss
from .kl import balanced_kl, categorical_kl, unimix_logits
from .reconstruction import image_loss, vector_loss
from .returns import lambda_returns, return_scale, update_percentiles
from .swav import assignment_loss, sinkhorn
from .twohot import symexp, symexp_bins, symlog, twohot_encode, twohot_loss, twohot_mean

__all__ = [
    "assignment_loss",
    "balanced_kl",
    "barlow_twins",
    "categorical_kl",
    "cosine_alignment",
    "critic_loss",
    "dynamics_loss",
    "image_loss",
    "lambda_returns",
    "next_embedding_loss",
    "reinforce_loss",
    "return_scale",
    "sinkhorn",
    "symexp",
    "symexp_bins",
    "symlog",
    "twohot_encode",
    "twohot_loss",
    "twohot_mean",
    "unimix_logits",
    "update_percentiles",
    "vector_loss",
    "vicreg",
]
