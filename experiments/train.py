"""Trains an agent: ``python -m experiments.train --help``; the same as ``python -m ne_dreamer_jax train``."""

from ne_dreamer_jax.commands.train import configure, main
from ne_dreamer_jax.system.pages import use_large_pages

__all__ = ["configure", "main"]

if __name__ == "__main__":
    use_large_pages("experiments.train")
    main()
