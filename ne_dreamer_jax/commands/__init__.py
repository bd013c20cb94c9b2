"""Commands: ``python -m ne_dreamer_jax train`` and the like."""
