"""What the checkpoint in ``format_2`` holds, which version 0.2 of this program wrote."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def make() -> dict[str, Any]:
    """Arrays of every kind that a run has."""
    return {
        "agent": {
            "kernel": jnp.arange(12, dtype=jnp.float32).reshape(3, 4) / 7,
            "half": jnp.full((3,), 1.5, jnp.bfloat16),
            "update": jnp.int32(5),
            "key": jax.random.key(3),
        },
        "loop": {"ring": jnp.arange(24, dtype=jnp.uint8).reshape(2, 3, 4), "empty": jnp.zeros((0, 3)), "none": None},
        "frames": {"image": np.arange(8, dtype=np.uint8).reshape(2, 4)},
    }
